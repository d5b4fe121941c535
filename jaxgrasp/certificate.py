"""The checker: every verdict proved again in float64, without trusting the solver.

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

Numpy only, and nothing else of this library: a bug elsewhere cannot make a wrong proof look right.
"""

from __future__ import annotations

import numpy as np

__all__ = ["check_certificate"]

ROUNDING = 16.0  # c
RANK_TOLERANCE = 64.0  # in units of eps of the grasp's dtype, relative to the largest singular value
RESISTANT, NOT_RESISTANT, MARGINAL, UNDECIDED, INVALID = 1, 2, 3, 4, 5
EPS = float(np.finfo(np.float64).eps)


def _frame(normal: np.ndarray) -> list[np.ndarray]:
    """Tangents of the convention the forces are written in (Duff et al. 2017; planar: t x n = +z)."""
    if normal.shape[-1] == 2:
        return [np.stack([normal[..., 1], -normal[..., 0]], -1)]
    x, y, z = np.moveaxis(normal, -1, 0)
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return [
        np.stack([1 + sign * x * x * a, sign * b, -sign * x], -1),
        np.stack([b, sign + y * y * a, -y], -1),
    ]


def _cross(p: np.ndarray, f: np.ndarray) -> np.ndarray:
    if p.shape[-1] == 2:
        return (p[..., 0] * f[..., 1] - p[..., 1] * f[..., 0])[..., None]
    return np.cross(p, f)


def _folded(position, normal, friction, torsion, components) -> np.ndarray:
    """Contact blocks (lanes, k, m, n) with the normal column first and the coefficients folded in."""
    tangents = _frame(normal)
    columns = [np.concatenate([normal, _cross(position, normal)], -1)]
    for name in components:
        if name in ("f_x", "f_y"):
            d = friction[..., None] * tangents[("f_x", "f_y").index(name)]
            columns.append(np.concatenate([d, _cross(position, d)], -1))
        elif name == "tau_n":
            columns.append(np.concatenate([np.zeros_like(normal), torsion[..., None] * normal], -1))
    return np.stack(columns, -1)


def _scaled_force(force, scale, normal_index) -> np.ndarray:
    """s with f = scale * s, normal first; infinite where a component is asked for that does not exist."""
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(force == 0, 0.0, force / scale)
    tangential = np.delete(s, normal_index, -1)
    return np.concatenate([s[..., normal_index : normal_index + 1], tangential], -1)


def check_certificate(grasp, result, tolerance: float | None = None) -> np.ndarray:
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
    components = [c.value for c in grasp.model.components(dimension)]
    n, normal_index = len(components), components.index("f_n")

    def lanes(array, *shape):
        return np.asarray(array).reshape(-1, *shape)

    position = lanes(grasp.position, k, dimension).astype(np.float64)
    normal = lanes(grasp.normal, k, dimension).astype(np.float64)
    friction = lanes(grasp.model.friction_coefficient, k).astype(np.float64)
    torsion = lanes(grasp.model.torsion_coefficient, k).astype(np.float64)
    active = lanes(grasp.active, k)
    status = lanes(result.status)
    force = lanes(result.internal_force, k, n).astype(np.float64)
    twist = lanes(result.escape_twist, m).astype(np.float64)

    with np.errstate(all="ignore"):
        size = np.max(np.abs(normal), -1)
        usable = np.isfinite(position).all(-1) & np.isfinite(normal).all(-1) & (size > 0)
        usable &= np.isfinite(friction) & np.isfinite(torsion) & (friction >= 0) & (torsion >= 0)
        valid = (usable | ~active).all(-1) & active.any(-1)
        live = active & valid[:, None]

        # Lanes and contacts that do not count get harmless numbers.
        normal = np.where(
            live[..., None], normal / np.where(size > 0, size, 1.0)[..., None], np.eye(dimension)[-1]
        )
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        position = np.where(live[..., None], position, 0.0)
        friction, torsion = np.where(live, friction, 0.0), np.where(live, torsion, 0.0)
        length = np.max(np.linalg.norm(position, axis=-1), -1)
        length = np.where(length > 0, length, 1.0)

        blocks = _folded(
            position / length[:, None, None], normal, friction, torsion / length[:, None], components
        )
        blocks = np.where(live[..., None, None], blocks, 0.0)
        A = np.moveaxis(blocks, 1, 2).reshape(len(blocks), m, k * n)
        values = np.linalg.svd(A, compute_uv=False)
        values = np.pad(values, [(0, 0), (0, m - values.shape[1])])
        largest, smallest = values[:, 0], values[:, -1]
        tiny = ROUNDING * EPS * largest
        rank_tiny = RANK_TOLERANCE * float(np.finfo(dtype).eps) * largest
        full_rank = smallest > np.maximum(tiny, rank_tiny)

        # Primal evidence: how far the nearest exact internal force can leave the cones (yes), and its margin.
        by_component = {"f_x": friction, "f_y": friction, "f_n": np.ones_like(friction), "tau_n": torsion}
        scale = np.stack([by_component[c] for c in components], -1)
        s = _scaled_force(np.where(live[..., None], force, 0.0), scale, normal_index)
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
