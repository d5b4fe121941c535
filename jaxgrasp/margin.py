"""The margin problem of wrench resistance on one tile of grasps (theory section 2), lanes on the last axis.

    t* = max t   subject to   A s = 0,   s_0,i - |s_1..,i| >= t,   sum_i s_0,i = k

A is the folded grasp map, lengths divided by L, rows orthonormalised. Substituting u = s - t e makes it a cone program

    minimise -1 + (1/k) sum_i u_0,i   subject to   B u = -a,  u in K,     a = sum_i A_i e,  B = A - a e^T / k,

whose optimal value is -t*. The internal force nearest to equal unit normal forces starts it strictly feasible, and
lambda = 0 its dual, so the bracket [1 - <c, u>, 1 - <b, y>] around t* holds from the first iteration on.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ._types import Array, rank_tolerance, rounding_constant, unit_roundoff
from .cones import Cone, cone_max, cone_min, cone_sum, inner, interior_distance, tail_norm
from .contacts import Component
from .geometry import cross_components, frame_components, normalize_components
from .lanes import to_lanes
from .solver import ConeProgram, Iterate
from .solver.linear import (
    Cholesky,
    Vector,
    inverse_frobenius,
    matvec,
    orthonormal_rows,
    rmatvec,
    solve_transposed,
    vector_norm,
)
from .solver.stages import stage

__all__ = [
    "Contacts",
    "Folded",
    "Projection",
    "fold",
    "margin_program",
    "project",
    "starting_point",
    "upper_bound",
]

_size = stage(vector_norm)

START_DEPTH = 0.3  # how far inside the cones the first forces lie, relative to their tangential size


class Contacts(NamedTuple):
    """Grasps as rows: position, normal (N, k, dim); friction, torsion, active (N, k)."""

    position: Array
    normal: Array
    friction: Array
    torsion: Array
    active: Array


class Folded(NamedTuple):
    """The folded grasp map A of a tile, lengths divided by L.

    columns  d arrays (m, k, L): normal column first, then the scaled tangents and spin
    exists   (k, L) ones and zeros      count   (L,) active contacts
    length   (L,) L in m                valid   (L,) bool: the numbers are a grasp
    norm     (L,) Frobenius norm of A   resultant  m arrays (L,): a, the wrench of unit normal forces
    """

    columns: Cone
    exists: Array
    count: Array
    length: Array
    valid: Array
    norm: Array
    resultant: Vector


@stage
def _screen(
    position: tuple[Array, ...], normal: tuple[Array, ...], friction: Array, torsion: Array, active: Array
) -> tuple[Array, Array]:
    """Which lanes are grasps, and which of their contacts count; coordinates and coefficients (k, L)."""
    usable = jnp.isfinite(friction) & jnp.isfinite(torsion) & (friction >= 0) & (torsion >= 0)
    points = jnp.zeros_like(usable)
    for x in normal:
        points = points | (x != 0)
    for x in (*position, *normal):
        usable = usable & jnp.isfinite(x)
    sound = (usable & points) | ~active
    valid, some = sound[0], active[0]
    for i in range(1, active.shape[0]):
        valid, some = valid & sound[i], some | active[i]
    valid = valid & some
    return valid, active & valid


@stage
def _length(position: tuple[Array, ...]) -> Array:
    square = position[0] * position[0]
    for x in position[1:]:
        square = square + x * x
    largest = jnp.sqrt(cone_max(square))
    return jnp.where(largest > 0, largest, jnp.ones_like(largest))


@stage
def _unit(normal: tuple[Array, ...]) -> tuple[Array, ...]:
    return normalize_components(normal)


@stage
def _column(point: tuple[Array, ...], direction: tuple[Array, ...], factor: Array) -> Array:
    return jnp.stack([factor * x for x in (*direction, *cross_components(point, direction))])


@stage
def _spin_column(normal: tuple[Array, ...], factor: Array) -> Array:
    return jnp.stack([*(jnp.zeros_like(x) for x in normal), *(factor * x for x in normal)])


@stage
def _resultant(normal_column: Array) -> Vector:
    return tuple(cone_sum(normal_column[i]) for i in range(normal_column.shape[0]))


@stage
def _frobenius(columns: Cone) -> Array:
    total = None
    for c in columns:
        for i in range(c.shape[0]):
            part = cone_sum(c[i] * c[i])
            total = part if total is None else total + part
    assert total is not None
    return jnp.sqrt(total)


def fold(contacts: Contacts, components: tuple[Component, ...], length: Array | None = None) -> Folded:
    """A of a tile of L rows. Contacts that do not count get zero columns; invalid lanes are all zero.

    ``length`` (L,) is what lengths are divided by, by default the largest distance of a contact from the origin.
    """
    position, normal = to_lanes(contacts.position), to_lanes(contacts.normal)
    friction, torsion, active = (
        to_lanes(contacts.friction),
        to_lanes(contacts.torsion),
        to_lanes(contacts.active),
    )
    dtype, dimension = position.dtype, position.shape[1]
    coordinates = (
        tuple(position[:, i] for i in range(dimension)),
        tuple(normal[:, i] for i in range(dimension)),
    )
    valid, live = _screen(*coordinates, friction, torsion, active)
    exists = live.astype(dtype)
    point = tuple(jnp.where(live, position[:, i], jnp.zeros_like(position[:, i])) for i in range(dimension))
    length = _length(point) if length is None else length
    point = tuple(x / length for x in point)
    last = [jnp.zeros((), dtype)] * (dimension - 1) + [jnp.ones((), dtype)]
    direction = _unit(tuple(jnp.where(live, normal[:, i], last[i]) for i in range(dimension)))
    frames = frame_components(direction)

    mu = jnp.where(live, friction, jnp.zeros_like(friction))
    gamma = jnp.where(live, torsion, jnp.zeros_like(torsion)) / length
    columns = [_column(point, direction, exists)]
    for component in components:
        if component is Component.SPIN:
            columns.append(_spin_column(direction, gamma))
        elif component is not Component.NORMAL:
            columns.append(_column(point, frames[0 if component is Component.TANGENT_1 else 1], mu))
    return Folded(
        tuple(columns),
        exists,
        jnp.maximum(cone_sum(exists), jnp.ones_like(length)),
        length,
        valid,
        _frobenius(tuple(columns)),
        _resultant(columns[0]),
    )


class Projection(NamedTuple):
    """``A = L Q``: Q has orthonormal rows, hence the same null space and the same margin, and far better numbers.

    basis   the tile with Q in place of A
    factor  L
    sigma   (L,) proven lower bound of the smallest singular value of A, 0 where none is proven; sigma > 0 proves rank m
    """

    basis: Folded
    factor: Cholesky
    sigma: Array


def project(folded: Folded) -> Projection:
    """Orthonormalise the rows of A; ``sigma >= 1 / |L^-1| - c eps |A|`` allows for rounding in L."""
    dtype = folded.norm.dtype
    columns, factor = orthonormal_rows(folded.columns, rank_tolerance(dtype) * folded.norm)
    basis = folded._replace(columns=columns, resultant=_resultant(columns[0]))
    rounding = rounding_constant() * unit_roundoff(dtype) * folded.norm
    sigma = 1 / jnp.sqrt(inverse_frobenius(factor)) - rounding
    return Projection(basis, factor, jnp.maximum(sigma, jnp.zeros_like(sigma)))


def to_twist(projection: Projection, y: Vector) -> Vector:
    """The twist lambda of A for the multipliers y of Q: ``A^T lambda = Q^T y``, ``lambda = L^-T y``."""
    return solve_transposed(projection.factor, y)


@stage
def _applied(columns: Cone, s: Cone) -> Vector:
    applied = matvec(columns, s)
    return tuple(applied[i] for i in range(applied.shape[0]))


@stage
def _removed(columns: Cone, s: Cone, y: Vector) -> Cone:
    return tuple(a - b for a, b in zip(s, rmatvec(columns, y), strict=True))


def onto_null_space(projection: Projection, s: Cone) -> Cone:
    """``s - Q^T Q s``, twice, so that A s is rounding."""
    columns = projection.basis.columns
    for _ in range(2):
        s = _removed(columns, s, _applied(columns, s))
    return s


@stage
def _with_mean_one(s: Cone, count: Array) -> Cone:
    total = cone_sum(s[0])
    factor = count / jnp.where(total > 0, total, jnp.ones_like(total))
    return tuple(factor * x for x in s)


def normalized(folded: Folded, s: Cone) -> Cone:
    """``s`` scaled to a mean normal force of 1 over the existing contacts."""
    return _with_mean_one(s, folded.count)


@stage
def smallest_slack(exists: Array, s: Cone) -> Array:
    """``min_i s_0,i - |s_1..,i|`` over the existing contacts."""
    distance = interior_distance(s)
    return cone_min(jnp.where(exists > 0, distance, jnp.full_like(distance, jnp.inf)))


def identity(folded: Folded) -> Cone:
    """e: unit normal force at every existing contact."""
    zero = jnp.zeros_like(folded.exists)
    return (folded.exists, *(zero for _ in folded.columns[1:]))


class Start(NamedTuple):
    """Where a lane begins: an interior iterate, and what the projection of e alone already shows.

    lower      (L,) the margin of the projected unit forces, a lower bound of t*
    escape     (L,) bool: the least-squares twist, ``A^T xi`` nearest to e, is an escape twist, so t* < 0
    unbounded  (L,) bool: e lies in the row space of A: no internal force has a normal component, t* = -inf
    """

    iterate: Iterate
    lower: Array
    escape: Array
    unbounded: Array


@stage
def _interior(exists: Array, s: Cone, lower: Array) -> Cone:
    spread = cone_max(exists * tail_norm(s))
    t = lower - START_DEPTH * jnp.maximum(spread, jnp.full_like(spread, 0.1))
    first = jnp.where(exists > 0, s[0] - t, jnp.ones_like(t))
    return (first, *(exists * x for x in s[1:]))


def starting_point(folded: Folded, projection: Projection) -> Start:
    """A strictly feasible primal-dual start, from the orthogonal projection of unit normal forces onto Null(A)."""
    dtype = folded.norm.dtype
    eps = unit_roundoff(dtype)
    e = identity(folded)
    y = projection.basis.resultant  # Q e, so Q^T y is the part of e that no internal force can have
    raw = onto_null_space(projection, e)
    square = cone_sum(inner(raw, raw))
    unbounded = square <= (1024 * eps) ** 2 * folded.count
    s = normalized(folded, raw)
    lower = smallest_slack(folded.exists, s)
    lower = jnp.where(unbounded, jnp.full_like(lower, -jnp.inf), lower)
    opposing = tuple(a - b for a, b in zip(e, raw, strict=True))
    twist_size = _size(to_twist(projection, y))
    escape = smallest_slack(folded.exists, opposing) > 64 * eps * folded.norm * twist_size

    u = _interior(folded.exists, s, jnp.where(unbounded, jnp.zeros_like(lower), lower))
    share = jnp.where(folded.exists > 0, 1 / folded.count, jnp.ones_like(folded.exists))
    z = (share, *(jnp.zeros_like(share) for _ in s[1:]))
    # A lane the projection already refutes keeps its twist as the dual point.
    keep = escape | unbounded
    dual = tuple(jnp.where(keep, -v, jnp.zeros_like(v)) for v in y)
    return Start(Iterate(dual, u, z), lower, escape, unbounded)


@stage
def _deflated(normal_column: Array, resultant: Vector, share: Array) -> Array:
    return jnp.stack([normal_column[i] - r * share for i, r in enumerate(resultant)])


def margin_program(folded: Folded) -> ConeProgram:
    """The cone program whose optimal value is -t*."""
    share = folded.exists / folded.count
    first = _deflated(folded.columns[0], folded.resultant, share)
    cost = (share, *(jnp.zeros_like(share) for _ in folded.columns[1:]))
    rhs = tuple(-r for r in folded.resultant)
    return ConeProgram((first, *folded.columns[1:]), rhs, cost, folded.exists, constant=-1.0)


@stage
def _gauge(exists: Array, count: Array, v: Cone) -> Array:
    reach = v[0] + tail_norm(v)
    worst = cone_max(jnp.where(exists > 0, reach, jnp.full_like(reach, -jnp.inf)))
    return count * worst - cone_sum(exists * v[0])


def upper_bound(folded: Folded, y: Vector) -> Array:
    """``1 + a.y / rho(y)`` with ``rho(y) = k max_i (v_n,i + |v_t,i|) - sum_i v_n,i``, ``v = A^T y``: t* is not larger.

    1 / rho is the largest multiple of y that the dual admits, so the bound needs no feasible y. rho grows by the
    rounding of v: where t* is hugely negative it is the small difference of large sums, and t* follows it squared.
    """
    zero = tuple(jnp.zeros_like(folded.exists) for _ in folded.columns)
    v = _removed(folded.columns, zero, tuple(-x for x in y))
    rounding = 4 * unit_roundoff(folded.norm.dtype) * folded.count * _size(y)
    gauge = _gauge(folded.exists, folded.count, v) + rounding
    descent = folded.resultant[0] * y[0]
    for a, b in zip(folded.resultant[1:], y[1:], strict=True):
        descent = descent + a * b
    useful = (descent < 0) & (gauge > 0)
    return 1 + jnp.where(
        useful, descent / jnp.where(useful, gauge, jnp.ones_like(gauge)), jnp.zeros_like(gauge)
    )
