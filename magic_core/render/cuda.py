"""The CUDA backend: gsplat, imported when first used (extra `[cuda]`).

gsplat puts pixel centres at half integers where ours are at integers, so the principal point is
shifted by half a pixel. Two small differences of definition remain: gsplat clamps alpha at 0.999
(ours: 0.99), and leaves out the Gaussian that brings the transmittance below 1e-4 (ours draws it).
"""

from __future__ import annotations

import torch
from torch import Tensor

from magic_core.errors import NotSupported
from magic_core.geometry import Camera
from magic_core.render import layout


def render_cuda(
    parameters: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    camera: Camera,
    world_from_camera: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Like `reference.render_reference`, on a CUDA device, float32."""
    rasterization = _gsplat()
    means, quaternions, scales, opacities, colours = (p.float() for p in parameters)
    calibration = torch.tensor(
        [[camera.fx, 0.0, camera.cx + 0.5], [0.0, camera.fy, camera.cy + 0.5], [0.0, 0.0, 1.0]],
        device=means.device,
    )
    planes, alpha, meta = rasterization(
        means=means, quats=quaternions, scales=scales, opacities=opacities, colors=colours,
        viewmats=_inverse(world_from_camera.float())[None], Ks=calibration[None],
        width=camera.width, height=camera.height, near_plane=float(layout.NEAR_M),
        eps2d=float(layout.DILATION), render_mode="RGB+D", packed=False,
    )  # fmt: skip
    image = torch.cat([planes[0], alpha[0]], dim=-1).permute(2, 0, 1)
    radii = meta["radii"][0]
    radii = radii.amax(dim=-1) if radii.ndim == 2 else radii
    return image, radii > 0, radii.float()


def _inverse(transform: Tensor) -> Tensor:
    """The inverse of a rigid (4, 4) transform, differentiable."""
    rotation_t = transform[:3, :3].T
    top = torch.cat([rotation_t, -rotation_t @ transform[:3, 3:]], dim=1)
    return torch.cat([top, transform[3:]], dim=0)


def _gsplat():
    """gsplat's rasterization function, or a NotSupported error that says what to install."""
    try:
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise NotSupported(
            "the cuda backend needs gsplat: pip install 'magic-slam[cuda]' on a CUDA machine, "
            "or use backend='cpu'"
        ) from error
    return rasterization
