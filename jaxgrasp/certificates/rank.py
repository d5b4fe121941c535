"""Rank of the folded grasp map, proved: a lower bound of its smallest singular value, and the rank by a tolerance.

    A A^T X = I - R,  |R| <= a < 1    =>    sigma_min(A)^2 >= (1 - a) / |X|   (less what rounding does to A A^T)

for any matrix X; a good one is the inverse. Source: Rump, Verification methods, Acta Numerica 19, 2010, section 10.
"""

from __future__ import annotations

import numpy as np

from .rebuilt import EPS

__all__ = ["RANK_BAND", "numeric_rank_fits", "rounding_of", "smallest_singular_value"]

RANK_BAND = (
    32.0,
    128.0,
)  # the rank is the number of singular values above 64 eps |A|_2; both neighbours are accepted


def rounding_of(A: np.ndarray) -> np.ndarray:
    """(N,) what rounding can do to A (N, m, c) and to a product with it, in the Frobenius norm."""
    return (16 + A.shape[-1]) * EPS * np.linalg.norm(A, axis=(-2, -1))


def smallest_singular_value(A: np.ndarray, rounding: np.ndarray) -> np.ndarray:
    """(N,) a lower bound for every matrix within ``rounding`` of A (N, m, c); 0 where none is found."""
    m, columns = A.shape[-2:]
    gram = A @ np.swapaxes(A, -1, -2)
    size = np.trace(gram, axis1=-2, axis2=-1)
    usable = np.isfinite(size) & (size > 0)
    gram = np.where(usable[:, None, None], gram, np.eye(m))
    # The shift keeps an exactly singular matrix from stopping the others.
    inverse = np.linalg.inv(gram + 4 * EPS * np.where(usable, size, 1.0)[:, None, None] * np.eye(m))
    norm = np.linalg.norm(inverse, axis=(-2, -1))
    left = np.linalg.norm(np.eye(m) - inverse @ gram, axis=(-2, -1))
    left = left + (m + 2) * EPS * (norm * np.linalg.norm(gram, axis=(-2, -1)) + 1)
    square = (1 - left) / (norm * (1 + 8 * EPS)) - (columns + 2) * EPS * size
    found = np.sqrt(np.maximum(square, 0.0)) * (1 - 4 * EPS) - rounding
    return np.where(usable & np.isfinite(found), np.maximum(found, 0.0), 0.0)


def numeric_rank_fits(A: np.ndarray, claimed: np.ndarray, sigma: np.ndarray, eps: float) -> np.ndarray:
    """(N,) bool: ``claimed`` singular values of A lie above the tolerance of a dtype with ``eps``, up to rounding.

    sigma  (N,) a proven lower bound of the smallest, which saves the singular values of most
    """
    m = A.shape[-2]
    low, high = RANK_BAND
    clear = sigma > high * eps * np.linalg.norm(A, axis=(-2, -1))
    fits = clear & (claimed == m)
    asked = np.flatnonzero(~clear & np.isfinite(A).all(axis=(-2, -1)))
    if asked.size:
        values = np.linalg.svd(A[asked], compute_uv=False)
        largest = values[:, :1]
        most = (values > low * eps * largest).sum(-1)
        least = (values > high * eps * largest).sum(-1)
        fits[asked] = (least <= claimed[asked]) & (claimed[asked] <= most)
    return fits
