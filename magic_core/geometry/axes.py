"""Other tools' axes: what x, y and z point to.

Axes are named by three letters, for x, y and z in turn: (r)ight or (l)eft, (u)p or (d)own,
(f)orward or (b)ack. Ours are `rdf`, OpenCV's: x right, y down, z forward. glTF and OpenGL use
`rub`, ROS (REP 103) `flu`, Unity `ruf` (left-handed), Blender's and most CAD's z-up is `rfu`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import InvalidInput

OURS = "rdf"
_DIRECTIONS = {"r": (1, 0, 0), "l": (-1, 0, 0), "d": (0, 1, 0), "u": (0, -1, 0),
               "f": (0, 0, 1), "b": (0, 0, -1)}  # fmt: skip


def axes_from_ours(name: str) -> NDArray[np.float64]:
    """(3, 3) that maps vectors in our axes to the named ones; determinant -1 if left-handed.

    InvalidInput names the three choices where the name is not such a triple.
    """
    rows = [_DIRECTIONS.get(letter) for letter in name.lower()]
    matrix = np.array([row for row in rows if row is not None], dtype=np.float64)
    if len(rows) != 3 or matrix.shape != (3, 3) or abs(np.linalg.det(matrix)) != 1.0:
        raise InvalidInput.field(
            "axes",
            f"{name!r}: expected three letters for x, y and z, one each of r or l, u or d, "
            "f or b; ours are rdf, glTF's rub, ROS's flu, Unity's ruf",
        )
    return matrix


def reoriented_poses(poses: ArrayLike, matrix: ArrayLike) -> NDArray[np.float64]:
    """Poses (..., 4, 4) whose both frames, world and camera, get other axes."""
    poses = np.asarray(poses, dtype=np.float64)
    change = np.eye(4)
    change[:3, :3] = matrix
    return change @ poses @ change.T


def reoriented_information(information: ArrayLike, matrix: ArrayLike) -> NDArray[np.float64]:
    """Information (6, 6) of (translation, rotation) tangents in other axes.

    A rotation vector is an axial vector: a mirror turns it the other way round.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    change = np.zeros((6, 6))
    change[:3, :3] = matrix
    change[3:, 3:] = np.linalg.det(matrix) * matrix
    return change @ np.asarray(information, dtype=np.float64) @ change.T
