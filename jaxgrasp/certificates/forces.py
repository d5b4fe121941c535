"""Optimal forces and infeasible loads proved again (theory section 3).

With the folded map A (lengths over L), the forces s (f = mu s, gamma s, s), the load w and x_i = A_i^T y + J_i beta for
the twist y and the joint rates beta of the result:

    OPTIMAL     A s + w is rounding, s_0,i >= |s_t,i|, s_0,i <= cap_i, |J^T f| <= tau_max, all to rounding; the cost
                is the criterion at f; the dual function at (y, beta), in closed form below, reaches the claimed
                bound; and cost and bound are close
    INFEASIBLE  y.w > sum_i min(cap_i, 1e6 |w|) (|x_t,i| - x_0,i)+ + sum_j |beta_j| tau_j: the load does more work along
                y than any admissible forces (up to a million times the load) can take up
    INVALID     the numbers are indeed no problem
    STALLED     claims nothing, so there is nothing to refute

Lower bounds, for any y, with gain = y.w - sum_j |beta_j| tau_j and rho_i = |x_t,i| - x_0,i:

    sum          gain / max rho,  or  gain - sum_i cap_i (rho_i - 1)+
    gentlest     gain / sum rho+, or  gain - sum_i cap_i (rho_i - lambda_i)+ for the best lambda >= 0 of sum 1
    quadratic    gain + sum_i min_{0 <= s <= cap_i} (s^2 - rho'_i s) - s_t D s_t / 2: the tails' cost replaced by its
                 tangent at the given forces, which a convex cost never falls below
    robust       gain - sum_i cap_i alpha_i + sum_i of the conjugates of the barrier's pieces
"""

from __future__ import annotations

import numpy as np

from .rebuilt import EPS, ROUNDING, Rebuilt, rebuild, scaled_force

__all__ = ["check_forces"]

INVALID, OPTIMAL, INFEASIBLE, STALLED = 5, 6, 7, 8
LIMIT = 1e6  # loads
FINE = 256.0  # rounding, in units of eps of the grasp's dtype, that forces may show
CLOSE = 1e-6  # relative gap that OPTIMAL may leave


def _spread(array: np.ndarray, loads: int) -> np.ndarray:
    return np.repeat(array, loads, axis=0) if loads != 1 else array


def _top_share(short: np.ndarray, cap: np.ndarray, total: float = 1.0) -> np.ndarray:
    """The part of ``short`` (N, k) that lambda of sum 1 should cover: the dearest caps first."""
    order = np.argsort(-cap, axis=-1, kind="stable")
    sorted_short = np.take_along_axis(short, order, -1)
    before = np.cumsum(sorted_short, -1) - sorted_short
    covered = np.clip(total - before, 0.0, sorted_short)
    out = np.zeros_like(short)
    np.put_along_axis(out, order, covered, -1)
    return out


def _paid(left: np.ndarray, cap: np.ndarray, room: float) -> np.ndarray:
    """``sum cap left``, where what is rounding beside 1 costs nothing without a cap."""
    free = ~np.isfinite(cap) & (left <= room)
    return np.sum(np.where(free | (left <= 0), 0.0, left * cap), -1)


def _log_det_terms(known: Rebuilt, dimension: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """log det P = a log f_n + b log(f_n^2 - psi^2) + c per contact, (11.4), (11.35)."""
    mu, rough = known.friction, known.friction > 0
    if known.components == ["f_n"]:
        return np.ones_like(mu), np.zeros_like(mu), np.zeros_like(mu)
    if "tau_n" in known.components:
        return np.where(rough, 2.0, 1.0), rough * 1.0, np.zeros_like(mu)
    constant = dimension * np.log(np.where(rough, mu, 1.0))
    return np.where(rough, dimension - 2.0, 1.0), rough * 1.0, constant


def _curvatures(known: Rebuilt, name: str, length) -> np.ndarray:
    """D / 2 per component, normal first (N, k, n)."""
    parts = [np.ones_like(known.friction)]
    for component in known.components:
        if component == "f_n":
            continue
        if name == "SumOfSquares":
            parts.append(np.zeros_like(known.friction))
        elif component == "tau_n":
            parts.append(
                np.ones_like(known.torsion) if length is None else (known.torsion / length[:, None]) ** 2
            )
        else:
            parts.append(known.friction**2)
    return np.stack(parts, -1)


def check_forces(grasp, result, tolerance: float | None = None) -> np.ndarray:
    """True for each lane whose answer the evidence proves; shape of ``result.status``."""
    dtype = np.dtype(grasp.position.dtype)
    dimension, k = grasp.position.shape[-1], grasp.position.shape[-2]
    m = 3 if dimension == 2 else 6
    shape = np.shape(result.status)
    grasps = int(np.prod(grasp.position.shape[:-2]))
    lanes_total = int(np.prod(shape))
    loads = lanes_total // max(grasps, 1)
    known = rebuild(grasp)
    arrays = {name: _spread(x, loads) for name, x in known._asdict().items() if isinstance(x, np.ndarray)}
    known = known._replace(**arrays)
    n, live = len(known.components), known.live
    eps = float(np.finfo(dtype).eps)

    def lanes(array, *own):
        return np.asarray(array, np.float64).reshape(lanes_total, *own)

    status = np.asarray(result.status).reshape(-1)
    force, wrench = lanes(result.force, k, n), lanes(result.wrench, m)
    cost, bound = lanes(result.cost), lanes(result.bound)
    name = type(result.criterion).__name__
    weight = getattr(result.criterion, "weight", None)
    length = getattr(result.criterion, "length", None)
    weight = None if weight is None else lanes(np.broadcast_to(weight, shape))
    length = None if length is None else lanes(np.broadcast_to(length, shape))
    cap = np.full((lanes_total, k), np.inf) if result.max_normal is None else lanes(result.max_normal, k)

    with np.errstate(all="ignore"):
        valid = known.valid & np.isfinite(wrench).all(-1) & ((cap > 0) | ~live).all(-1)
        for parameter in (weight, length):
            if parameter is not None:
                valid &= np.isfinite(parameter) & (parameter > 0)
        if result.torque_limits is not None:
            jacobian = lanes(result.torque_limits[0], k, n, np.shape(result.torque_limits[0])[-1])
            torque = lanes(result.torque_limits[1], jacobian.shape[-1])
            valid &= np.isfinite(torque).all(-1) & (torque > 0).all(-1)
            finite = np.isfinite(jacobian).all((-1, -2)) | ~live
            valid &= finite.all(-1)
            jacobian = np.where(live[..., None, None], jacobian, 0.0)
        else:
            jacobian, torque = np.zeros((lanes_total, k, n, 0)), np.zeros((lanes_total, 0))
        cap = np.where(live, cap, np.inf)
        load = np.concatenate([wrench[:, :dimension], wrench[:, dimension:] / known.length[:, None]], -1)
        size = np.linalg.norm(load, axis=-1)
        order = [known.normal_index, *(j for j in range(n) if j != known.normal_index)]
        folded_jacobian = (jacobian * known.scale[..., None])[:, :, order]

        # The forces: balanced, inside every cone, under every limit, at the stated cost.
        force = np.where(live[..., None], force, 0.0)
        s = scaled_force(force, known.scale, known.normal_index)
        total = np.linalg.norm(s.reshape(lanes_total, -1), axis=-1)
        norm = np.linalg.norm(known.A, axis=(-2, -1))
        residual = np.linalg.norm(
            np.einsum("lij,lj->li", known.A, s.reshape(lanes_total, -1)) + load, axis=-1
        )
        fine = FINE * eps
        met = residual <= fine * (norm * total + size)
        tails = np.linalg.norm(s[..., 1:], axis=-1)
        met &= (np.where(live, s[..., 0] - tails, 0.0) >= -fine * total[:, None]).all(-1)
        met &= (np.where(live, s[..., 0] - cap, -np.inf) <= fine * total[:, None]).all(-1)
        torques = np.einsum("lkcj,lkc->lj", jacobian, force)
        reach = np.linalg.norm(folded_jacobian, axis=(1, 2)) * total[:, None]
        met &= (np.abs(torques) <= torque + fine * (reach + torque)).all(-1)

        twist, rates = lanes(result.load_twist, m), lanes(result.joint_rates, torque.shape[-1])
        y = np.concatenate([twist[:, :dimension], twist[:, dimension:] * known.length[:, None]], -1)
        value, scale = _cost(known, name, s, weight, length, dimension)
        best = _bound(known, name, s, weight, length, cap, torque, folded_jacobian, load, y, rates, dimension)
        # What evaluating a bound from large multipliers can lose to rounding.
        power = np.linalg.norm(y, axis=-1) * (size + norm * total) + np.sum(
            np.abs(rates) * (torque + reach), -1
        )
        idle = total == 0  # no forces for no load: nothing is cheaper than 0
        best = np.where(idle & (size == 0) & (weight is None), 0.0, best)
        room = fine * np.maximum(scale, np.abs(value))
        allowed = (CLOSE if tolerance is None else tolerance) * np.maximum(scale, np.abs(value)) + room
        smooth = getattr(result, "smoothing", 0.0) or 0.0
        allowed = np.maximum(allowed, 4 * smooth * (3 * k + 2 * torque.shape[-1]))
        optimal = (
            met
            & (np.abs(value - cost) <= room + fine * _logarithmic(known, name, s, weight, dimension))
            & (bound <= best + room + fine * power)
            & (value - np.minimum(best, bound) <= allowed + room + fine * power)
        )

        # The twist: more work than any admissible forces can take up.
        escape = lanes(result.escape_twist, m)
        xi = np.concatenate([escape[:, :dimension], escape[:, dimension:] * known.length[:, None]], -1)
        x = np.einsum("lkij,li->lkj", known.blocks, xi) + np.einsum("lkcj,lj->lkc", folded_jacobian, rates)
        blur = np.linalg.norm(known.blocks, axis=(-2, -1)) * np.linalg.norm(xi, axis=-1)[:, None]
        blur = blur + np.linalg.norm(folded_jacobian, axis=(-2, -1)) * np.linalg.norm(rates, axis=-1)[:, None]
        short = np.linalg.norm(x[..., 1:], axis=-1) - x[..., 0] + ROUNDING * EPS * blur
        most = np.minimum(cap, LIMIT * size[:, None])
        taken = np.sum(np.where(live, np.maximum(short, 0.0) * most, 0.0), -1) + np.abs(rates * torque).sum(
            -1
        )
        power = np.sum(xi * load, -1) - ROUNDING * EPS * np.linalg.norm(xi, axis=-1) * size
        infeasible = power > taken

    accepted = np.select(
        [status == OPTIMAL, status == INFEASIBLE, status == STALLED, status == INVALID],
        [valid & optimal, valid & infeasible, valid, ~valid],
        default=False,
    )
    return accepted.reshape(shape)[()]


def _cost(known: Rebuilt, name: str, s, weight, length, dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """The criterion, and the size that rounding is relative to."""
    head, live = s[..., 0], known.live
    top = np.max(np.where(live, head, -np.inf), -1)
    if name == "Gentlest":
        return top, np.abs(top)
    if name == "SmallestSum":
        value = np.sum(np.where(live, head, 0.0), -1)
        return value, np.abs(value)
    if name == "Robust":
        a, b, c = _log_det_terms(known, dimension)
        tail = np.linalg.norm(s[..., 1:], axis=-1)
        log_det = a * np.log(np.where(live, head, 1.0)) + c
        log_det += np.where(b > 0, b * np.log(np.where(live, (head - tail) * (head + tail), 1.0)), 0.0)
        logs = np.where(live, log_det, 0.0)
        return top - weight * logs.sum(-1), np.abs(top) + weight * (1 + np.abs(logs).sum(-1))
    value = np.sum(np.where(live[..., None], _curvatures(known, name, length) * s * s, 0.0), (-1, -2))
    return value, value


def _logarithmic(known: Rebuilt, name: str, s, weight, dimension: int) -> np.ndarray | float:
    """What a relative error of the forces is worth in the robust cost: ``weight sum b f_n / (f_n - psi)``."""
    if name != "Robust":
        return 0.0
    _, b, _ = _log_det_terms(known, dimension)
    head, tail = s[..., 0], np.linalg.norm(s[..., 1:], axis=-1)
    counted = known.live & (b > 0) & (head > tail)
    return weight * np.sum(np.where(counted, b * head / np.where(counted, head - tail, 1.0), 0.0), -1)


def _bound(known, name, s, weight, length, cap, torque, jacobian, load, y, rates, dimension) -> np.ndarray:
    """A lower bound of every admissible force's cost, from the twist y and the joint rates (formulas above)."""
    live = known.live
    x = np.einsum("lkij,li->lkj", known.blocks, y) + np.einsum("lkcj,lj->lkc", jacobian, rates)
    gain = np.sum(y * load, -1) - np.sum(np.abs(rates) * torque, -1)
    tail = np.linalg.norm(x[..., 1:], axis=-1)
    rho = np.where(live, tail - x[..., 0], 0.0)
    if name in ("SmallestSum", "Gentlest"):
        short = np.maximum(rho, 0.0)
        largest = short.max(-1) if name == "SmallestSum" else short.sum(-1)
        scaled = np.where(largest > 0, gain / np.where(largest > 0, largest, 1.0), 0.0)
        if name == "SmallestSum":
            left = np.maximum(short - 1.0, 0.0)
        else:
            left = short - _top_share(short, cap)
        paid = gain - _paid(left, cap, 0.0)
        return np.maximum(np.maximum(scaled, paid), 0.0)
    if name == "Robust":
        return _robust_bound(known, s, weight, cap, x, gain, dimension)
    half = _curvatures(known, name, length)
    pushed = 2 * half[..., 1:] * s[..., 1:]
    rho = np.maximum(np.linalg.norm(x[..., 1:] + pushed, axis=-1) - x[..., 0], 0.0)
    spent = np.sum(pushed * s[..., 1:], -1)
    best = np.minimum(rho / 2, cap)
    return gain + np.sum(np.where(live, best * best - rho * best - spent / 2, 0.0), -1)


def _robust_bound(known: Rebuilt, s, weight, cap, x, gain, dimension: int) -> np.ndarray:
    live = known.live
    a, b, c = _log_det_terms(known, dimension)
    phi, psi = 2 * weight[:, None] * b, weight[:, None] * a
    head = np.where(live, s[..., 0], 0.0)
    level = np.minimum(head.max(-1, keepdims=True), cap)
    x_tail = np.linalg.norm(x[..., 1:], axis=-1)
    z_head = np.where(phi > 0, (phi + np.hypot(phi, 2 * level * x_tail)) / (2 * level), x_tail)
    needed = np.where(live, np.maximum(z_head + psi / level - x[..., 0], 0.0), 0.0)
    p = psi / np.where(live & (needed <= 0), s[..., 0], level)
    share = _top_share(needed, cap)
    alpha = np.where(np.isfinite(cap), needed - share, 0.0)
    leads = live & (head >= head.max(-1, keepdims=True))
    spare = np.maximum(1.0 - share.sum(-1, keepdims=True), 0.0) * leads / leads.sum(-1, keepdims=True)
    z_head = share + spare + alpha + x[..., 0]
    # A contact without barrier only needs z in its cone.
    p = np.where(phi > 0, p, z_head - x_tail)
    z_head = z_head - p
    z_det = (z_head - x_tail) * (z_head + x_tail)

    def conjugate(floor, value, power):
        safe = np.where(floor > 0, floor, 1.0)
        logs = np.where(value > 0, np.log(np.where(value > 0, value, 1.0)), -np.inf)
        return np.where(floor > 0, safe - safe * np.log(safe) + power * safe * logs, 0.0)

    pieces = conjugate(phi, np.where(z_head > x_tail, z_det, 0.0), 0.5) + conjugate(psi, p, 1.0)
    pieces = pieces - weight[:, None] * c
    paid = np.sum(np.where(alpha > 0, alpha * np.where(np.isfinite(cap), cap, 0.0), 0.0), -1)
    return gain - paid + np.sum(np.where(live, pieces, 0.0), -1)
