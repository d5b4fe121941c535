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

The dual functions are in ``criteria``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .criteria import Asked, Multipliers, cost, lower_bound, robust_sensitivity
from .proof import LEVELS, Proof
from .rebuilt import EPS, ROUNDING, Rebuilt, rebuild, scaled_force, scaled_twist, scaled_wrench

__all__ = ["check_forces", "prove_forces"]

INVALID, OPTIMAL, INFEASIBLE, STALLED = 5, 6, 7, 8
LIMIT = 1e6  # loads
FINE = 256.0  # rounding, in units of eps of the grasp's dtype, that forces may show
CLOSE = 1e-6  # relative gap that OPTIMAL may leave


class Told(NamedTuple):
    """What a result claims of N lanes: forces (N, k, n), twists (N, m), rates (N, q), the rest (N,)."""

    force: np.ndarray
    cost: np.ndarray
    bound: np.ndarray
    load_twist: np.ndarray
    escape_twist: np.ndarray
    joint_rates: np.ndarray


class Sizes(NamedTuple):
    """What rounding is relative to (N,): of the forces, the load, A; and ``reach`` (N, q) of the torques."""

    force: np.ndarray
    load: np.ndarray
    A: np.ndarray
    reach: np.ndarray


def prove_forces(grasp, result, tolerance: float | None = None) -> Proof:
    """What the evidence proves; shape of ``result.status``."""
    accepted = np.asarray(check_forces(grasp, result, tolerance))
    nan = np.full(accepted.shape, np.nan)
    return Proof(
        LEVELS[accepted.astype(int)], np.where(accepted, 0.0, np.inf), nan, nan, np.zeros(accepted.shape)
    )


def check_forces(grasp, result, tolerance: float | None = None) -> np.ndarray:
    """True for each lane whose answer the evidence proves; shape of ``result.status``."""
    shape = np.shape(result.status)
    status = np.asarray(result.status).reshape(-1)
    with np.errstate(all="ignore"):
        asked = _asked(grasp, result)
        told = _told(asked, result)
        fine = FINE * float(np.finfo(np.dtype(grasp.position.dtype)).eps)
        smoothing = getattr(result, "smoothing", 0.0) or 0.0
        optimal = _optimal(asked, told, fine, CLOSE if tolerance is None else tolerance, smoothing)
        infeasible = _infeasible(asked, told)
    accepted = np.select(
        [status == OPTIMAL, status == INFEASIBLE, status == STALLED, status == INVALID],
        [asked.valid & optimal, asked.valid & infeasible, asked.valid, ~asked.valid],
        default=False,
    )
    return accepted.reshape(shape)[()]


def _asked(grasp, result) -> Asked:
    """The problem, from the grasp and from what the result says was asked."""
    shape, dimension, k = np.shape(result.status), grasp.position.shape[-1], grasp.position.shape[-2]
    lanes = int(np.prod(shape))
    known = _repeated(rebuild(grasp), lanes // max(int(np.prod(grasp.position.shape[:-2])), 1))
    live, n = known.live, len(known.components)

    def rows(array, *own):
        return np.asarray(array, np.float64).reshape(lanes, *own)

    wrench = rows(result.wrench, 3 if dimension == 2 else 6)
    cap = np.full((lanes, k), np.inf) if result.max_normal is None else rows(result.max_normal, k)
    valid = known.valid & np.isfinite(wrench).all(-1) & ((cap > 0) | ~live).all(-1)
    parameters = {name: getattr(result.criterion, name, None) for name in ("weight", "length")}
    for name, value in parameters.items():
        if value is not None:
            value = rows(np.broadcast_to(value, shape))
            valid &= np.isfinite(value) & (value > 0)
            parameters[name] = value
    jacobian, torque = np.zeros((lanes, k, n, 0)), np.zeros((lanes, 0))
    if result.torque_limits is not None:
        jacobian = rows(result.torque_limits[0], k, n, np.shape(result.torque_limits[0])[-1])
        torque = rows(result.torque_limits[1], jacobian.shape[-1])
        valid &= (torque > 0).all(-1)  # infinite: no limit; NaN compares false
        valid &= (np.isfinite(jacobian).all((-1, -2)) | ~live).all(-1)
        jacobian = np.where(live[..., None, None], jacobian, 0.0)
    return Asked(
        known=known,
        name=type(result.criterion).__name__,
        cap=np.where(live, cap, np.inf),
        jacobian=jacobian,
        torque=torque,
        load=scaled_wrench(wrench, known.length, dimension),
        valid=valid,
        dimension=dimension,
        **parameters,
    )


def _repeated(known: Rebuilt, loads: int) -> Rebuilt:
    """Each grasp once for each of its loads."""
    if loads == 1:
        return known
    arrays = {name: x for name, x in known._asdict().items() if isinstance(x, np.ndarray)}
    return known._replace(**{name: np.repeat(x, loads, axis=0) for name, x in arrays.items()})


def _told(asked: Asked, result) -> Told:
    live, m, q = asked.known.live, asked.load.shape[-1], asked.torque.shape[-1]
    lanes, k, n = *live.shape, len(asked.known.components)

    def rows(array, *own):
        return np.asarray(array, np.float64).reshape(lanes, *own)

    force = np.where(live[..., None], rows(result.force, k, n), 0.0)
    twists = rows(result.load_twist, m), rows(result.escape_twist, m)
    return Told(force, rows(result.cost), rows(result.bound), *twists, rows(result.joint_rates, q))


def _multipliers(asked: Asked, twist: np.ndarray, rates: np.ndarray) -> Multipliers:
    y = scaled_twist(twist, asked.known.length, asked.dimension)
    x = np.einsum("lkij,li->lkj", asked.known.blocks, y)
    return Multipliers(y, rates, x + np.einsum("lkcj,lj->lkc", asked.scaled_jacobian(), rates))


def _optimal(asked: Asked, told: Told, fine: float, tolerance: float, smoothing: float) -> np.ndarray:
    """The forces are admissible and balanced, at the stated cost, which the bound nearly reaches."""
    s = scaled_force(told.force, asked.known.scale, asked.known.normal_index)
    total = np.linalg.norm(s.reshape(len(s), -1), axis=-1)
    sizes = Sizes(
        total,
        np.linalg.norm(asked.load, axis=-1),
        np.linalg.norm(asked.known.A, axis=(-2, -1)),
        np.linalg.norm(asked.scaled_jacobian(), axis=(1, 2)) * total[:, None],
    )
    value, scale = cost(asked, s)
    multipliers = _multipliers(asked, told.load_twist, told.joint_rates)
    best = lower_bound(asked, multipliers, s)
    # No forces for no load: nothing is cheaper than 0.
    best = np.where((total == 0) & (sizes.load == 0) & (asked.weight is None), 0.0, best)
    # What evaluating a bound from large multipliers can lose to rounding.
    power = np.linalg.norm(multipliers.y, axis=-1) * (sizes.load + sizes.A * total)
    limits = np.where(np.isfinite(asked.torque), asked.torque, 0.0)
    power = power + np.sum(np.abs(told.joint_rates) * (limits + sizes.reach), -1)
    relative = np.maximum(scale, np.abs(value))
    room = fine * relative
    allowed = tolerance * relative + room
    allowed = np.maximum(allowed, 4 * smoothing * (3 * s.shape[1] + 2 * asked.torque.shape[-1]))
    return (
        _admissible(asked, told.force, s, sizes, fine)
        & (np.abs(value - told.cost) <= room + fine * robust_sensitivity(asked, s))
        & (told.bound <= best + room + fine * power)
        & (value - np.minimum(best, told.bound) <= allowed + room + fine * power)
    )


def _admissible(asked: Asked, force: np.ndarray, s: np.ndarray, sizes: Sizes, fine: float) -> np.ndarray:
    """``A s + w = 0``, ``s_0 >= |s_t|``, ``s_0 <= cap``, ``|J^T f| <= tau``, all to rounding."""
    live, edge = asked.known.live, fine * sizes.force[:, None]
    applied = np.einsum("lij,lj->li", asked.known.A, s.reshape(len(s), -1))
    residual = np.linalg.norm(applied + asked.load, axis=-1)
    tails = np.linalg.norm(s[..., 1:], axis=-1)
    torques = np.einsum("lkcj,lkc->lj", asked.jacobian, force)
    return (
        (residual <= fine * (sizes.A * sizes.force + sizes.load))
        & (np.where(live, s[..., 0] - tails, 0.0) >= -edge).all(-1)
        & (np.where(live, s[..., 0] - asked.cap, -np.inf) <= edge).all(-1)
        & (np.abs(torques) <= asked.torque + fine * (sizes.reach + asked.torque)).all(-1)
    )


def _infeasible(asked: Asked, told: Told) -> np.ndarray:
    """The load does more work along the twist than any admissible forces can take up."""
    known, jacobian = asked.known, asked.scaled_jacobian()
    # A proof may be scaled by any positive number: to size 1, so that nothing overflows.
    largest = np.max(np.abs(np.concatenate([told.escape_twist, told.joint_rates], -1)), -1, keepdims=True)
    xi, rates, x = _multipliers(asked, told.escape_twist / largest, told.joint_rates / largest)
    speed, size = np.linalg.norm(xi, axis=-1), np.linalg.norm(asked.load, axis=-1)
    blur = np.linalg.norm(known.blocks, axis=(-2, -1)) * speed[:, None]
    blur = blur + np.linalg.norm(jacobian, axis=(-2, -1)) * np.linalg.norm(rates, axis=-1)[:, None]
    violation = np.linalg.norm(x[..., 1:], axis=-1) - x[..., 0] + ROUNDING * EPS * blur
    most = np.minimum(asked.cap, LIMIT * size[:, None])
    taken = np.sum(np.where(known.live, np.maximum(violation, 0.0) * most, 0.0), -1)
    taken = taken + asked.joint_work(rates)
    return np.sum(xi * asked.load, -1) - ROUNDING * EPS * speed * size > taken
