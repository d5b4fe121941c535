"""From a solved force problem to its answer with proof: forces, cost, bound, twists, in the caller's units.

The bound is the dual function at the twist the solver ended with, in closed form for every criterion, so it holds
whatever the solver did. ``certificate.py`` evaluates the same formulas again from the answer alone.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ._types import Array, rounding_constant, unit_roundoff
from .balance import Balance, Demand, power_left
from .cones import Cone, cone_max, cone_sum, determinant, inner, interior_distance, tail_norm
from .contacts import Component
from .lanes import to_lanes
from .margin import Contacts, Folded, Projection, to_twist
from .solver import Stop
from .solver.convex import ConvexProgram, Curvature, Point, as_vector
from .solver.linear import Vector, matvec, rmatvec
from .solver.stages import stage
from .status import Status
from .verdict import unfold

__all__ = ["Answer", "answer", "criterion_value"]

PROVEN_LIMIT = 1e7  # loads; the checker asks for a tenth of it


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


def _top(exists: Array, u: Cone) -> Array:
    return cone_max(jnp.where(exists > 0, u[0], jnp.full_like(u[0], -jnp.inf)))


def _logs(weight: Array, terms: tuple[Array, Array, Array], exists: Array, u: Cone, size: Array) -> Array:
    """``weight * sum log det P`` of the forces ``size u``."""
    on_normal, on_cone, constant = terms
    one = jnp.ones_like(u[0])
    head = jnp.where(exists > 0, size * u[0], one)
    det = jnp.where(exists > 0, size * size * determinant(u), one)
    return weight * cone_sum(exists * (on_normal * jnp.log(head) + on_cone * jnp.log(det) + constant))


@stage
def criterion_value(
    program: ConvexProgram,
    u: Cone,
    size: Array,
    weight: Array | None,
    terms: tuple[Array, Array, Array] | None,
) -> Array:
    """The criterion at the forces ``size u``."""
    if program.price is not None:
        return size * cone_sum(program.price * u[0])
    if program.curvature is not None:
        return size * size * cone_sum(program.exists * inner(u, program.curvature.apply(u))) / 2
    top = size * _top(program.exists, u)
    if weight is None or terms is None:
        return top
    return top - _logs(weight, terms, program.exists, u, size)


class Pull(NamedTuple):
    """x = A^T y + E^T beta per cone, and ``y.w - |beta|.bound`` (L,)."""

    x: Cone
    gain: Array


@stage
def _pull(program: ConvexProgram, rows: Array) -> Pull:
    m = program.rhs.shape[0]
    gain = -program.rhs[0] * rows[0]
    for i in range(1, m):
        gain = gain - program.rhs[i] * rows[i]
    if program.bound is not None:
        for j in range(program.bound.shape[0]):
            gain = gain - jnp.abs(rows[m + j]) * program.bound[j]
    return Pull(rmatvec(program.columns, as_vector(rows)), gain)


def _covered(short: Array, cap: Array | None, total: Array) -> Array:
    """The part of ``short`` (k, L) that multipliers of sum ``total`` should cover: the dearest caps first."""
    k = short.shape[0]
    rows = []
    for i in range(k):
        before = jnp.zeros_like(total)
        for j in range(k):
            if j == i:
                continue
            if cap is None:
                first = j < i
                before = before + (short[j] if first else jnp.zeros_like(total))
            else:
                first = (cap[j] > cap[i]) | ((cap[j] == cap[i]) & (j < i))
                before = before + jnp.where(first, short[j], jnp.zeros_like(total))
        left = jnp.maximum(total - before, jnp.zeros_like(total))
        rows.append(jnp.minimum(left, short[i]))
    return jnp.stack(rows)


@stage
def _linear_bound(program: ConvexProgram, pull: Pull) -> Array:
    """Dual value of prices and levels: the twist as it is, paying caps, or scaled to need none."""
    exists, x = program.exists, pull.x
    zero = jnp.zeros_like(exists)
    short = exists * jnp.maximum(tail_norm(x) - x[0], zero)
    if program.price is not None:
        covered = jnp.minimum(short, program.price)
        largest = cone_max(short)
    else:
        covered = _covered(short, program.cap, jnp.ones_like(short[0]))
        largest = cone_sum(short)
    needed = jnp.where(largest > 0, largest, jnp.ones_like(largest))
    scaled = jnp.where(largest > 0, pull.gain / needed, jnp.zeros_like(largest))
    over = short - covered
    cap = jnp.full_like(over, jnp.inf) if program.cap is None else program.cap
    paid = cone_sum(jnp.where(over > 0, over * cap, zero))
    return jnp.maximum(jnp.maximum(scaled, pull.gain - paid), jnp.zeros_like(scaled))


@stage
def _quadratic_bound(program: ConvexProgram, pull: Pull, u: Cone) -> Array:
    """Dual value with the tails' cost linearised at u, which convexity allows; s_0 minimised exactly in [0, cap]."""
    curvature: Curvature | None = program.curvature
    assert curvature is not None
    exists = program.exists
    pushed = curvature.apply(u)
    x = (pull.x[0], *(a + b for a, b in zip(pull.x[1:], pushed[1:], strict=True)))
    spent = inner(u, pushed) - u[0] * pushed[0]
    rho = jnp.maximum(tail_norm(x) - x[0], jnp.zeros_like(x[0]))
    flat = jnp.where(exists > 0, curvature.head, jnp.ones_like(exists))
    best = rho / flat
    if program.cap is not None:
        best = jnp.minimum(best, program.cap)
    return pull.gain + cone_sum(exists * (flat * best * best / 2 - rho * best - spent / 2))


@stage
def _barrier_bound(program: ConvexProgram, pull: Pull, u: Cone) -> Array:
    """Dual value of the fixed barriers: ``sum phi - phi log phi + phi/2 log det z + psi - psi log psi + psi log p``.

    Where u_0 is at its level, ``phi z_0 / det z = psi / p = level`` fixes z_0 and p; elsewhere p is that of the forces.
    The level's multipliers, of sum 1, supply what z lacks, the dearest caps first; what is left is
    worth most at the largest u_0.
    """
    exists, x = program.exists, pull.x
    phi, psi = program.cone_floor, program.head_floor
    assert phi is not None and psi is not None
    zero, one = jnp.zeros_like(exists), jnp.ones_like(exists)
    top = _top(exists, u)
    level, leads = top + zero, exists * jnp.where(u[0] >= top, one, zero)
    if program.cap is not None:
        level = jnp.minimum(level, program.cap)
    tail = tail_norm(x)
    wanted = jnp.where(phi > 0, (phi + jnp.sqrt(phi * phi + (2 * level * tail) ** 2)) / (2 * level), tail)
    needed = exists * jnp.maximum(wanted + psi / level - x[0], zero)
    price = exists * psi / jnp.where((exists > 0) & (needed <= 0), u[0], level)
    share = _covered(needed, program.cap, one[0])
    paid, over = jnp.zeros_like(one[0]), zero
    if program.cap is not None:
        finite = jnp.isfinite(program.cap) & (exists > 0)
        over = jnp.where(finite, needed - share, zero)
        paid = cone_sum(over * jnp.where(finite, program.cap, zero))
    spare = jnp.maximum(one[0] - cone_sum(share), zero[0]) / jnp.maximum(cone_sum(leads), one[0])
    head = share + leads * spare + over + x[0]
    # A contact without barrier only needs z in its cone.
    price = jnp.where(phi > 0, price, exists * (head - tail))
    head = head - price
    z = (jnp.where(exists > 0, head, one), *(exists * v for v in x[1:]))
    det = jnp.where(interior_distance(z) > 0, determinant(z), zero)
    value = _conjugate(phi, det, 0.5) + _conjugate(psi, price, 1.0)
    return pull.gain - paid + cone_sum(jnp.where(exists > 0, value, zero))


def _conjugate(floor: Array, value: Array, power: float) -> Array:
    one = jnp.ones_like(floor)
    some = floor > 0
    safe = jnp.where(some, floor, one)
    log = jnp.where(value > 0, jnp.log(jnp.where(value > 0, value, one)), jnp.full_like(value, -jnp.inf))
    return jnp.where(some, safe - safe * jnp.log(safe) + power * safe * log, jnp.zeros_like(floor))


@stage
def _shifted(
    bound: Array, weight: Array, terms: tuple[Array, Array, Array], exists: Array, size: Array
) -> Array:
    """Back from forces u to forces ``size u`` under the logarithms."""
    on_normal, on_cone, constant = terms
    log = jnp.log(size)
    return size * bound - weight * cone_sum(exists * ((on_normal + 2 * on_cone) * log + constant))


@stage
def _unit(v: Vector) -> Vector:
    square = v[0] * v[0]
    for x in v[1:]:
        square = square + x * x
    size = jnp.sqrt(square)
    size = jnp.where((size > 0) & jnp.isfinite(size), size, jnp.ones_like(size))
    return tuple(x / size for x in v)


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
        tight = stop == Stop.CONVERGED.value
    finite = jnp.isfinite(cost) & jnp.isfinite(bound)
    status = jnp.full(cost.shape, Status.STALLED.value, jnp.int32)
    status = choose(Status.INFEASIBLE, proof > 0, status)
    status = choose(Status.OPTIMAL, met & tight & finite & (stop != Stop.SKIPPED.value), status)
    status = choose(Status.OPTIMAL, rest, status)
    status = choose(Status.STALLED, off, status)
    status = choose(Status.INFEASIBLE, off & (off_proof > 0), status)
    return choose(Status.INVALID, ~valid, status)


@stage
def _off_proof(folded: Folded, twist: Vector, wrench: Vector, size: Array, limit: float) -> Array:
    """As ``power_left`` for a twist of A itself."""
    x = rmatvec(folded.columns, twist)
    short = folded.exists * jnp.maximum(tail_norm(x) - x[0], jnp.zeros_like(x[0]))
    power = twist[0] * wrench[0]
    outer = wrench[0] * wrench[0]
    for a, b in zip(twist[1:], wrench[1:], strict=True):
        power, outer = power + a * b, outer + b * b
    return power - limit * jnp.sqrt(outer) * cone_sum(short)


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
    terms = None if demand.log_det is None else tuple(to_lanes(x) for x in demand.log_det)
    cost = criterion_value(program, u, load.size, weight, terms)

    rows = _all_rows(point)
    pull = _pull(program, rows)
    if program.curvature is not None:
        bound = _by_square(_quadratic_bound(program, pull, u), load.size)
    elif program.head_floor is None:
        bound = _by(_linear_bound(program, pull), load.size)
    else:
        assert weight is not None and terms is not None
        raw = _barrier_bound(program, pull, u)
        bound = _shifted(raw, weight, terms, program.exists, load.size)
    scale = _scale(program, point, load.size)
    short = _shortfall(program, u)
    proof = power_left(program, ray, PROVEN_LIMIT)
    off_proof = _off_proof(folded, load.twist, load.wrench, load.size, PROVEN_LIMIT)
    fine = rounding_constant() * unit_roundoff(dtype)
    status = _statuses(
        program.smoothing, problem.valid, load.off, load.rest & (weight is None), stop, short, cost, bound, scale,
        tolerance, proof, off_proof, fine,
    )  # fmt: skip

    escape = to_twist(projection, as_vector(ray[:m]))
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
def _by(x: Array, size: Array) -> Array:
    return x * size


@stage
def _by_square(x: Array, size: Array) -> Array:
    return x * size * size


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
        size = _size_of(escape)
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


def _size_of(v: Vector) -> Array:
    square = v[0] * v[0]
    for x in v[1:]:
        square = square + x * x
    size = jnp.sqrt(square)
    return jnp.where((size > 0) & jnp.isfinite(size), size, jnp.ones_like(size))
