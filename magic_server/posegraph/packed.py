"""Triangles of square matrices without their other halves, column by column as LAPACK has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_blas_funcs, get_lapack_funcs

Array = NDArray[np.float64]
Single = NDArray[np.float32]
_trttp, _tpttr = get_lapack_funcs(("trttp", "tpttr"), dtype=np.float64)
(_tpsv,) = get_blas_funcs(("tpsv",), dtype=np.float32)


def lower(matrix: Array) -> Array:
    """The lower triangle (n (n + 1) / 2,) of a matrix (n, n)."""
    if not len(matrix):
        return np.zeros(0)
    triangle, _ = _trttp(matrix, uplo="L")
    return triangle


def symmetric(triangle: Array, size: int) -> Array:
    """The symmetric matrix (size, size) that a lower triangle is of."""
    if not size:
        return np.zeros((0, 0))
    matrix, _ = _tpttr(size, triangle, uplo="L")
    return matrix + np.tril(matrix, -1).T


def diagonal(triangle: Array, size: int) -> Array:
    """The diagonal (size,) of the matrix that a lower triangle is of."""
    return triangle[np.cumsum([0, *range(size, 1, -1)])] if size else np.zeros(0)


def solved(factor: Single, rhs: Single, *, transposed: bool = False) -> Single:
    """x (n,) with L x = rhs, or L^T x = rhs, of a lower triangle L."""
    if not len(rhs):
        return rhs
    return _tpsv(len(rhs), factor, rhs, lower=1, trans=int(transposed))
