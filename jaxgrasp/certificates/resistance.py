"""Wrench resistance proved again in float64, without trusting the solver.

It rebuilds the grasp map from positions, normals, mu and gamma, divides lengths by L = max_i |p_i|, folds mu and
gamma into the columns (A), and asks of each lane (theory section 2; prior art: Boyd, Wegbreit 2007):

    RESISTANT      sqrt(2) (|A s| + c eps |A| |s|) / (sigma_min(A) - c eps |A|) < min_i (s_n,i - |s_t,i|)
                   for the scaled internal force s: some exact internal force lies inside every cone, and A has
                   full rank, for every A within rounding of the computed one.
    NOT_RESISTANT  the twist xi has A_i^T xi inside the (self-dual) cone by more than rounding at every contact,
                   or sigma_min(A) is at or below the rank tolerance and xi spans its null space.
    MARGINAL       full rank, and the internal force and the twist together show |t*| <= tolerance.
    INVALID        the numbers are indeed no grasp.
    UNDECIDED      claims nothing, so there is nothing to refute.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .rebuilt import EPS, RANK_TOLERANCE, ROUNDING, Rebuilt, rebuild, scaled_force, scaled_twist

__all__ = ["check_resistance"]

RESISTANT, NOT_RESISTANT, MARGINAL, UNDECIDED, INVALID = 1, 2, 3, 4, 5
BARE_CLAIM = 1e-8  # the |t*| that MARGINAL claims without a bracket
LARGEST_CLAIM = 1e-3  # a bracket this wide claims nothing


class Rank(NamedTuple):
    """Singular values of A (N,), and what rounding leaves of them: in A itself, in the dtype of the grasp."""

    smallest: np.ndarray
    rounding: np.ndarray
    tolerance: np.ndarray

    @property
    def full(self) -> np.ndarray:
        return self.smallest > np.maximum(self.rounding, self.tolerance)


def check_resistance(grasp, result, tolerance: float | None = None) -> np.ndarray:
    """True for each lane whose verdict the evidence in ``result`` proves; shape (*batch,), numpy bool.

    grasp      a ``Grasp``
    result     what ``wrench_resistance(grasp)`` returned, or anything with ``status``, ``margin``, ``gap``,
               ``internal_force``, ``escape_twist`` of the same shapes
    tolerance  the |t*| that MARGINAL may claim, no smaller than the dtype's resolution; by default what the
               result's own bracket [margin, margin + gap] claims, as long as that is below 1e-3

    Runs on the host in float64 whatever the dtype of the grasp; a few operations a lane.
    """
    dtype = np.dtype(grasp.position.dtype)
    batch, k, dimension = grasp.position.shape[:-2], grasp.position.shape[-2], grasp.position.shape[-1]
    known = rebuild(grasp)
    status = np.asarray(result.status).reshape(-1)
    force = np.asarray(result.internal_force).reshape(-1, k, len(known.components)).astype(np.float64)
    twist = np.asarray(result.escape_twist).reshape(-1, 3 if dimension == 2 else 6).astype(np.float64)
    with np.errstate(all="ignore"):
        rank = _rank(known, dtype)
        slack, shift = _primal(known, rank, force)
        xi = scaled_twist(twist, known.length, dimension)
        xi = xi / np.linalg.norm(xi, axis=-1, keepdims=True)
        resistant = rank.full & (rank.smallest > rank.rounding) & (shift < slack)
        escapes = _escapes(known, rank, xi)
        # Both together: t* >= slack - shift, and t* <= upper.
        resolution = np.maximum(_claim(result, tolerance), _floor(dtype))
        small = (slack - 2 * shift >= -2 * resolution) & (_upper(known, xi) <= 2 * resolution)
    valid = known.valid
    accepted = np.select(
        [status == s for s in (RESISTANT, NOT_RESISTANT, MARGINAL, UNDECIDED, INVALID)],
        [valid & resistant, valid & escapes, valid & rank.full & small, valid, ~valid],
        default=False,
    )
    return accepted.reshape(batch)[()]


def _rank(known: Rebuilt, dtype: np.dtype) -> Rank:
    m = known.A.shape[1]
    values = np.linalg.svd(known.A, compute_uv=False)
    values = np.pad(values, [(0, 0), (0, m - values.shape[1])])
    largest = values[:, 0]
    tolerance = RANK_TOLERANCE * float(np.finfo(dtype).eps) * largest
    return Rank(values[:, -1], ROUNDING * EPS * largest, tolerance)


def _primal(known: Rebuilt, rank: Rank, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far the internal force lies inside the cones, and how far off the nearest exact one may be."""
    live = known.live
    s = scaled_force(np.where(live[..., None], force, 0.0), known.scale, known.normal_index)
    effort = np.sum(s[..., 0], -1)
    s = s * np.where(effort > 0, live.sum(-1) / effort, np.nan)[:, None, None]
    slack = np.min(np.where(live, s[..., 0] - np.linalg.norm(s[..., 1:], axis=-1), np.inf), -1)
    flat = s.reshape(len(s), -1)
    residual = np.linalg.norm(np.einsum("lij,lj->li", known.A, flat), axis=-1)
    residual = residual + rank.rounding * np.linalg.norm(flat, axis=-1)
    return slack, np.sqrt(2.0) * residual / (rank.smallest - rank.rounding)


def _velocities(known: Rebuilt, xi: np.ndarray) -> np.ndarray:
    """x_i = A_i^T xi (N, k, n), normal first."""
    return np.einsum("lkij,li->lkj", known.blocks, xi)


def _escapes(known: Rebuilt, rank: Rank, xi: np.ndarray) -> np.ndarray:
    """The twist is inside every (self-dual) cone by more than rounding, or it spans the null space of A^T."""
    x = _velocities(known, xi)
    depth = x[..., 0] - np.linalg.norm(x[..., 1:], axis=-1)
    rounding = ROUNDING * EPS * np.linalg.norm(known.blocks, axis=(-2, -1))
    inside = np.min(np.where(known.live, depth - rounding, np.inf), -1) > 0
    unseen = np.linalg.norm(np.einsum("lij,li->lj", known.A, xi), axis=-1)
    deficient = rank.smallest <= np.maximum(rank.rounding, rank.tolerance)
    return inside | (deficient & (unseen <= np.maximum(rank.rounding, 2 * rank.tolerance)))


def _upper(known: Rebuilt, xi: np.ndarray) -> np.ndarray:
    """The upper bound 1 + a.y of t* for the largest multiple of -xi that the dual admits."""
    x, live = _velocities(known, xi), known.live
    total = np.sum(np.where(live, x[..., 0], 0.0), -1)
    reach = np.max(np.where(live, np.linalg.norm(x[..., 1:], axis=-1) - x[..., 0], -np.inf), -1)
    gauge = live.sum(-1) * reach + total  # rho(-xi): that multiple is 1 / gauge
    return 1 - total / np.where(gauge > 0, gauge, np.nan)


def _claim(result, tolerance: float | None) -> np.ndarray | float:
    """The |t*| that MARGINAL claims."""
    if tolerance is not None:
        return float(tolerance)
    if not (hasattr(result, "margin") and hasattr(result, "gap")):
        return BARE_CLAIM
    margin, gap = (np.asarray(x).reshape(-1).astype(np.float64) for x in (result.margin, result.gap))
    claimed = np.maximum(np.abs(margin), np.abs(margin + gap))
    return np.where(claimed < LARGEST_CLAIM, np.maximum(claimed, BARE_CLAIM), 0.0)


def _floor(dtype: np.dtype) -> float:
    """The resolution of a dtype."""
    return 2e4 * EPS if dtype.itemsize == 8 else 160 * float(np.finfo(dtype).eps)
