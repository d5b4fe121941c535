"""Symmetric matrices in whole numbers: floats are whole multiples of a power of two, so nothing here rounds."""

from __future__ import annotations

import numpy as np


def whole(*arrays: np.ndarray) -> list[np.ndarray]:
    """The arrays times one power of two that makes all their entries whole numbers (Python's, of any size)."""
    ratios = [[float(v).as_integer_ratio() for v in np.ravel(array)] for array in arrays]
    common = max((bottom for rows in ratios for _, bottom in rows), default=1)
    made = [np.array([top * (common // bottom) for top, bottom in rows], dtype=object) for rows in ratios]
    return [row.reshape(np.shape(array)) for row, array in zip(made, arrays, strict=True)]


def at(x: np.ndarray, constant: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """A positive multiple of ``constant + sum_i x_i matrices_i``, exactly."""
    (one, *x), (constant, *matrices) = whole(np.append(1.0, x))[0], whole(constant, *matrices)
    return one * constant + sum(value * matrix for value, matrix in zip(x, matrices, strict=True))


def is_semidefinite(matrix: np.ndarray) -> bool:
    """Whether a symmetric matrix is positive semidefinite, by elimination without fractions (Bareiss 1968).

    A pivot is positive, or its whole row is zero.
    """
    M = whole(matrix)[0] if np.asarray(matrix).dtype != object else matrix.copy()
    assert np.all(M == M.T)
    before = 1
    for k in range(len(M)):
        pivot, row = M[k, k], M[k, k + 1 :].copy()
        if pivot < 0 or (pivot == 0 and np.any(row != 0)):
            return False
        if pivot > 0:
            M[k + 1 :, k + 1 :] = (pivot * M[k + 1 :, k + 1 :] - np.multiply.outer(row, row)) // before
            before = pivot
    return True
