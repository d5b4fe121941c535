"""Optimal forces and infeasible loads proved again (theory section 3).

With the folded map A (lengths over L), the forces s (f = mu s, gamma s, s), the load w and x_i = A_i^T y + J_i beta for
the twist y and the joint rates beta of the answer:

    OPTIMAL     the forces given are admissible and balance the load, to rounding; ``upper`` is what they cost, exact
                forces next to them cost hardly more; the dual function at (y, beta), in closed form, reaches
                ``lower``; and both are close
    STALLED     the same of each end of the bracket that is finite
    INFEASIBLE  the load does more work along the escape twist than admissible forces can take up (``separation``)
    INVALID     the numbers are indeed no problem

What may show as rounding depends on the problem alone: 256 eps of the dtype, of the cost's own terms. Where exact
forces cannot be shown (the rank is not full, or there is no interior), the answer may hold to rounding: for a load so
near that forces pulled onto their cones and limits balance it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .criteria import Asked, Multipliers, cost, cost_change, lower_bound, robust_sensitivity
from .force_problem import ForceProblem, force_problem
from .interior import edges_of, exact_forces
from .proof import LEVELS, Proof
from .reading import Fields
from .rebuilt import EPS, scaled_force, scaled_twist
from .separation import prove_separation

__all__ = ["prove_forces"]

INVALID, OPTIMAL, INFEASIBLE, STALLED = 5, 6, 7, 8
FINE = 256.0  # rounding, in units of eps of the grasp's dtype, that forces and costs may show
ENDS = 4096.0  # eps of float64: what both ends of a bracket may lack
NEARBY = 64.0  # eps: how far numbers may lie of which a proof to rounding speaks
BLURRED = 1e-9  # of the cost: what rounding of forces near the edge may do to it in float64
CLOSE = {8: 1e-6, 4: 2e-3}  # relative gap that OPTIMAL may leave, by the bytes of a number


class Claim(NamedTuple):
    """What N lanes say, in the problem's units: s (N, k, n), twists (N, m) over L, rates (N, q), the rest (N,).

    Beside the escape twist, which has any size, the joint rates are those of ``escape_rates``.
    """

    status: np.ndarray
    s: np.ndarray
    upper: np.ndarray
    lower: np.ndarray
    load_twist: np.ndarray
    escape_twist: np.ndarray
    joint_rates: np.ndarray
    escape_rates: np.ndarray


class Shown(NamedTuple):
    """What is proved of each lane (N,): a cost that exact forces reach, and one that none undercuts.

    distance  of the problem of which it is true, from the one given
    moved     share of the largest force by which the exact forces differ
    """

    upper: np.ndarray
    lower: np.ndarray
    distance: np.ndarray
    moved: np.ndarray


def prove_forces(grasp, answer, problem, tolerance: float | None = None) -> Proof:
    """What the evidence of ``answer`` proves of the problem; shapes (*batch, *loads)."""
    with np.errstate(all="ignore"):
        posed = force_problem(grasp, problem)
        asked, claim = posed.asked, _claim(posed, answer)
        dtype = np.dtype(grasp.position.dtype)
        eps, close = float(np.finfo(dtype).eps), CLOSE[dtype.itemsize] if tolerance is None else tolerance
        level, shown = _held(posed, claim, eps, close, getattr(problem, "smoothing", 0.0))
        lost = asked.valid & (claim.status == INFEASIBLE) & (claim.lower == np.inf) & (claim.upper == np.inf)
        lost &= (claim.s == 0).all((-1, -2)) & np.isfinite(claim.escape_rates).all(-1)
        # Nothing is said beside what is claimed.
        lost &= (claim.load_twist == 0).all(-1)
        level = np.where((claim.escape_twist == 0).all(-1), level, 0)
        out, off = prove_separation(
            asked, posed.wrench, claim.escape_twist, claim.escape_rates, NEARBY * eps, lost
        )
        level, distance = np.where(lost, out, level), np.where(lost, off, shown.distance)
        nothing = np.isnan(claim.lower) & np.isnan(claim.upper) & np.isnan(claim.s).all((-1, -2))
        nothing &= np.isnan(claim.load_twist).all(-1) & np.isnan(claim.escape_twist).all(-1)
        level = np.where(~asked.valid & (claim.status == INVALID) & nothing, 2, level)
        unit = posed.cost_unit
        known = (level > 0) & ~lost & asked.valid
        rest = np.where((level > 0) & lost, np.inf, np.nan)
        lower, upper = (np.where(known, x * unit, rest) for x in (shown.lower, shown.upper))
    distance = np.where(level == 2, 0.0, np.where(level == 1, distance, np.inf))
    moved = np.where(known & (claim.status == OPTIMAL), shown.moved, 0.0)
    return Proof(*(x.reshape(posed.shape) for x in (LEVELS[level], distance, lower, upper, moved)))


def _in_units(value: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """``value / unit``; NaN where a finite number becomes an infinite one, which says something else."""
    scaled = value / unit
    return np.where(np.isinf(scaled) & np.isfinite(value), np.nan, scaled)


def _claim(posed: ForceProblem, answer) -> Claim:
    asked, said = posed.asked, Fields(answer, posed.shape)
    k, n = asked.known.scale.shape[1:]
    m, q = asked.load.shape[-1], asked.torque.shape[-1]
    force = said.numbers("force", k * n).reshape(-1, k, n) / posed.unit[:, None, None]
    # What does not exist presses nothing; an answer that says otherwise is refused.
    force = np.where(asked.known.live[..., None] | (force == 0) | ~asked.valid[:, None, None], force, np.nan)
    # A squared cost has multipliers in units of force, the others have none.
    back = np.where(posed.cost_unit == posed.unit, 1.0, posed.unit)[:, None]
    length = asked.known.length
    return Claim(
        said.integers("status"),
        scaled_force(force, asked.known.scale, asked.known.normal_index),
        _in_units(said.numbers("upper"), posed.cost_unit),
        _in_units(said.numbers("lower"), posed.cost_unit),
        scaled_twist(said.numbers("load_twist", m), length, asked.dimension) / back,
        scaled_twist(said.numbers("escape_twist", m), length, asked.dimension),
        said.numbers("joint_rates", q) / back,
        said.numbers("joint_rates", q),
    )


def _held(
    posed: ForceProblem, claim: Claim, eps: float, tolerance: float, smoothing: float
) -> tuple[np.ndarray, Shown]:
    """Levels of OPTIMAL and STALLED lanes, and what is proved of their cost."""
    asked, fine = posed.asked, FINE * eps
    value, size = cost(asked, claim.s)
    size = np.maximum(size, np.abs(value))
    # Forces on the edge of a cone have no cost to speak of: what they may blur is bounded.
    blur = fine * (size + np.minimum(robust_sensitivity(asked, claim.s), max(16.0, BLURRED / fine) * size))
    room = np.maximum(blur, ENDS * EPS * size)
    limits = 3 * claim.s.shape[1] + 2 * asked.torque.shape[-1]
    allowed = np.maximum(tolerance * size, 4 * (smoothing / posed.cost_unit) * limits) + 4 * room
    ordered = asked.valid & (claim.lower <= claim.upper)
    # Where squares overflow nothing is compared.
    said = np.isfinite(blur) & (np.abs(value - claim.upper) <= blur)

    def fits(shown: Shown) -> np.ndarray:
        cheap = said & np.isfinite(shown.upper)
        # A lower end alone must not gain by forces that are far too large.
        near = np.abs(shown.lower) if asked.weight is None else np.abs(shown.lower) + asked.weight
        alone = np.minimum(room, max(fine, ENDS * EPS) * near)
        dear = claim.lower <= shown.lower + np.where(cheap & (claim.status == OPTIMAL), room, alone)
        width = np.maximum(claim.upper, shown.upper) - np.minimum(claim.lower, shown.lower)
        optimal = (claim.status == OPTIMAL) & cheap & dear & (width <= allowed)
        stalled = (claim.status == STALLED) & (dear | (claim.lower == -np.inf))
        return ordered & (optimal | (stalled & (cheap | (claim.upper == np.inf))))

    exactly, nearly = _shown(asked, claim, eps)
    # No forces for no load: nothing is cheaper than 0.
    rest = ~claim.s.any((-1, -2)) & ~asked.load.any(-1) & (asked.weight is None)
    exactly = Shown(*(np.where(rest, 0.0, x) for x in exactly))
    first, second = fits(exactly), fits(nearly)
    level = np.where(first, 2, np.where(second, 1, 0))
    return level, Shown(*(np.where(first, x, z) for x, z in zip(exactly, nearly, strict=True)))


def _shown(asked: Asked, claim: Claim, eps: float) -> tuple[Shown, Shown]:
    """What is proved of the problem itself, and of one within rounding."""
    given = _admissible(asked, claim.s, FINE * eps)
    exact = exact_forces(asked, claim.s, FINE * eps)
    near, distance = _pulled_in(asked, claim.s, exact.s, NEARBY * eps)
    nothing, lower = np.zeros(len(near)), _proved_bound(asked, claim)
    top, moved = _of_forces(asked, claim, exact.s, exact.shift, given & exact.shown)
    exactly = Shown(top, lower, nothing, moved)
    top, moved = _of_forces(asked, claim, near, nothing, given & (distance <= NEARBY * eps))
    return exactly, Shown(top, lower, distance, moved)


def _of_forces(
    asked: Asked, claim: Claim, s: np.ndarray, shift: np.ndarray, admissible: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The cost of forces within ``shift`` of s, rounded up, and by what share of the largest force they differ."""
    value, size = cost(asked, s)
    change = cost_change(asked, s, np.where(admissible, shift, 0.0))
    top = value + change + 4 * (s.shape[1] * s.shape[2] + 8) * EPS * np.maximum(size, np.abs(value))
    largest = np.max(np.abs(claim.s), (-1, -2), initial=0.0)
    moved = np.max(np.abs(s - claim.s), (-1, -2), initial=0.0) + np.where(admissible, shift, 0.0)
    return np.where(admissible, top, np.inf), moved / np.where(largest > 0, largest, 1.0)


def _admissible(asked: Asked, s: np.ndarray, fine: float) -> np.ndarray:
    """The forces as given: ``A s + w = 0`` and inside all limits, to rounding."""
    total = np.linalg.norm(s.reshape(len(s), -1), axis=-1)
    missing, size = _balance(asked, s)
    rooms, edge = edges_of(asked, s), fine * total[:, None]
    reach = np.linalg.norm(asked.reach(), axis=1) * total[:, None]
    return (
        np.isfinite(total + size)
        & (missing <= fine * size)
        & (rooms.cone >= -edge).all(-1)
        & (rooms.cap >= -edge).all(-1)
        & (rooms.torque >= -fine * (reach + np.where(np.isfinite(asked.torque), asked.torque, 0.0))).all(-1)
    )


def _pulled_in(
    asked: Asked, given: np.ndarray, balanced: np.ndarray, near: float
) -> tuple[np.ndarray, np.ndarray]:
    """Forces inside all limits of a problem next to the one given, and how far its numbers lie, over their size.

    Friction, caps, torques and J may be better by ``near`` at most; what is still outside is pulled onto its cone or
    cap, and balances another load. The forces as given, if they are near enough, else the nearest: where the rank is
    not full, forces balanced again may be far from those given.
    """
    best, least = given, np.full(len(given), np.inf)
    live = asked.known.live
    for s in (given, balanced):
        tail = np.linalg.norm(s[..., 1:], axis=-1)
        for better in (0.0, near / 2, near * (1 - 1 / 64)):
            head = np.clip(s[..., 0], 0.0, asked.cap * (1 + better))
            reached = np.where(live & (tail > head), tail, 0.0)
            shrink = np.where(
                reached > 0, np.minimum(1.0, head * (1 + better) / np.where(reached > 0, tail, 1.0)), 1.0
            )
            inside = np.concatenate([head[..., None], s[..., 1:] * shrink[..., None]], -1)
            used = np.where((head > asked.cap) | (reached > 0), better, 0.0).max(-1, initial=0.0)
            missing, size = _balance(asked, inside)
            distance = np.maximum(missing / np.where(size > 0, size, 1.0), _missing_torque(asked, inside))
            distance = np.maximum(distance, used) + 2 * EPS
            closer = (distance < least) & (least > near)
            best = np.where(closer[:, None, None], inside, best)
            least = np.where(closer, distance, least)
    return best, least


def _balance(asked: Asked, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) |A s + w|, what the forces leave of the load, and |A| |s| + |w|, the size of its terms."""
    flat = s.reshape(len(s), -1)
    applied = np.einsum("lij,lj->li", asked.known.A, flat) + asked.load
    size = np.linalg.norm(asked.known.A, axis=(-2, -1)) * np.linalg.norm(flat, axis=-1)
    return np.linalg.norm(applied, axis=-1), size + np.linalg.norm(asked.load, axis=-1)


def _missing_torque(asked: Asked, s: np.ndarray) -> np.ndarray:
    """By what share tau_max and J would have to be better."""
    over = np.maximum(-edges_of(asked, s).torque, 0.0)
    size = np.einsum("lkj,lk->lj", asked.reach(), np.linalg.norm(s, axis=-1))
    size = size + np.where(np.isfinite(asked.torque), asked.torque, 0.0)
    return np.max(over / np.where(size > 0, size, 1.0), -1, initial=0.0)


def _proved_bound(asked: Asked, claim: Claim) -> np.ndarray:
    """A lower bound of the optimal cost: the dual function at x_i smaller by what rounding can do to it.

    The dual function grows with x in the order of the (self-dual) cones. It holds wherever it is taken; forces that
    are only near the optimal ones make it lower.
    """
    s, y, rates, known = claim.s, claim.load_twist, claim.joint_rates, asked.known
    jacobian = asked.scaled_jacobian()
    k, n, joints = jacobian.shape[1:]
    x = np.einsum("lkij,li->lkj", known.blocks, y) + np.einsum("lkcj,lj->lkc", jacobian, rates)
    blur = np.linalg.norm(known.blocks, axis=(-2, -1)) * np.linalg.norm(y, axis=-1)[:, None]
    blur = blur + np.linalg.norm(asked.reach(), axis=-1) * np.linalg.norm(rates, axis=-1)[:, None]
    x[..., 0] -= (24 + n + joints) * EPS * blur
    best = lower_bound(asked, Multipliers(y, rates, x), s)
    work = np.linalg.norm(y, axis=-1) * np.linalg.norm(asked.load, axis=-1) + asked.joint_work(rates)
    _, size = cost(asked, s)
    error = (16 + joints) * EPS * work + 4 * (k * n + 8) * EPS * (size + np.abs(best))
    floor = 0.0 if asked.weight is None else -np.inf  # no cost but the robust one is negative
    return np.fmax(best - error, floor)
