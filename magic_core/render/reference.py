"""The slow reference in torch: every Gaussian against every pixel, in the dtype of its inputs.

It says what the kernels must compute (same constants, same ties) and nothing about how. Autograd
gives its gradients, so it can be checked by finite differences in float64. See `project` and
`blend` for the equations.
"""

from __future__ import annotations

import torch
from torch import Tensor

from magic_core.geometry import Camera
from magic_core.render import layout

_PAIRS_AT_ONCE = 4_000_000


def render_reference(
    parameters: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    camera: Camera,
    world_from_camera: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """(image (5, h, w), visible (n,), radii (n,)) of the five parameter tensors of a cloud.

    world_from_camera is (4, 4); all in one dtype. Not finite Gaussians are left out.
    """
    means, quaternions, scales, opacities, colours = parameters
    rotation = world_from_camera[:3, :3].T
    points = (means - world_from_camera[:3, 3]) @ rotation.T
    drawn = _drawable(parameters, points)
    index = torch.nonzero(drawn)[:, 0]
    # Ties are broken as the kernels break them: by float32 depth, then by index.
    order = torch.sort(points[index, 2].detach().float(), stable=True).indices
    index = index[order]
    points, opacity = points[index], opacities[index]
    covariance = _covariance(points, quaternions[index], scales[index], rotation, camera)
    values = torch.cat([colours[index], points[:, 2:]], dim=1)
    image, reached = _composite(points, covariance, opacity, values, camera)
    visible, radii = torch.zeros_like(drawn), torch.zeros_like(opacities)
    visible[index[reached]] = True
    reach = 2.0 * torch.log(opacity.detach() / float(layout.ALPHA_MIN))
    variance = torch.maximum(covariance[:, 0, 0], covariance[:, 1, 1]).detach()
    radii[index] = torch.sqrt(torch.clamp(reach, min=0.0) * variance)
    return image, visible, radii


def _drawable(parameters: tuple[Tensor, ...], points: Tensor) -> Tensor:
    """(n,) finite, in front of the camera and opaque enough to be seen."""
    rows = (p.detach() if p.ndim == 2 else p.detach()[:, None] for p in parameters)
    finite = [torch.isfinite(row).all(dim=1) for row in rows]
    enough = parameters[3].detach() >= float(layout.ALPHA_MIN)
    return torch.stack([*finite, points[:, 2].detach() > float(layout.NEAR_M), enough]).all(dim=0)


def _covariance(
    points: Tensor, quaternions: Tensor, scales: Tensor, rotation: Tensor, camera: Camera
) -> Tensor:
    """(n, 2, 2) covariances in the image, dilated, pixel^2."""
    x, y, z = points.unbind(-1)
    margin_x = float(layout.FRUSTUM_MARGIN) * 0.5 * camera.width / camera.fx
    margin_y = float(layout.FRUSTUM_MARGIN) * 0.5 * camera.height / camera.fy
    ratio_x = torch.clamp(
        x / z, -(camera.cx + 0.5) / camera.fx - margin_x,
        (camera.width - 0.5 - camera.cx) / camera.fx + margin_x,
    )  # fmt: skip
    ratio_y = torch.clamp(
        y / z, -(camera.cy + 0.5) / camera.fy - margin_y,
        (camera.height - 0.5 - camera.cy) / camera.fy + margin_y,
    )  # fmt: skip
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [camera.fx / z, zero, -camera.fx * ratio_x / z,
         zero, camera.fy / z, -camera.fy * ratio_y / z], dim=-1,
    ).reshape(-1, 2, 3)  # fmt: skip
    axes = rotation @ rotation_matrices(quaternions) * scales[:, None, :]
    rows = jacobian @ axes
    dilation = float(layout.DILATION) * torch.eye(2, dtype=z.dtype, device=z.device)
    return rows @ rows.transpose(1, 2) + dilation


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """(n, 3, 3) rotations of (n, 4) wxyz quaternions, which are normalised first."""
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    return torch.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=-1,
    ).reshape(-1, 3, 3)  # fmt: skip


def _composite(
    points: Tensor, covariance: Tensor, opacity: Tensor, values: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """The image (5, h, w) of Gaussians sorted by depth, and which of them reached a pixel."""
    u = camera.fx * points[:, 0] / points[:, 2] + camera.cx
    v = camera.fy * points[:, 1] / points[:, 2] + camera.cy
    conic = torch.linalg.inv(covariance)
    pixels = torch.arange(camera.width * camera.height, device=points.device)
    planes, reached = [], torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for part in pixels.split(max(1, _PAIRS_AT_ONCE // max(len(points), 1))):
        dx = (part % camera.width).to(u.dtype)[:, None] - u
        dy = torch.div(part, camera.width, rounding_mode="floor").to(v.dtype)[:, None] - v
        across = 2 * conic[:, 0, 1] * dx * dy
        distance = conic[:, 0, 0] * dx * dx + across + conic[:, 1, 1] * dy * dy
        alpha = opacity * torch.exp(-0.5 * distance)
        alpha = torch.where(alpha < float(layout.ALPHA_MIN), torch.zeros_like(alpha), alpha)
        weight, end = _weights(torch.clamp(alpha, max=float(layout.ALPHA_MAX)))
        reached |= (weight.detach() > 0).any(dim=0)
        planes.append(torch.cat([(weight @ values).T, (1 - end)[None]]))
    return torch.cat(planes, dim=1).reshape(5, camera.height, camera.width), reached


def _weights(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (p, n) of Gaussians along each pixel's ray, and the transmittance left (p,)."""
    first = alpha.new_ones(len(alpha), 1)
    before = torch.cumprod(torch.cat([first, 1 - alpha], dim=1), dim=1)[:, :-1]
    unfinished = before.detach() >= float(layout.TRANSMITTANCE_MIN)
    alpha = torch.where(unfinished, alpha, torch.zeros_like(alpha))
    passed = torch.cumprod(torch.cat([first, 1 - alpha], dim=1), dim=1)
    return alpha * passed[:, :-1], passed[:, -1]
