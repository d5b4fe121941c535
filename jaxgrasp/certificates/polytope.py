"""Simplices that surround a ball about the origin, proved.

Every ridge belongs to two facets, and one ray from the origin meets an odd number of facets: so every ray meets one,
since that parity does not change where a closed surface is crossed by a moving ray. A facet {sum l_j P_j} with a . P_j
>= 1 - r at its corners, for any vector a, keeps (1 - r) / |a| from the origin. Neither convexity nor the way the
polytope was found plays a part. Whether a ray meets a facet, P^T l = q with l > 0, is decided in floating point with a
bound of the error, and in integers where that is not enough; a ray that meets a ridge is replaced by another.
"""

from __future__ import annotations

import numpy as np

from .dyadic import integers
from .elimination import solve
from .rebuilt import EPS

__all__ = ["ball_inside"]

RAYS = 12


def ball_inside(points: np.ndarray, facets: np.ndarray) -> float:
    """The radius of a ball about the origin that the facets (F, m) of the points (V, m) surround; 0 for none."""
    m = points.shape[1]
    if len(facets) <= m or facets.min() < 0 or facets.max() >= len(points) or not _closed(facets):
        return 0.0
    corners = points[facets]
    if not np.isfinite(corners).all():
        return 0.0
    inverse = _inverses(corners)
    polar = inverse.sum(-1)  # a = P^-1 1
    # What is left at the corners, and what rounding can do to it.
    left = np.max(np.abs(np.einsum("fjm,fm->fj", corners, polar) - 1), -1)
    left = left + (m + 2) * EPS * np.linalg.norm(corners, axis=(-2, -1)) * np.linalg.norm(polar, axis=-1)
    distance = (1 - left) / np.linalg.norm(polar, axis=-1) * (1 - 8 * EPS)
    if not (np.isfinite(distance).all() and distance.min() > 0):
        return 0.0
    random = np.random.default_rng(0)
    for _ in range(RAYS):
        # Through the inside of a facet, so that it is met at all.
        ray = random.dirichlet(np.ones(m)) @ corners[random.integers(len(corners))]
        met = _met(corners, inverse, ray)
        if met is not None:
            return float(distance.min()) if met % 2 else 0.0
    return 0.0


def _closed(facets: np.ndarray) -> bool:
    """Every ridge belongs to exactly two facets, and no facet names a corner twice."""
    ordered = np.sort(facets, axis=1)
    if (np.diff(ordered, axis=1) == 0).any():
        return False
    ridges = np.concatenate([np.delete(ordered, j, axis=1) for j in range(facets.shape[1])])
    _, counts = np.unique(ridges, axis=0, return_counts=True)
    return bool((counts == 2).all())


def _inverses(corners: np.ndarray) -> np.ndarray:
    """Of the matrices of corners; a pseudo-inverse where a facet is flat."""
    try:
        inverse = np.linalg.inv(corners)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(corners)
    bad = np.flatnonzero(~np.isfinite(inverse).all((-2, -1)))
    inverse[bad] = np.linalg.pinv(corners[bad])
    return inverse


def _met(corners: np.ndarray, inverse: np.ndarray, ray: np.ndarray) -> int | None:
    """How many facets the ray meets in their inside, and the others not at all; None where it meets a ridge."""
    m = corners.shape[1]
    share = np.einsum("fji,j->fi", inverse, ray)
    norm, size = np.linalg.norm(inverse, axis=(-2, -1)), np.linalg.norm(corners, axis=(-2, -1))
    left = np.linalg.norm(np.einsum("fji,fj->fi", corners, share) - ray, axis=-1)
    left = left + (m + 2) * EPS * (size * np.linalg.norm(share, axis=-1) + np.linalg.norm(ray))
    wrong = np.linalg.norm(np.eye(m) - inverse @ corners, axis=(-2, -1)) + (m + 2) * EPS * norm * size
    error = np.where(wrong < 0.5, 2 * norm * left, np.inf)[:, None]
    inside, outside = (share > error).all(-1), (share < -error).any(-1)
    count = int(inside.sum())
    for facet in np.flatnonzero(~inside & ~outside):
        side = _side(corners[facet], ray)
        if side is None:
            return None
        count += side
    return count


def _side(corners: np.ndarray, ray: np.ndarray) -> bool | None:
    """Whether the ray meets the inside of one facet, in integers; None where it meets its edge."""
    m = len(corners)
    numbers, _ = integers([*corners.ravel(), *ray])
    columns = [numbers[m * j : m * j + m] for j in range(m)]
    found = solve(columns, numbers[m * m :])
    if found is None:  # a flat facet, and the ray leaves its plane
        return False
    share, _, rank = found
    if any(x < 0 for x in share) and rank == m:
        return False
    return True if all(x > 0 for x in share) and rank == m else None
