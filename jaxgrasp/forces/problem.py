"""The force problem of one tile of grasps as a cone program (section 11.3, theory section 3), lanes on the last axis.

    min h(f)   subject to   G f + w = 0,  f_i in C_i,  f_n,i <= max_i,  |J^T f| <= tau_max

In folded forces s (f = mu s, gamma s, s) with lengths over L this is ``A s = -w``, one unit cone per contact. With
A = L_A Q, Q of orthonormal rows, and the load scaled to ``size``: ``Q u = b = -L_A^-1 w / size``, ``s = size u``. Rows
of A that depend on others drop out; a load outside their range is refuted by linear algebra alone.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..backend import stage, to_lanes
from ..conic import (
    Bounds,
    Cone,
    ConvexConeProgram,
    ConvexPoint,
    Curvature,
    Vector,
    as_vector,
    cone_max,
    cone_sum,
    null_combination,
    rmatvec,
    solve_lower,
    tail_norm,
    vector_norm,
)
from ..contacts import Component, Contacts, Folded, Projection
from ..core import Array, unit_roundoff
from .criteria import Criterion

__all__ = ["Balance", "Demand", "Load", "balance", "starting_point"]

FORCE_LIMIT = 1e9  # loads: forces up to this many must be ruled out before infeasible counts as proven


class Demand(NamedTuple):
    """What is asked of each grasp, as rows.

    wrench    (N, m) in N and N m                 criterion  its weights one per row
    cap       (N, k) largest f_n in N, or None    log_det    (a, b, c), (N, k) each: log det P, or None
    jacobian  (N, k n, q), or None                torque     (N, q) tau_max, or None
    smoothing (N,) in units of the cost, or None
    """

    wrench: Array
    criterion: Criterion
    log_det: tuple[Array, Array, Array] | None
    cap: Array | None
    jacobian: Array | None
    torque: Array | None
    smoothing: Array | None = None


class Load(NamedTuple):
    """The load of a tile in the metric of A.

    wrench  m arrays (L,): force and torque / L     rhs     (m, L): b
    size    (L,) N: forces are ``size u``           off     (L,) bool: outside the range of A
    twist   m arrays (L,): for lanes that are off, a twist no force can oppose, with positive power of the load
    rest    (L,) bool: no load at all
    """

    wrench: Vector
    rhs: Array
    size: Array
    off: Array
    twist: Vector
    rest: Array


class Balance(NamedTuple):
    """A tile's force problem, scaled, and how to read it back.

    valid  (L,) bool: the numbers are a problem      row_norm  (q, L): E is divided by it, or None
    """

    program: ConvexConeProgram
    load: Load
    valid: Array
    row_norm: Array | None


@stage
def _scaled_wrench(force: Array, torque: Array, length: Array) -> tuple[Array, Array]:
    """(force; torque / L), and whether it is finite."""
    rows = [force[i] for i in range(force.shape[0])] + [torque[i] / length for i in range(torque.shape[0])]
    finite = jnp.isfinite(rows[0])
    for x in rows[1:]:
        finite = finite & jnp.isfinite(x)
    return jnp.stack([jnp.where(finite, x, jnp.zeros_like(x)) for x in rows]), finite


@stage
def _load_size(
    inner: Vector, left: Vector, wrench: Vector, norm: Array, weight: Array | None
) -> tuple[Array, Array, Array, Array]:
    """b, the size, whether the load is off the range, whether there is none."""
    dtype = norm.dtype
    size, leftover, outer = vector_norm(inner), vector_norm(left), vector_norm(wrench)
    rounding = jnp.asarray(256 * unit_roundoff(dtype), dtype) * (outer + norm * size)
    off = leftover > rounding
    rest = outer == 0
    total = size if weight is None else size + weight
    total = jnp.where(total > 0, total, jnp.ones_like(total))
    return jnp.stack([-x / total for x in inner]), total, off, rest


def load(folded: Folded, projection: Projection, demand: Demand, dimension: int) -> tuple[Load, Array]:
    """The load in the metric of A, and which lanes are finite."""
    wrench = to_lanes(demand.wrench)
    rows, finite = _scaled_wrench(wrench[:dimension], wrench[dimension:], folded.length)
    outer = as_vector(rows)
    inner, left = solve_lower(projection.factor, outer)
    rhs, size, off, rest = _load_size(inner, left, outer, folded.norm, demand.criterion.barrier_weight)
    twist = null_combination(projection.factor, left)
    return Load(outer, rhs, size, off, twist, rest), finite


@stage
def _limits(
    cap: Array | None, torque: Array | None, exists: Array, size: Array, norm: Array | None
) -> tuple[Array | None, Array | None, Array]:
    """Scaled caps and bounds; lanes whose limits are positive numbers."""
    sound = jnp.ones_like(size) > 0
    if cap is not None:
        good = (cap > 0) | (exists == 0)  # NaN compares false
        for i in range(cap.shape[0]):
            sound = sound & good[i]
        cap = jnp.where(good & (exists > 0), cap / size, jnp.full_like(cap, jnp.inf))
    if torque is not None and norm is not None:
        good = (torque > 0) & jnp.isfinite(torque)
        for j in range(torque.shape[0]):
            sound = sound & good[j]
        torque = jnp.where(good, torque, jnp.ones_like(torque)) / (size * norm)
    return cap, torque, sound


def torque_rows(
    demand: Demand,
    contacts: Contacts,
    exists: Array,
    components: tuple[Component, ...],
    row_norm: Array | None = None,
) -> tuple[Cone, Array, Array]:
    """E with ``E s = J^T f``, normal components first, rows of norm 1; the norms; which lanes are finite."""
    order = sorted(range(len(components)), key=lambda c: components[c] is not Component.NORMAL)

    @stage
    def run(jacobian: Array, exists: Array, friction: Array, torsion: Array) -> tuple[Cone, Array, Array]:
        scale = {Component.NORMAL: jnp.ones_like(friction), Component.SPIN: torsion}
        zero = jnp.zeros_like(jacobian[0])
        parts, square = [], zero
        for c in order:
            factor = scale.get(components[c], friction)
            rows = []
            for i in range(exists.shape[0]):
                value = jnp.where(exists[i] > 0, jacobian[i * len(order) + c] * factor[i], zero)
                rows.append(value)
                square = square + value * value
            parts.append(rows)
        norm = jnp.sqrt(square) if row_norm is None else row_norm
        usable = jnp.isfinite(norm) & (norm > 0)
        sound = jnp.isfinite(norm[0])
        for j in range(1, norm.shape[0]):
            sound = sound & jnp.isfinite(norm[j])
        norm = jnp.where(usable, norm, jnp.ones_like(norm))
        columns = tuple(
            jnp.stack([jnp.where(usable, x / norm, zero) for x in rows], axis=1) for rows in parts
        )
        return columns, norm, sound

    assert demand.jacobian is not None
    arrays = (to_lanes(demand.jacobian), exists, to_lanes(contacts.friction), to_lanes(contacts.torsion))
    return run(*arrays)


@stage
def _joined(upper: Cone, lower: Cone) -> Cone:
    return tuple(jnp.concatenate([a, b]) for a, b in zip(upper, lower, strict=True))


def curvature(
    criterion: Criterion, contacts: Contacts, exists: Array, components: tuple[Component, ...]
) -> Curvature | None:
    """D of ``<s, D s> / 2``, or None."""
    kinds = (Component.NORMAL, *(c for c in components if c is not Component.NORMAL))

    @stage
    def run(criterion: Criterion, exists: Array, friction: Array, torsion: Array) -> tuple[Array | None, ...]:
        parts = [criterion.curvature(c, friction, torsion) for c in kinds]
        return tuple(None if x is None else 2 * jnp.where(exists > 0, x, jnp.zeros_like(x)) for x in parts)

    parts = run(criterion, exists, to_lanes(contacts.friction), to_lanes(contacts.torsion))
    head = parts[0]
    if head is None:
        return None
    tail = parts[1] if parts[1:] else jnp.zeros_like(head)
    last = parts[-1] if Component.SPIN in kinds else None
    assert tail is not None
    return Curvature(head, tail, last)


@stage
def _floors(
    weight: Array, on_normal: Array, on_cone: Array, exists: Array, size: Array
) -> tuple[Array, Array]:
    share = exists * (weight / size)
    return 2 * share * on_cone, share * on_normal


@stage
def _all(flags: list[Array]) -> Array:
    total = flags[0]
    for flag in flags[1:]:
        total = total & flag
    return total


@stage
def _positive_weight(weight: Array) -> tuple[Array, Array]:
    good = (weight > 0) & jnp.isfinite(weight)
    return jnp.where(good, weight, jnp.ones_like(weight)), good


def cone_program(
    contacts: Contacts,
    exists: Array,
    columns: Cone,
    rhs: Array,
    size: Array,
    demand: Demand,
    components: tuple[Component, ...],
    row_norm: Array | None = None,
) -> tuple[ConvexConeProgram, Array | None, Array]:
    """The program for forces ``size u``, ``columns u = rhs``; the norms of its torque rows; which limits are numbers.

    ``row_norm`` fixes what the torque rows are divided by.
    """
    criterion = demand.criterion
    sound = exists[0] == exists[0]
    if demand.jacobian is not None:
        rows, norm, sound = torque_rows(demand, contacts, exists, components, row_norm)
        columns, row_norm = _joined(columns, rows), norm
    cap, bound, good = _limits(
        None if demand.cap is None else to_lanes(demand.cap),
        None if demand.torque is None else to_lanes(demand.torque),
        exists,
        size,
        row_norm,
    )
    cone_floor = head_floor = None
    weight = criterion.barrier_weight
    if weight is not None:
        assert demand.log_det is not None
        on_normal, on_cone, _ = (to_lanes(x) for x in demand.log_det)
        cone_floor, head_floor = _floors(weight, on_normal, on_cone, exists, size)
    curved = curvature(criterion, contacts, exists, components)
    program = ConvexConeProgram(
        columns,
        rhs,
        exists,
        exists if criterion.price else None,
        curved,
        jnp.ones_like(size) if criterion.level else None,
        cap,
        bound,
        cone_floor,
        head_floor,
        None if demand.smoothing is None else _per_size(demand.smoothing, size, curved is not None),
    )
    return program, row_norm, _all([sound, good])


def _per_size(smoothing: Array, size: Array, squared: bool) -> Array:
    return smoothing / (size * size) if squared else smoothing / size


def balance(
    contacts: Contacts,
    folded: Folded,
    projection: Projection,
    demand: Demand,
    components: tuple[Component, ...],
    dimension: int,
) -> Balance:
    """The cone program of a tile."""
    criterion = demand.criterion
    sound = [folded.valid]
    for name in ("weight", "length"):
        value = getattr(criterion, name, None)
        if value is not None:
            value, good = _positive_weight(value)
            criterion = eqx.tree_at(lambda c, name=name: getattr(c, name), criterion, value)
            sound.append(good)
    demand = demand._replace(criterion=criterion)
    loaded, finite = load(folded, projection, demand, dimension)
    program, norm, good = cone_program(
        contacts, folded.exists, projection.basis.columns, loaded.rhs, loaded.size, demand, components
    )
    return Balance(program, loaded, _all([*sound, finite, good]), norm)


# Where a lane begins ------------------------------------------------------------------------------------


@stage
def _first_forces(program: ConvexConeProgram, basis: Cone, count: Array) -> tuple[Cone, Array]:
    """The least-norm forces, pressed into the cones: ``u = Q^T b + depth e``."""
    exists = program.exists
    least = rmatvec(basis, as_vector(program.rhs))
    depth = 1 + cone_max(exists * jnp.maximum(tail_norm(least) - least[0], jnp.zeros_like(exists)))
    if program.cone_floor is not None and program.head_floor is not None:
        depth = jnp.maximum(depth, count * cone_max(program.cone_floor + program.head_floor))
    head = jnp.where(exists > 0, least[0] + depth, jnp.ones_like(exists))
    share = exists
    if program.curvature is not None:  # D u must be inside the cone, too
        steepest = program.curvature.tail
        if program.curvature.last is not None:
            steepest = jnp.maximum(steepest, program.curvature.last)
        share = exists / jnp.maximum(jnp.ones_like(exists), steepest / 2)
    return (head, *(share * x for x in least[1:])), depth


@stage
def _first_prices(program: ConvexConeProgram, u: Cone, depth: Array, count: Array) -> ConvexPoint:
    """Slacks and prices that make the first forces dual feasible with y = 0, all products about ``depth / k``."""
    exists, one = program.exists, jnp.ones_like(program.exists)
    masks = program.masks()
    share = one / count
    xi = level = level_price = cap = cap_price = head = head_price = None
    if program.level is not None:
        xi = cone_max(exists * u[0]) + depth
        level = jnp.where(exists > 0, xi - u[0], one)
        level_price = jnp.where(exists > 0, share, one)
    if program.cap is not None and masks.cap is not None:
        room = jnp.where(masks.cap > 0, program.cap, one) - u[0]
        cap = jnp.where(masks.cap > 0, jnp.maximum(room, depth / 2), one)
        cap_price = jnp.where(masks.cap > 0, share / 2, one)
    if program.head_floor is not None:
        head = u[0]
        head_price = jnp.where(exists > 0, jnp.minimum(program.head_floor / u[0], share / 2), one)
        head_price = jnp.maximum(head_price, share / 100)
    upper = price = None
    if program.bound is not None:
        _, product = program.products(u)
        size = jnp.abs(product)
        upper = jnp.maximum(program.bound - size, 0.5 * jnp.maximum(program.bound, size))
        price = (depth / count) / upper
    slack = Bounds(level, cap, head, upper, upper)
    point = ConvexPoint(
        jnp.zeros_like(program.rhs), xi, u, u, slack, Bounds(level_price, cap_price, head_price, price, price)
    )
    z = program.stationarity(point)
    z = (jnp.where(exists > 0, z[0], one), *(exists * x for x in z[1:]))
    return point._replace(z=z)


def starting_point(balance: Balance, projection: Projection, count: Array) -> ConvexPoint:
    """Dual feasible, inside every inequality; what ``B u = b`` and the limits lack is left to the solver."""
    u, depth = _first_forces(balance.program, projection.basis.columns, count)
    return _first_prices(balance.program, u, depth, count)


# Proofs that a load cannot be held ----------------------------------------------------------------------


@stage
def power_left(program: ConvexConeProgram, rows: Array, limit: float) -> Array:
    """``y.w - sum_i min(cap_i, limit) (|x_t,i| - x_0,i)+ - |beta|.bound`` over ``y.w``, x = A^T y + E^T beta.

    Positive, with y.w > 0: the load does more work along the twist y (the joints moving at beta) than forces up to
    ``limit`` times the load and torques up to their bounds can take up. Without limits: ``A_i^T y`` is in every cone.
    """
    m = program.rhs.shape[0]
    x = rmatvec(program.columns, as_vector(rows))
    short = program.exists * jnp.maximum(tail_norm(x) - x[0], jnp.zeros_like(x[0]))
    most = jnp.full_like(short, limit)
    if program.cap is not None:
        most = jnp.minimum(most, program.cap)
    taken = cone_sum(short * most)
    if program.bound is not None:
        for j in range(program.bound.shape[0]):
            taken = taken + jnp.abs(rows[m + j]) * program.bound[j]
    power = -program.rhs[0] * rows[0]
    for i in range(1, m):
        power = power - program.rhs[i] * rows[i]
    worth = power > 0
    return jnp.where(worth, 1 - taken / jnp.where(worth, power, jnp.ones_like(power)), -jnp.ones_like(power))


def proves(program: ConvexConeProgram, rows: Array) -> Array:
    """Whether ``rows`` prove that no forces up to ``FORCE_LIMIT`` times the load balance it."""
    return power_left(program, rows, FORCE_LIMIT) > 0.5
