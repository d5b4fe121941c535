"""The margin problem of wrench resistance on one tile of grasps (theory section 2), lanes on the last axis.

    t* = max t   subject to   A s = 0,   s_0,i - |s_1..,i| >= t,   sum_i s_0,i = k

A is the folded grasp map, lengths divided by L, rows orthonormalised. Substituting u = s - t e makes it a cone program

    minimise -1 + (1/k) sum_i u_0,i   subject to   B u = -a,  u in K,     a = sum_i A_i e,  B = A - a e^T / k,

whose optimal value is -t*. The internal force nearest to equal unit normal forces starts it strictly feasible, and
lambda = 0 its dual, so the bracket [1 - <c, u>, 1 - <b, y>] around t* holds from the first iteration on.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp

from ..backend import stage
from ..conic import (
    Cone,
    LinearConeProgram,
    LinearPoint,
    cone_max,
    cone_sum,
    entries,
    inner,
    rmatvec,
    tail_norm,
    vector_norm,
)
from ..contacts import (
    Folded,
    Projection,
    minus_transposed,
    normalized,
    onto_null_space,
    smallest_slack,
    stored_norm,
    to_twist,
)
from ..core import Array, unit_roundoff, vanishing_friction

__all__ = ["Start", "identity", "bound_of", "margin_program", "starting_point", "upper_bound"]


START_DEPTH = 0.3  # how far inside the cones the first forces lie, relative to their tangential size
ALIKE = 32  # units of rounding of the numbers: what may keep a twist from moving all contacts alike


def identity(folded: Folded) -> Cone:
    """e: unit normal force at every existing contact."""
    zero = jnp.zeros_like(folded.exists)
    return (folded.exists, *(zero for _ in folded.columns[1:]))


class Start(NamedTuple):
    """Where a lane begins: an interior point, and what the projection of e alone already shows.

    lower      (L,) the margin of the projected unit forces, a lower bound of t*
    escape     (L,) bool: the least-squares twist, ``A^T xi`` nearest to e, is an escape twist, so t* < 0
    unbounded  (L,) bool: e lies in the row space of A: no internal force has a normal component, t* = -inf
    """

    point: LinearPoint
    lower: Array
    escape: Array
    unbounded: Array


@stage
def _interior(exists: Array, s: Cone, lower: Array) -> Cone:
    spread = cone_max(exists * tail_norm(s))
    t = lower - START_DEPTH * jnp.maximum(spread, jnp.full_like(spread, 0.1))
    first = jnp.where(exists > 0, s[0] - t, jnp.ones_like(t))
    return (first, *(exists * x for x in s[1:]))


@stage
def _alike(columns: Cone, exists: Array, twist: Array) -> Array:
    """Whether A^T twist is e for some numbers within rounding of the grasp's, and the twist no null vector of A."""
    dtype = twist.dtype
    near, size = ALIKE * unit_roundoff(dtype), vector_norm(twist)
    x, zero = rmatvec(columns, twist), jnp.zeros_like(exists)
    off = exists * jnp.abs(x[0] - 1)
    for c, tail in zip(columns[1:], x[1:], strict=True):
        scale = jnp.sqrt(reduce(jnp.add, [row * row for row in entries(c)])[0])
        gone = scale <= vanishing_friction(dtype)
        off = jnp.maximum(
            off, jnp.where(gone, zero, jnp.abs(tail) / jnp.where(gone, jnp.ones_like(scale), scale))
        )
    return (cone_max(off) <= near * size) & (size * 128 * near <= 1)


def starting_point(folded: Folded, projection: Projection) -> Start:
    """A strictly feasible primal-dual start, from the orthogonal projection of unit normal forces onto Null(A)."""
    dtype = folded.norm.dtype
    eps = unit_roundoff(dtype)
    e = identity(folded)
    y = projection.basis.resultant  # Q e, so Q^T y is the part of e that no internal force can have
    raw = onto_null_space(projection, e)
    square = cone_sum(inner(raw, raw))
    twist = to_twist(projection, y)
    unbounded = (square <= (1024 * eps) ** 2 * folded.count) & _alike(folded.columns, folded.exists, twist)
    s = normalized(folded, raw)
    lower = smallest_slack(folded.exists, s)
    lower = jnp.where(unbounded, jnp.full_like(lower, -jnp.inf), lower)
    opposing = tuple(a - b for a, b in zip(e, raw, strict=True))
    twist_size = stored_norm(twist)
    escape = smallest_slack(folded.exists, opposing) > 64 * eps * folded.norm * twist_size

    u = _interior(folded.exists, s, jnp.where(unbounded, jnp.zeros_like(lower), lower))
    share = jnp.where(folded.exists > 0, 1 / folded.count, jnp.ones_like(folded.exists))
    z = (share, *(jnp.zeros_like(share) for _ in s[1:]))
    # A lane the projection already refutes keeps its twist as the dual point.
    keep = escape | unbounded
    dual = jnp.where(keep, -y, jnp.zeros_like(y))
    return Start(LinearPoint(dual, u, z), lower, escape, unbounded)


@stage
def _deflated(normal_column: Array, resultant: Array, share: Array) -> Array:
    return normal_column - resultant[:, None] * share


def margin_program(folded: Folded) -> LinearConeProgram:
    """The cone program whose optimal value is -t*."""
    share = folded.exists / folded.count
    first = _deflated(folded.columns[0], folded.resultant, share)
    cost = (share, *(jnp.zeros_like(share) for _ in folded.columns[1:]))
    return LinearConeProgram(
        (first, *folded.columns[1:]), -folded.resultant, cost, folded.exists, constant=-1.0
    )


@stage
def bound_of(folded: Folded, x: Cone, rounding: Array) -> Array:
    """``1 - sum_i x_0,i / rho`` with ``rho = k max_i (|x_1..,i| - x_0,i) + sum_i x_0,i``, x = -A^T y: t* is not larger.

    1 / rho is the largest multiple of y that the dual admits, so the bound needs no feasible y. ``rounding`` (k, L) of
    x: where t* is hugely negative rho is the small difference of large sums, and t* follows it squared.
    """
    exists = folded.exists
    worst = cone_max(jnp.where(exists > 0, tail_norm(x) - x[0] + rounding, jnp.full_like(x[0], -jnp.inf)))
    total, blur = cone_sum(exists * x[0]), cone_sum(exists * rounding)
    gauge, descent = folded.count * worst + total + blur, total - blur
    useful = (descent > 0) & (gauge > 0)
    return 1 - jnp.where(
        useful, descent / jnp.where(useful, gauge, jnp.ones_like(gauge)), jnp.zeros_like(gauge)
    )


def upper_bound(folded: Folded, y: Array) -> Array:
    """``bound_of`` the multipliers y of A with orthonormal rows."""
    zero = tuple(jnp.zeros_like(folded.exists) for _ in folded.columns)
    x = minus_transposed(folded.columns, zero, y)
    rounding = 4 * unit_roundoff(folded.norm.dtype) * stored_norm(y)
    return bound_of(folded, x, jnp.broadcast_to(rounding, folded.exists.shape))
