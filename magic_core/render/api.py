"""`render`: one differentiable function in front of three backends."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from magic_core.errors import InvalidInput
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render.cuda import render_cuda
from magic_core.render.rasteriser import Rasteriser
from magic_core.render.reference import render_reference

Backend = Literal["auto", "cpu", "cuda", "reference"]
Parameters = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
_SPARE_RASTERISERS = 4


@dataclass(frozen=True, slots=True)
class GaussianTensors:
    """A cloud as torch tensors, natural values as in GaussianCloud; any may need gradients."""

    means: Tensor  # (n, 3)
    quaternions: Tensor  # (n, 4) wxyz, normalised by the renderer
    scales: Tensor  # (n, 3)
    opacities: Tensor  # (n,)
    colours: Tensor  # (n, 3)

    @classmethod
    def from_cloud(
        cls, cloud: GaussianCloud, *, dtype: torch.dtype = torch.float32, device: str = "cpu"
    ) -> GaussianTensors:
        """Copies of a cloud's arrays."""
        return cls(*(torch.tensor(a, dtype=dtype, device=device) for a in cloud.arrays()))

    def requires_grad_(self) -> GaussianTensors:
        """Ask for gradients of every parameter; returns itself."""
        for tensor in self.tensors():
            tensor.requires_grad_()
        return self

    def tensors(self) -> Parameters:
        """(means, quaternions, scales, opacities, colours)."""
        return self.means, self.quaternions, self.scales, self.opacities, self.colours


@dataclass(frozen=True, slots=True)
class Rendering:
    """What `render` returns; colour, depth and alpha carry gradients."""

    colour: Tensor  # (h, w, 3) on black
    depth: Tensor  # (h, w) accumulated, metres
    alpha: Tensor  # (h, w)
    visible: Tensor  # (n,) bool
    radii: Tensor  # (n,) pixels, 0 when not drawn


def render(
    gaussians: GaussianTensors | GaussianCloud,
    camera: Camera,
    world_from_camera: Tensor | ArrayLike,
    backend: Backend = "auto",
    *,
    tangent: Tensor | None = None,
    threads: int | None = None,
) -> Rendering:
    """Render Gaussians given in the frame called world, differentiably.

    Gradients flow to every tensor of `gaussians`, and to the camera pose: through
    `world_from_camera` if it is a tensor, or through `tangent`, a (6,) right perturbation
    (translation, rotation): the pose used is world_from_camera @ exp(tangent).

    backend: `cpu` (float32 kernels), `cuda` (gsplat), `reference` (torch, slow, any dtype); `auto`
    is cuda for tensors on a CUDA device, else cpu. threads counts for the cpu backend only.
    """
    camera.validate()
    if isinstance(gaussians, GaussianCloud):
        gaussians = GaussianTensors.from_cloud(gaussians)
    parameters = gaussians.tensors()
    pose = _pose(world_from_camera, tangent, like=gaussians.means)
    if backend == "auto":
        backend = "cuda" if gaussians.means.is_cuda else "cpu"
    if backend == "cpu":
        image, visible, radii = _render_cpu(parameters, camera, pose, threads)
    elif backend == "cuda":
        image, visible, radii = render_cuda(parameters, camera, pose.float())
    elif backend == "reference":
        pose = pose.to(gaussians.means.dtype)
        image, visible, radii = render_reference(parameters, camera, pose)
    else:
        rule = "expected auto, cpu, cuda or reference"
        raise InvalidInput.field("backend", f"{backend!r}: {rule}")
    return Rendering(image[:3].permute(1, 2, 0), image[3], image[4], visible, radii)


def _pose(world_from_camera: Tensor | ArrayLike, tangent: Tensor | None, *, like: Tensor) -> Tensor:
    """world_from_camera @ exp(tangent), float64, on the Gaussians' device."""
    if isinstance(world_from_camera, Tensor):
        pose = world_from_camera.to(like.device, torch.float64)
    else:
        pose = torch.tensor(np.asarray(world_from_camera, dtype=np.float64), device=like.device)
    if tangent is None:
        return pose
    return pose @ se3_exp(tangent.to(like.device, torch.float64))


def se3_exp(tangent: Tensor) -> Tensor:
    """The (4, 4) transform of a (6,) tangent vector (translation, rotation), differentiable."""
    zero = torch.zeros((), dtype=tangent.dtype, device=tangent.device)
    rx, ry, rz, px, py, pz = tangent
    rows = [[zero, -pz, py, rx], [pz, zero, -px, ry], [-py, px, zero, rz], [zero] * 4]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows]))


def _render_cpu(
    parameters: Parameters, camera: Camera, pose: Tensor, threads: int | None
) -> tuple[Tensor, Tensor, Tensor]:
    if parameters[0].is_cuda:
        raise InvalidInput.field("backend", "cpu was asked for tensors on a CUDA device")
    apply: Any = _CpuRender.apply
    return apply(*parameters, pose, camera, threads)


class _CpuRender(torch.autograd.Function):
    """The kernels as an autograd function of the five parameter tensors and the pose matrix."""

    @staticmethod
    def forward(ctx, means, quaternions, scales, opacities, colours, pose, camera, threads):
        tensors = (means, quaternions, scales, opacities, colours)
        cloud = GaussianCloud.from_arrays(
            means.detach().numpy(), quaternions.detach().numpy(), scales=scales.detach().numpy(),
            opacities=opacities.detach().numpy(), colours=colours.detach().numpy(),
        )  # fmt: skip
        ctx.lease = _Lease(threads)
        view = ctx.lease.rasteriser.render(cloud, camera, pose.detach().numpy())
        ctx.pose = pose.detach().numpy().astype(np.float64)
        ctx.dtypes = [t.dtype for t in (*tensors, pose)]
        image = torch.from_numpy(view.image).to(means.dtype)
        visible, radii = torch.from_numpy(view.visible), torch.from_numpy(view.radii)
        ctx.mark_non_differentiable(visible, radii)
        return image, visible, radii

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        gradient = np.ascontiguousarray(grad_outputs[0].detach().float().numpy())
        found = ctx.lease.rasteriser.backward(gradient)
        arrays = (
            found.means, found.quaternions, found.scales, found.opacities, found.colours,
            _matrix_gradient(ctx.pose, found.pose),
        )  # fmt: skip
        pairs = zip(arrays, ctx.dtypes, strict=True)
        return (*(torch.from_numpy(a).to(dtype) for a, dtype in pairs), None, None)


def _matrix_gradient(pose: np.ndarray, tangent_gradient: np.ndarray) -> np.ndarray:
    """The (4, 4) G with <G, dT> = tangent_gradient . xi for every motion dT = T hat(xi)."""
    gx, gy, gz = 0.5 * tangent_gradient[3:]
    half_hat = np.array([[0.0, -gz, gy], [gz, 0.0, -gx], [-gy, gx, 0.0]])
    gradient = np.zeros((4, 4))
    gradient[:3, :3] = pose[:3, :3] @ half_hat
    gradient[:3, 3] = pose[:3, :3] @ tangent_gradient[:3]
    return gradient


class _Lease:
    """A rasteriser whose buffers live as long as the autograd graph needs them, then are reused."""

    _spare: list[Rasteriser] = []  # noqa: RUF012 - shared by all leases on purpose
    _lock = threading.Lock()

    def __init__(self, threads: int | None) -> None:
        with self._lock:
            self.rasteriser = self._spare.pop() if self._spare else Rasteriser()
        self.rasteriser.use_threads(threads)

    def __del__(self) -> None:
        with self._lock:
            if len(self._spare) < _SPARE_RASTERISERS:
                self._spare.append(self.rasteriser)
