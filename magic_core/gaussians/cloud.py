"""A cloud of 3D Gaussians in natural values (no logarithms, no logits)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import FieldViolation, InvalidInput
from magic_core.geometry import se3

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class GaussianCloud:
    """n Gaussians, all float32 and C-contiguous, in one frame that the owner names."""

    means: Float32  # (n, 3) metres
    quaternions: Float32  # (n, 4) unit, wxyz: frame_from_gaussian axes
    scales: Float32  # (n, 3) standard deviations along the Gaussian's axes, metres, > 0
    opacities: Float32  # (n,) in (0, 1)
    colours: Float32  # (n, 3) linear in the image's own encoding, 0 to 1 (RGB)

    def __len__(self) -> int:
        return len(self.means)

    @classmethod
    def empty(cls) -> GaussianCloud:
        """A cloud of no Gaussians."""
        return cls(*(np.zeros(shape, np.float32) for shape in ((0, 3), (0, 4), (0, 3), 0, (0, 3))))

    @classmethod
    def from_arrays(
        cls,
        means: ArrayLike,
        quaternions: ArrayLike,
        *,
        scales: ArrayLike,
        opacities: ArrayLike,
        colours: ArrayLike,
    ) -> GaussianCloud:
        """Convert any arrays to float32 and C order; shapes are not checked here."""
        arrays = (means, quaternions, scales, opacities, colours)
        return cls(*(np.ascontiguousarray(array, dtype=np.float32) for array in arrays))

    @classmethod
    def concatenate(cls, clouds: list[GaussianCloud]) -> GaussianCloud:
        """All Gaussians of several clouds of one frame, in order."""
        if not clouds:
            return cls.empty()
        columns = zip(*(cloud.arrays() for cloud in clouds), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def arrays(self) -> tuple[Float32, Float32, Float32, Float32, Float32]:
        """(means, quaternions, scales, opacities, colours)."""
        return self.means, self.quaternions, self.scales, self.opacities, self.colours

    def select(self, index: NDArray) -> GaussianCloud:
        """The Gaussians of a boolean mask (n,) or an index array."""
        return GaussianCloud(*(np.ascontiguousarray(array[index]) for array in self.arrays()))

    def transformed(self, a_from_b: ArrayLike) -> GaussianCloud:
        """This cloud of frame b, expressed in frame a (paper, "Pose Update Integration")."""
        a_from_b = np.asarray(a_from_b, dtype=np.float64)
        rotation_q = se3.quaternion_from_rotation(a_from_b[:3, :3])
        return GaussianCloud.from_arrays(
            se3.transform_points(a_from_b, self.means),
            se3.quaternion_multiply(rotation_q, self.quaternions),
            scales=self.scales,
            opacities=self.opacities,
            colours=self.colours,
        )

    def reoriented(self, matrix: ArrayLike) -> GaussianCloud:
        """This cloud in other axes: `matrix` (3, 3) is orthogonal, a rotation or a mirror."""
        from scipy.spatial.transform import Rotation

        matrix = np.asarray(matrix, dtype=np.float64)
        # A Gaussian is symmetric: turning one of its own axes round changes nothing, and makes a
        # mirrored rotation a rotation again.
        own = np.diag([1.0, 1.0, np.linalg.det(matrix)])
        rotations = matrix @ se3.rotation_from_quaternion(self.quaternions) @ own
        return GaussianCloud.from_arrays(
            self.means @ matrix.T,
            Rotation.from_matrix(rotations).as_quat(scalar_first=True),
            scales=self.scales,
            opacities=self.opacities,
            colours=self.colours,
        )

    def validate(self, field: str = "gaussians") -> None:
        """Raise InvalidInput with every rule that is broken (shapes, finite, unit, ranges)."""
        found = [FieldViolation(f"{field}.{name}", text) for name, text in self._violations()]
        if found:
            message = f"{found[0].field}: {found[0].description}"
            raise InvalidInput(message, violations=tuple(found))

    def _violations(self) -> list[tuple[str, str]]:
        n = len(self.means)
        shapes = {"means": (n, 3), "quaternions": (n, 4), "scales": (n, 3),
                  "opacities": (n,), "colours": (n, 3)}  # fmt: skip
        wrong = [
            (name, f"shape {getattr(self, name).shape}, expected {shape}")
            for name, shape in shapes.items()
            if getattr(self, name).shape != shape
        ]
        wrong += [
            (name, "holds NaN or infinity; send finite numbers only")
            for name in shapes
            if not np.isfinite(getattr(self, name)).all()
        ]
        if wrong or n == 0:
            return wrong
        off_unit = float(np.abs(np.linalg.norm(self.quaternions, axis=1) - 1.0).max())
        if off_unit > 1e-3:
            wrong.append(("quaternions", f"norm off by {off_unit:.3g}, expected unit within 1e-3"))
        if self.scales.min() <= 0.0:
            wrong.append(("scales", f"minimum {self.scales.min():.3g} m, expected > 0"))
        if self.opacities.min() < 0.0 or self.opacities.max() > 1.0:
            wrong.append(("opacities", "expected values in [0, 1]"))
        return wrong
