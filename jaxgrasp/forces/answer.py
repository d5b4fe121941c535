"""From a solved force problem to its answer with proof: forces, cost, bound, twists, in the caller's units.

Nothing is claimed that was not proven: the cost and its bound (``duality``), or the load's power along a twist.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..backend import stage, to_lanes
from ..conic import (
    Cone,
    ConvexProgram,
    Point,
    Vector,
    as_vector,
    cone_max,
    cone_sum,
    inner,
    interior_distance,
    matvec,
    rmatvec,
    tail_norm,
    vector_norm,
)
from ..contacts import Component, Contacts, Folded, Projection, to_twist, unfold
from ..core import Array, Status, edge_tolerance, proven_limit, rounding_constant, unit_roundoff
from .bounds import criterion_value, dual_value
from .problem import Balance, Demand, Load

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


@stage
def _polished(basis: Cone, rhs: Array, exists: Array, u: Cone) -> Cone:
    """The nearest point with ``Q u = b``, twice, so that what is left is rounding."""
    for _ in range(2):
        applied = matvec(basis, u)
        back = rmatvec(basis, as_vector(rhs - applied))
        u = tuple(exists * (a + b) for a, b in zip(u, back, strict=True))
    return u


@stage
def _shortfall(program: ConvexProgram, u: Cone) -> Array:
    """How far u is outside the cones, the caps, the bounds, relative to the largest force; 0 inside (L,)."""
    exists = program.exists
    largest = cone_max(exists * jnp.abs(u[0]))
    worst = cone_max(exists * -interior_distance(u))
    if program.cap is not None:
        over = jnp.where(exists > 0, u[0] - program.cap, jnp.full_like(u[0], -jnp.inf))
        worst = jnp.maximum(worst, cone_max(over))
    if program.bound is not None:
        _, product = program.products(u)
        worst = jnp.maximum(worst, cone_max(jnp.abs(product) - program.bound))
    return jnp.maximum(worst, jnp.zeros_like(worst)) / jnp.where(largest > 0, largest, jnp.ones_like(largest))


@stage
def _statuses(
    smoothing: Array | None, valid: Array, off: Array, rest: Array, stop: Array, short: Array,
    cost: Array, bound: Array, scale: Array, tolerance: Array, proof: Array, off_proof: Array, fine: float,
) -> Array:  # fmt: skip
    def choose(status: Status, where: Array, otherwise: Array) -> Array:
        return jnp.where(where, jnp.int32(status.value), otherwise)

    met = short <= fine
    tight = (cost - bound) <= tolerance * jnp.maximum(scale, jnp.abs(cost))
    if smoothing is not None:  # the answer is a point of the central path, at a gap of its own
        tight = stop == Status.CONVERGED.value
    finite = jnp.isfinite(cost) & jnp.isfinite(bound)
    status = jnp.full(cost.shape, Status.STALLED.value, jnp.int32)
    status = choose(Status.INFEASIBLE, proof > 0, status)
    status = choose(Status.OPTIMAL, met & tight & finite & (stop != Status.SKIPPED.value), status)
    status = choose(Status.OPTIMAL, rest, status)
    status = choose(Status.STALLED, off, status)
    status = choose(Status.INFEASIBLE, off & (off_proof > 0), status)
    return choose(Status.INVALID, ~valid, status)


@stage
def _power_left(
    folded: Folded, program: ConvexProgram, twist: Vector, beta: Array | None, load: Load, limit: float
) -> Array:
    """Power of the load along ``twist`` less what forces up to ``limit`` loads and the torques can take up, on A.

    Allows twice for the rounding the checker allows for, in its float64.
    """
    rounding = rounding_constant() * unit_roundoff("float64")
    x, blur = rmatvec(folded.columns, twist), folded.norm * vector_norm(twist)
    if beta is not None:
        joints = tuple(c[program.rhs.shape[0] :] for c in program.columns)
        x = tuple(a + b for a, b in zip(x, rmatvec(joints, as_vector(beta)), strict=True))
        blur = blur + vector_norm(as_vector(beta))
    short = program.exists * jnp.maximum(tail_norm(x) - x[0] + rounding * blur, jnp.zeros_like(x[0]))
    outer = vector_norm(load.wrench)
    most = jnp.broadcast_to(limit * outer, short.shape)
    if program.cap is not None:
        most = jnp.minimum(most, program.cap * load.size)
    taken = cone_sum(short * most)
    if beta is not None:
        for j in range(beta.shape[0]):
            taken = taken + jnp.abs(beta[j]) * program.bound[j] * load.size
    power = twist[0] * load.wrench[0]
    for a, b in zip(twist[1:], load.wrench[1:], strict=True):
        power = power + a * b
    return power - rounding * vector_norm(twist) * outer - taken


def answer(
    contacts: Contacts,
    folded: Folded,
    projection: Projection,
    problem: Balance,
    demand: Demand,
    point: Point,
    ray: Array,
    stop: Array,
    tolerance: Array,
    components: tuple[Component, ...],
    dimension: int,
) -> Answer:
    """Read one tile's answers off its points. Nothing is claimed that was not proven."""
    program, load = problem.program, problem.load
    dtype = folded.norm.dtype
    m = program.rhs.shape[0]
    u = _polished(projection.basis.columns, program.rhs, program.exists, point.u)
    weight = demand.criterion.barrier_weight
    terms = None
    if demand.log_det is not None:
        on_normal, on_cone, constant = (to_lanes(x) for x in demand.log_det)
        terms = (on_normal, on_cone, constant)
    cost = criterion_value(program, u, load.size, weight, terms)

    rows = _all_rows(point)
    bound = dual_value(program, rows, u, load.size, weight, terms)
    bound = jnp.where(jnp.isnan(bound), -jnp.inf, bound)
    scale = _scale(program, point, load.size)
    blur = _blur(program, rows, u, load.size)
    short = _shortfall(program, u)
    limit = proven_limit(dtype)
    escape = to_twist(projection, as_vector(ray[:m]))
    proof = _power_left(folded, program, escape, None if program.bound is None else ray[m:], load, limit)
    off_proof = _power_left(folded, program, load.twist, None, load, limit)
    status = _statuses(
        program.smoothing, problem.valid, load.off, load.rest & (weight is None), stop, short, cost, bound - blur,
        scale, tolerance, proof, off_proof, edge_tolerance(dtype),
    )  # fmt: skip

    multiplier = to_twist(projection, as_vector(rows[:m]))
    load = load._replace(rest=load.rest & (weight is None))
    return _read_back(
        status, u, cost, bound, escape, multiplier, rows, ray, folded, load, problem.row_norm, contacts,
         components, dimension, program.curvature is not None,
    )  # fmt: skip


@stage
def _all_rows(point: Point) -> Array:
    return point.rows()


@stage
def _blur(program: ConvexProgram, rows: Array, u: Cone, size: Array) -> Array:
    """What rounding can do to the bound of multipliers as large as ``rows``."""
    forces = jnp.sqrt(cone_sum(program.exists * inner(u, u)))
    blur = vector_norm(as_vector(rows)) * (vector_norm(as_vector(program.rhs)) + forces) * size
    blur = jnp.asarray(8 * unit_roundoff(blur.dtype), blur.dtype) * blur
    return blur * size if program.curvature is not None else blur


@stage
def _scale(program: ConvexProgram, point: Point, size: Array) -> Array:
    value = program.size(point) * size
    return value * size if program.curvature is not None else value


def _read_back(
    status, u, cost, bound, escape, multiplier, rows, ray, folded, load, row_norm, contacts,
    components, dimension: int, squared: bool,
) -> Answer:  # fmt: skip
    """Newtons and metres; zeros, infinities and NaN where the status says so."""

    @stage
    def run(
        status, u, cost, bound, escape, multiplier, rows, ray, length, load, row_norm, friction, torsion
    ) -> tuple[Array, ...]:
        optimal, infeasible = status == Status.OPTIMAL.value, status == Status.INFEASIBLE.value
        invalid, rest = status == Status.INVALID.value, load.rest
        m = len(multiplier)
        nan, inf = jnp.full_like(cost, jnp.nan), jnp.full_like(cost, jnp.inf)
        zero = jnp.zeros_like(cost)

        def final(x: Array, none: Array, where: Array) -> Array:
            return jnp.where(invalid, nan, jnp.where(where, none, x))

        resting = rest & optimal & (bound <= zero)
        force = unfold(tuple(load.size * x for x in u), components, friction, torsion)
        blank = infeasible | resting
        force = final(force, zero, blank)
        cost = final(jnp.where(resting, zero, cost), inf, infeasible)
        bound = final(jnp.where(resting, zero, bound), inf, infeasible)
        bound = jnp.where(bound < cost, bound, cost)
        off = load.off
        escape = tuple(jnp.where(off, a, b) for a, b in zip(load.twist, escape, strict=True))
        escape = tuple(x if i < dimension else x / length for i, x in enumerate(escape))
        size = vector_norm(escape)
        size = jnp.where((size > 0) & jnp.isfinite(size), size, jnp.ones_like(size))
        escape = jnp.stack([final(jnp.where(infeasible, x / size, zero), zero, zero > 1) for x in escape])
        back = load.size if squared else jnp.ones_like(load.size)
        multiplier = [back * (x if i < dimension else x / length) for i, x in enumerate(multiplier)]
        twist = jnp.stack([final(x, zero, infeasible | resting) for x in multiplier])
        rates = jnp.zeros((0, *cost.shape), cost.dtype)
        if row_norm is not None:
            beta = jnp.where(infeasible, ray[m:] / size, back * rows[m:]) / row_norm
            rates = final(beta, zero, resting | (off & infeasible))
        return force, cost, bound, escape, twist, rates

    values = run(
        status, u, cost, bound, escape, multiplier, rows, ray, folded.length, load, row_norm,
        to_lanes(contacts.friction), to_lanes(contacts.torsion),
    )  # fmt: skip
    return Answer(status, *values)
