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

import numpy as np

from .rebuilt import EPS, RANK_TOLERANCE, ROUNDING, rebuild, scaled_force

__all__ = ["check_resistance"]

RESISTANT, NOT_RESISTANT, MARGINAL, UNDECIDED, INVALID = 1, 2, 3, 4, 5


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
    m = 3 if dimension == 2 else 6
    known = rebuild(grasp)
    valid, live, length, blocks, A = known.valid, known.live, known.length, known.blocks, known.A
    n = len(known.components)

    def lanes(array, *shape):
        return np.asarray(array).reshape(-1, *shape)

    status = lanes(result.status)
    force = lanes(result.internal_force, k, n).astype(np.float64)
    twist = lanes(result.escape_twist, m).astype(np.float64)

    with np.errstate(all="ignore"):
        values = np.linalg.svd(A, compute_uv=False)
        values = np.pad(values, [(0, 0), (0, m - values.shape[1])])
        largest, smallest = values[:, 0], values[:, -1]
        tiny = ROUNDING * EPS * largest
        rank_tiny = RANK_TOLERANCE * float(np.finfo(dtype).eps) * largest
        full_rank = smallest > np.maximum(tiny, rank_tiny)

        # Primal evidence: how far the nearest exact internal force can leave the cones (yes), and its margin.
        s = scaled_force(np.where(live[..., None], force, 0.0), known.scale, known.normal_index)
        effort = np.sum(s[..., 0], -1)
        s = s * np.where(effort > 0, live.sum(-1) / effort, np.nan)[:, None, None]
        slack = np.min(np.where(live, s[..., 0] - np.linalg.norm(s[..., 1:], axis=-1), np.inf), -1)
        residual = np.linalg.norm(np.einsum("lij,lj->li", A, s.reshape(len(s), -1)), axis=-1)
        residual = residual + tiny * np.linalg.norm(s.reshape(len(s), -1), axis=-1)
        shift = np.sqrt(2.0) * residual / (smallest - tiny)
        resistant = full_rank & (smallest > tiny) & (shift < slack)

        # Dual evidence: the twist's slack in the dual cones, in the metric (v, L omega).
        xi = np.concatenate([twist[:, :dimension], twist[:, dimension:] * length[:, None]], -1)
        xi = xi / np.linalg.norm(xi, axis=-1, keepdims=True)
        x = np.einsum("lkij,li->lkj", blocks, xi)
        block_norm = np.linalg.norm(blocks, axis=(-2, -1))
        depth = x[..., 0] - np.linalg.norm(x[..., 1:], axis=-1)
        escapes = np.min(np.where(live, depth - ROUNDING * EPS * block_norm, np.inf), -1) > 0
        unseen = np.linalg.norm(np.einsum("lij,li->lj", A, xi), axis=-1)
        rank_deficient = (smallest <= np.maximum(tiny, rank_tiny)) & (
            unseen <= np.maximum(tiny, 2 * rank_tiny)
        )
        escapes |= rank_deficient

        # Both together: t* >= slack - shift, and t* <= 1 + a.y for the multiple of -xi that the dual admits.
        if tolerance is None and not (hasattr(result, "margin") and hasattr(result, "gap")):
            tolerance = 1e-8  # bare evidence claims no bracket
        if tolerance is None:
            margin, gap = lanes(result.margin).astype(np.float64), lanes(result.gap).astype(np.float64)
            claimed = np.maximum(np.abs(margin), np.abs(margin + gap))
            claim = np.where(claimed < 1e-3, np.maximum(claimed, 1e-8), 0.0)
        else:
            claim = np.full(len(status), float(tolerance))
        floor = 2e4 * EPS if dtype.itemsize == 8 else 160 * float(np.finfo(dtype).eps)
        resolution = np.maximum(claim, floor)
        lower = slack - 2 * shift
        total = np.sum(np.where(live, x[..., 0], 0.0), -1)
        reach = np.max(np.where(live, np.linalg.norm(x[..., 1:], axis=-1) - x[..., 0], -np.inf), -1)
        gauge = live.sum(-1) * reach + total  # rho(-xi): largest multiple admitted is 1 / gauge
        upper = 1 - total / np.where(gauge > 0, gauge, np.nan)
        marginal = full_rank & (lower >= -2 * resolution) & (upper <= 2 * resolution)

    accepted = np.select(
        [
            status == RESISTANT,
            status == NOT_RESISTANT,
            status == MARGINAL,
            status == UNDECIDED,
            status == INVALID,
        ],
        [valid & resistant, valid & escapes, valid & marginal, valid, ~valid],
        default=False,
    )
    return accepted.reshape(batch)[()]
