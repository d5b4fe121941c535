"""Both bounds of the Ferrari-Canny quality proved again.

    lower   every vertex is the wrench of forces in their cones with unit effort. Every ridge belongs to two facets and
            one ray from the origin meets an odd number of facets: so every ray meets one, since that parity does not
            change where a closed surface is crossed by a moving ray. No facet's plane is nearer than ``lower``.
    upper   h(direction), in closed form, is no larger

A facet's plane {p : a . p = 1} has a = P^-1 1 from its corners P, at distance 1 / |a|. Neither convexity nor the way
the polytope was found plays a part.
"""

from __future__ import annotations

import numpy as np

from .proof import LEVELS, Proof
from .rebuilt import Rebuilt, rebuild, scaled_force

__all__ = ["check_epsilon", "prove_epsilon"]

RESISTANT, INVALID = 1, 5
ROUNDING = 1e-9  # of epsilon; of unit effort


def _wrenches(
    known: Rebuilt, lane: int, forces: np.ndarray, row_scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Wrenches (V, m) of forces (V, k, n), lengths over the torque scale, and the forces scaled, normal first."""
    s = scaled_force(forces, known.scale[lane], known.normal_index)
    return np.einsum("kmn,vkn->vm", known.blocks[lane], s) * row_scale, s


def _surrounds(points: np.ndarray, facets: np.ndarray, lower: float) -> bool:
    """Whether the simplices surround the ball of radius ``lower`` about the origin."""
    m = points.shape[1]
    if len(facets) <= m or facets.min() < 0 or facets.max() >= len(points):
        return False
    sorted_corners = np.sort(facets, axis=1)
    if (np.diff(sorted_corners, axis=1) == 0).any():
        return False
    ridges = np.concatenate([np.delete(sorted_corners, j, axis=1) for j in range(m)])
    _, counts = np.unique(ridges, axis=0, return_counts=True)
    if (counts != 2).any():
        return False
    corners = points[facets]
    try:
        polar = np.linalg.solve(corners, np.ones((len(facets), m, 1)))[..., 0]
        ray = np.random.default_rng(0).normal(size=m)
        share = np.linalg.solve(
            np.swapaxes(corners, 1, 2), np.broadcast_to(ray[:, None], (len(facets), m, 1))
        )
    except np.linalg.LinAlgError:
        return False
    met = (share[..., 0] >= 0).all(axis=1)
    distance = 1 / np.linalg.norm(polar, axis=1)
    return bool(np.isfinite(distance).all() and distance.min() >= lower and met.sum() % 2 == 1)


def _support(known: Rebuilt, lane: int, direction: np.ndarray, row_scale: np.ndarray, norm: str) -> float:
    v = np.einsum("kmn,m->kn", known.blocks[lane], direction * row_scale)
    h = np.where(known.live[lane], v[:, 0] + np.linalg.norm(v[:, 1:], axis=-1), 0.0)
    return float(np.maximum(h, 0.0).sum() if norm == "Linf" else max(h.max(), 0.0))


def prove_epsilon(grasp, result, tolerance: float | None = None) -> Proof:
    """What the evidence proves; shape of ``result.status``."""
    accepted = np.asarray(check_epsilon(grasp, result, tolerance))
    nan = np.full(accepted.shape, np.nan)
    return Proof(
        LEVELS[accepted.astype(int)], np.where(accepted, 0.0, np.inf), nan, nan, np.zeros(accepted.shape)
    )


def check_epsilon(grasp, result, tolerance: float | None = None) -> np.ndarray:
    """True for each lane whose bounds the evidence proves; shape of ``result.status``."""
    shape = np.shape(result.status)
    dimension, k = grasp.position.shape[-1], grasp.position.shape[-2]
    m = 3 if dimension == 2 else 6
    known = rebuild(grasp)
    n = len(known.components)
    lanes = len(known.valid)

    def rows(array, *own):
        return np.asarray(array, np.float64).reshape(lanes, *own)

    status = np.asarray(result.status).reshape(-1)
    lower, upper, direction = rows(result.lower), rows(result.upper), rows(result.direction, m)
    scale = rows(result.torque_scale)
    V, F = np.shape(result.forces)[-2], np.shape(result.facets)[-2]
    forces, facets = rows(result.forces, V, k, n), np.asarray(result.facets).reshape(lanes, F, m)
    room = max(ROUNDING, 64 * float(np.finfo(grasp.position.dtype).eps)) if tolerance is None else tolerance
    accepted = np.zeros(lanes, bool)
    for lane in range(lanes):
        if status[lane] == INVALID or not known.valid[lane]:
            accepted[lane] = status[lane] == INVALID and not known.valid[lane]
            continue
        row_scale = np.ones(m)
        row_scale[dimension:] = known.length[lane] / scale[lane]
        unit = np.linalg.norm(direction[lane])
        if not (np.isfinite(unit) and abs(unit - 1) < 1e-6 and 0 <= lower[lane] <= upper[lane] * (1 + room)):
            continue
        largest = np.linalg.norm(known.A[lane] * row_scale[:, None])
        top = _support(known, lane, direction[lane] / unit, row_scale, result.norm)
        if top > upper[lane] * (1 + room) + 256 * np.finfo(grasp.position.dtype).eps * largest:
            continue
        if lower[lane] == 0:
            accepted[lane] = True  # claims nothing
            continue
        used = facets[lane][facets[lane][:, 0] >= 0]
        points, s = _wrenches(known, lane, forces[lane], row_scale)
        normal, tail = s[..., 0], np.linalg.norm(s[..., 1:], axis=-1)
        effort = normal.sum(axis=-1) if result.norm == "L1" else normal.max(axis=-1)
        inside = (tail <= normal + room).all() and (effort <= 1 + room).all()
        inside &= bool((np.abs(s[:, ~known.live[lane]]) == 0).all())
        accepted[lane] = bool(inside) and _surrounds(points, used, lower[lane] * (1 - room))
    return accepted.reshape(shape)
