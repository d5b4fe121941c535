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


def is_ray(u: np.ndarray, matrices: np.ndarray, ray: np.ndarray) -> bool:
    """``u.ray < 0``, ``sum_i ray_i S_i >= 0``: from a feasible point the cost falls for ever."""
    cost, along = whole(u, ray)
    return bool(cost @ along < 0) and is_semidefinite(at(ray, 0 * matrices[0], matrices))


def excludes_all(constant: np.ndarray, matrices: np.ndarray, Z: np.ndarray) -> bool:
    """``tr(S_i Z) = 0``, ``tr(S_0 Z) < 0`` for a Z >= 0 next to this one: no x has ``S(x) >= 0``."""
    rest = np.linalg.norm(np.einsum("iab,ab->i", matrices, Z))
    columns = matrices.reshape(len(matrices), -1)
    change = 2 * rest / np.linalg.svd(columns, compute_uv=False)[-1]  # that makes the traces exactly zero
    inside = is_semidefinite(at(np.array([-change]), Z, np.eye(len(Z))[None]))
    return inside and bool(np.sum(constant * Z) + change * np.linalg.norm(constant) < 0)
