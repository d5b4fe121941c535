"""From a solved force problem to its answer with proof: forces, cost, bound, twists, in the caller's units.

Nothing is claimed that was not proven: the cost and its bound (``bounds``), or the load's power along a twist
(``infeasibility``).
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp

from ..backend import stage
from ..conic import (
    Cone,
    ConvexConeProgram,
    ConvexPoint,
    ConvexState,
    cone_max,
    cone_sum,
    inner,
    interior_distance,
    matvec,
    rmatvec,
    tail_norm,
    vector_norm,
)
from ..contacts import Folded, to_body, to_twist, unfold
from ..core import (
    Array,
    Status,
    edge_tolerance,
    first_of,
    largest_sensitivity,
    nan_where,
    proven_gap,
    proven_limit,
    unit_roundoff,
)
from .bounds import barrier_loss, cost_sensitivity, criterion_value, dual_value
from .infeasibility import proven_separation
from .problem import ForceProblem, Load

__all__ = ["Answer", "answer"]


class Answer(NamedTuple):
    """The answer of each lane, lanes on the last axis; forces (k n, L), twists (m, L), rates (q, L)."""

    status: Array
    force: Array
    cost: Array
    bound: Array
    escape_twist: Array
    load_twist: Array
    joint_rates: Array


class Values(NamedTuple):
    """A criterion between its bound and its cost (L,), in the caller's units.

    scale  the objective, what the gap is relative to      rounding   what evaluating the bound can lose
    stored  what it can lose when it is evaluated from the twist of A, as it is stored
    """

    cost: Array
    bound: Array
    scale: Array
    rounding: Array
    stored: Array


class Proofs(NamedTuple):
    """Positive where they prove INFEASIBLE: along the solver's ray, and along the twist out of the range of A."""

    ray: Array
    off: Array


class Lanes(NamedTuple):
    """What is known of the lanes before the answer (L,): a problem, off the range of A, at rest; why it stopped."""

    valid: Array
    off: Array
    rest: Array
    stop: Array


class Multipliers(NamedTuple):
    """Multipliers (m + q, L) of the optimum and of the proof of infeasibility, and the twists of A they stand for."""

    rows: Array
    ray: Array
    twist: Array
    escape: Array


@stage
def _polished(program: ConvexConeProgram, basis: Cone, u: Cone) -> Cone:
    """The nearest point with ``Q u = b``, to rounding; between, back inside the limits of torques."""
    m, rounds = program.rhs.shape[0], 2 if program.bound is None else 3
    for i in range(rounds):
        applied = matvec(basis, u)
        back = rmatvec(basis, program.rhs - applied)
        u = tuple(program.exists * (a + b) for a, b in zip(u, back, strict=True))
        if program.bound is None or i == rounds - 1:
            continue
        rows = tuple(c[m:] for c in program.columns)
        product = matvec(rows, u)
        square = sum(jnp.sum(c * c, axis=1) for c in rows)
        over = jnp.maximum(jnp.abs(product) - program.bound, jnp.zeros_like(product)) * jnp.sign(product)
        over = over / jnp.where(square > 0, square, jnp.ones_like(square))
        u = tuple(a - b for a, b in zip(u, rmatvec(rows, over), strict=True))
    return u


@stage
def _violation(program: ConvexConeProgram, u: Cone) -> Array:
    """How far u is outside the cones, the caps, the bounds, relative to the largest force; 0 inside (L,)."""
    exists = program.exists
    largest = cone_max(exists * jnp.abs(u[0]))
    worst = cone_max(exists * -interior_distance(u))
    if program.cap is not None:
        over = jnp.where(exists > 0, u[0] - program.cap, jnp.full_like(u[0], -jnp.inf))
        worst = jnp.maximum(worst, cone_max(over))
    if program.bound is not None:
        _, product = program.products(u)
        rows = [c[program.rhs.shape[0] :] for c in program.columns]
        length = jnp.sqrt(sum(jnp.sum(c * c, axis=1) for c in rows))
        over = (jnp.abs(product) - program.bound) / jnp.where(length > 0, length, jnp.ones_like(length))
        worst = jnp.maximum(worst, cone_max(over))
    return jnp.maximum(worst, jnp.zeros_like(worst)) / jnp.where(largest > 0, largest, jnp.ones_like(largest))


@stage
def _imbalance(folded: Folded, u: Cone, load: Load) -> Array:
    """``|A s + w| / (|A| |s| + |w|)`` on A itself (L,): the basis of the solver may be worse conditioned."""
    size = folded.norm * jnp.sqrt(cone_sum(folded.exists * inner(u, u))) * load.size + vector_norm(
        load.wrench
    )
    rest = vector_norm(load.size * matvec(folded.columns, u) + load.wrench)
    return rest / jnp.where(size > 0, size, jnp.ones_like(size))


@stage
def _status(
    lanes: Lanes, values: Values, proofs: Proofs, admissible: Array, smoothing: Array | None,
    tolerance: Array,
) -> Array:  # fmt: skip
    cost, bound = values.cost, values.bound - values.rounding
    scale = jnp.maximum(values.scale, jnp.abs(cost))
    tight = (cost - bound) <= tolerance * scale
    loosest = jnp.maximum(tolerance, jnp.full_like(tolerance, proven_gap(cost.dtype)))
    tight = tight & ((cost - values.bound + values.stored) <= loosest * scale)
    if smoothing is not None:  # the answer is a point of the central path, at a gap of its own
        tight = lanes.stop == Status.CONVERGED.value
    finite = jnp.isfinite(cost) & jnp.isfinite(bound)
    optimal = admissible & tight & finite & (lanes.stop != Status.SKIPPED.value)
    return first_of(
        [
            (~lanes.valid, Status.INVALID),
            (lanes.off & (proofs.off > 0), Status.INFEASIBLE),
            (lanes.off, Status.STALLED),
            (lanes.rest, Status.OPTIMAL),
            (optimal, Status.OPTIMAL),
            (proofs.ray > 0, Status.INFEASIBLE),
        ],
        Status.STALLED,
    )


def answer(problem: ForceProblem, state: ConvexState, tolerance: Array) -> Answer:
    """Read one tile's answers off its points. Nothing is claimed that was not proven."""
    program, load, projection = problem.program, problem.load, problem.tile.projection
    m, dtype = program.rhs.shape[0], problem.tile.folded.norm.dtype
    u = _polished(program, projection.basis.columns, state.point.u)
    rows, ray = _all_rows(state.point), _to_size_one(state.ray)
    linear = program.curvature is None and program.cone_floor is None
    if program.cap is not None and linear and program.smoothing is None:
        rows = _affordable(program, rows, u)
    found = Multipliers(rows, ray, to_twist(projection, rows[:m]), to_twist(projection, ray[:m]))
    values = _values(problem, state.point, u, found)
    load = load._replace(rest=load.rest & (problem.demand.criterion.barrier_weight is None))
    worst = jnp.maximum(_violation(program, u), _imbalance(problem.tile.folded, u, load))
    admissible = (worst <= edge_tolerance(dtype)) & jnp.isfinite(values.cost) & ~load.off
    barrier = problem.demand.barrier()
    if barrier is not None:  # too near to the edge no barrier can be evaluated
        admissible = admissible & (
            cost_sensitivity(program, u, load.size, barrier) <= largest_sensitivity(dtype)
        )
    status = _status(
        Lanes(problem.valid, load.off, load.rest, state.stop),
        values,
        _proofs(problem, found),
        admissible,
        program.smoothing,
        tolerance,
    )
    # What forces outside their limits cost bounds nothing; beside them no multipliers are to be trusted.
    known = values._replace(
        cost=jnp.where(admissible | load.rest, values.cost, jnp.inf),
        stored=jnp.where(admissible | load.rest, values.stored, jnp.inf),
    )
    return _in_user_units(problem._replace(load=load), status, u, known, found)


def _values(problem: ForceProblem, point: ConvexPoint, u: Cone, found: Multipliers) -> Values:
    rows = found.rows
    program, size, barrier = problem.program, problem.load.size, problem.demand.barrier()
    cost = criterion_value(program, u, size, barrier)
    bound = dual_value(program, rows, u, size, barrier)
    bound = jnp.where(jnp.isnan(bound), -jnp.inf, bound)
    rounding = _rounding(program, rows, u, size)
    stored = rounding + _stored(problem.tile.folded, program, found, u, problem.load)
    return Values(cost, bound, _scale(program, point, size), rounding, stored)


def _proofs(problem: ForceProblem, found: Multipliers) -> Proofs:
    folded, program, load = problem.tile.folded, problem.program, problem.load
    limit = proven_limit(folded.norm.dtype)
    rates = None if program.bound is None else found.ray[program.rhs.shape[0] :]
    ray = proven_separation(folded, program, found.escape, rates, load, limit)
    return Proofs(ray, proven_separation(folded, program, load.twist, None, load, limit))


@stage
def _all_rows(point: ConvexPoint) -> Array:
    return point.rows()


@stage
def _to_size_one(ray: Array) -> Array:
    """A proof may be scaled by any positive number; the solver's grows, and may overflow, as long as it is sought."""
    largest = cone_max(jnp.abs(ray))
    return ray / jnp.where((largest > 0) & jnp.isfinite(largest), largest, jnp.ones_like(largest))


@stage
def _affordable(program: ConvexConeProgram, rows: Array, u: Cone) -> Array:
    """``rows`` scaled down until contacts far below their caps need none: rounding there would cost the whole cap."""
    x = rmatvec(program.columns, rows)
    violation = program.exists * jnp.maximum(tail_norm(x) - x[0], jnp.zeros_like(x[0]))
    far = program.cap > 2 * cone_max(program.exists * jnp.abs(u[0]))
    needed = jnp.where(far, violation, jnp.zeros_like(violation))
    most = cone_sum(needed) if program.price is None else cone_max(needed)
    most = most + jnp.asarray(64 * unit_roundoff(most.dtype), most.dtype) * vector_norm(rows)
    return rows / jnp.maximum(most, jnp.ones_like(most))


@stage
def _rounding(program: ConvexConeProgram, rows: Array, u: Cone, size: Array) -> Array:
    """What rounding can do to the bound of multipliers as large as ``rows``."""
    forces = jnp.sqrt(cone_sum(program.exists * inner(u, u)))
    blur = vector_norm(rows) * (vector_norm(program.rhs) + forces) * size
    blur = jnp.asarray(8 * unit_roundoff(blur.dtype), blur.dtype) * blur
    return blur * size if program.curvature is not None else blur


@stage
def _stored(folded: Folded, program: ConvexConeProgram, found: Multipliers, u: Cone, load: Load) -> Array:
    """What it can lose when it is evaluated again from the twist of A, in float64 and with all rounding allowed for."""
    m, joints = program.rhs.shape[0], found.rows.shape[0] - program.rhs.shape[0]
    speed = vector_norm(found.twist)
    blur = folded.norm * speed
    if joints:
        square = [cone_sum(inner(*[tuple(c[j] for c in program.columns)] * 2)) for j in range(m, m + joints)]
        blur = blur + vector_norm(found.rows[m:]) * jnp.sqrt(reduce(jnp.add, square))
    terms = 32 + len(u) + joints if blur.dtype == jnp.float64 else 8
    unit = jnp.asarray(terms * unit_roundoff(blur.dtype), blur.dtype)
    if program.head_floor is None:
        loss = unit * blur * cone_sum(program.exists * jnp.abs(u[0]))
    else:
        loss = barrier_loss(program, found.rows, u, unit * blur)
    loss = loss * load.size + unit * speed * vector_norm(load.wrench)
    return loss * load.size if program.curvature is not None else loss


@stage
def _scale(program: ConvexConeProgram, point: ConvexPoint, size: Array) -> Array:
    value = program.size(point) * size
    return value * size if program.curvature is not None else value


def _in_user_units(
    problem: ForceProblem, status: Array, u: Cone, values: Values, found: Multipliers
) -> Answer:
    """Newtons and metres; zeros, infinities and NaN where the status says so."""
    tile, squared = problem.tile, problem.program.curvature is not None
    unbarred = problem.demand.criterion.barrier_weight is None

    @stage
    def run(
        status: Array, u: Cone, values: Values, found: Multipliers, load: Load, length: Array,
        row_norm: Array | None, coefficients: tuple[Array, Array],
    ) -> tuple[Array, ...]:  # fmt: skip
        optimal, infeasible = status == Status.OPTIMAL.value, status == Status.INFEASIBLE.value
        invalid, cost = status == Status.INVALID.value, values.cost
        bound = jnp.where(jnp.isfinite(values.stored), values.bound - values.stored, -jnp.inf)
        if unbarred:  # no forces cost less than 0
            bound = jnp.maximum(bound, jnp.minimum(values.bound, jnp.zeros_like(bound)))
        m = found.twist.shape[0]
        inf = jnp.full_like(cost, jnp.inf)
        zero = jnp.zeros_like(cost)

        def final(x: Array, none: Array, where: Array) -> Array:
            return nan_where(invalid, jnp.where(where, none, x))

        resting = load.rest & optimal & (bound <= zero)
        force = unfold(tuple(load.size * x for x in u), tile.components, *coefficients)
        force = final(force, zero, infeasible | resting)
        cost = final(jnp.where(resting, zero, cost), inf, infeasible)
        bound = final(jnp.where(resting, zero, bound), inf, infeasible)
        bound = jnp.where(bound < cost, bound, cost)
        escape = to_body(jnp.where(load.off, load.twist, found.escape), length, tile.dimension)
        size = vector_norm(escape)
        size = jnp.where((size > 0) & jnp.isfinite(size), size, jnp.ones_like(size))
        escape = final(jnp.where(infeasible, escape / size, zero), zero, zero > 1)
        back = load.size if squared else jnp.ones_like(load.size)
        twist = back * to_body(found.twist, length, tile.dimension)
        twist = final(twist, zero, infeasible | resting)
        rates = jnp.zeros((0, *cost.shape), cost.dtype)
        if row_norm is not None:
            beta = jnp.where(infeasible, found.ray[m:] / size, back * found.rows[m:]) / row_norm
            rates = final(beta, zero, resting | (load.off & infeasible))
        return force, cost, bound, escape, twist, rates

    length, row_norm = tile.folded.length, problem.row_norm
    return Answer(status, *run(status, u, values, found, problem.load, length, row_norm, tile.coefficients))
