"""From a solved lane to a verdict with its proof: polish, certify, translate back (theory section 2).

The conditions are the checker's (``certificate.py``) with a larger rounding constant, evaluated in the working dtype:
what passes here passes there. Nothing is claimed that was not certified.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..backend import stage
from ..conic import Cone, Vector, cone_min, cone_sum, inner, interior_distance, matvec, rmatvec
from ..contacts import (
    Component,
    Folded,
    Projection,
    normalized,
    onto_null_space,
    smallest_slack,
    to_twist,
    unfold,
)
from ..core import Array, Status, rank_tolerance, rounding_constant, unit_roundoff
from .problem import upper_bound

__all__ = ["Rank", "Verdict", "judge"]


class Rank(NamedTuple):
    """Rank of A by its singular values: count (L,), smallest value (L,), its left vector (m, L)."""

    count: Array
    smallest: Array
    null_twist: Array


class Verdict(NamedTuple):
    """The answer of each lane, in the units of the caller; lanes on the last axis."""

    status: Array
    margin: Array
    gap: Array
    rank: Array
    internal_force: Array  # (k n, L)
    escape_twist: Array  # (m, L)


@stage
def _norms(columns: Cone, s: Cone) -> tuple[Array, Array]:
    """``|A s|`` and ``|s|``."""
    applied = matvec(columns, s)
    square = applied[0] * applied[0]
    for i in range(1, applied.shape[0]):
        square = square + applied[i] * applied[i]
    return jnp.sqrt(square), jnp.sqrt(cone_sum(inner(s, s)))


@stage
def _unit_twist(y: Vector) -> Vector:
    square = y[0] * y[0]
    for v in y[1:]:
        square = square + v * v
    size = jnp.sqrt(square)
    safe = jnp.where((size > 0) & jnp.isfinite(size), size, jnp.ones_like(size))
    return tuple(v / safe for v in y)


@stage
def _escape_depth(columns: Cone, exists: Array, xi: Vector, rounding: Array) -> Array:
    """``min_i x_0,i - |x_1..,i| - c eps |A_i|`` with ``x = A^T xi``: positive proves that xi escapes."""
    x = rmatvec(columns, xi)
    square = None
    for c in columns:
        for i in range(c.shape[0]):
            square = c[i] * c[i] if square is None else square + c[i] * c[i]
    assert square is not None
    depth = interior_distance(x) - rounding * jnp.sqrt(square)
    return cone_min(jnp.where(exists > 0, depth, jnp.full_like(depth, jnp.inf)))


@stage
def _unseen(columns: Cone, xi: Vector) -> Array:
    """``|A^T xi|``: zero for a twist that no contact notices."""
    x = rmatvec(columns, xi)
    return jnp.sqrt(cone_sum(inner(x, x)))


def judge(
    folded: Folded,
    projection: Projection,
    unbounded: Array,
    rank: Rank,
    u: Cone,
    y: Vector,
    tolerance: Array,
    components: tuple[Component, ...],
    friction: Array,
    torsion: Array,
    dimension: int,
) -> Verdict:
    """Certify one tile. ``rank`` is consulted only where the projection could not prove full rank itself."""
    dtype = folded.norm.dtype
    eps = unit_roundoff(dtype)
    rounding = jnp.asarray(rounding_constant() * eps, dtype)
    m = len(y)
    one = jnp.ones_like(folded.norm)

    # Primal evidence: the exact internal force next to s = u - t e ...
    t = 1 - cone_sum(folded.exists * u[0]) / folded.count
    s = (folded.exists * (u[0] + t), *(folded.exists * x for x in u[1:]))
    s = normalized(folded, onto_null_space(projection, s))
    slack = smallest_slack(folded.exists, s)
    residual, size = _norms(folded.columns, s)
    proven = projection.sigma > 0
    sigma = jnp.where(proven, projection.sigma, rank.smallest)
    count = jnp.where(proven, m * one, rank.count)
    full_rank = count >= m
    room = sigma - rounding * folded.norm
    shift = jnp.sqrt(2 * one) * (residual + rounding * folded.norm * size) / jnp.where(room > 0, room, one)
    resistant = full_rank & (room > 0) & (shift < slack)

    # ... and dual evidence: the bound of t*, and the twist behind it. Where t* is huge and negative the iterates may
    # stall, but the twist of the projection still escapes.
    simple = projection.basis.resultant
    upper = upper_bound(projection.basis, y)
    bound = upper_bound(projection.basis, tuple(-v for v in simple))
    better = bound < upper
    upper = jnp.where(better, bound, upper)
    opposing = tuple(jnp.where(better, a, -b) for a, b in zip(simple, y, strict=True))
    xi = _unit_twist(to_twist(projection, opposing))
    escapes = _escape_depth(folded.columns, folded.exists, xi, rounding) > 0
    null = tuple(rank.null_twist[i] for i in range(m))
    deficient = ~full_rank & (_unseen(folded.columns, null) <= rank_tolerance(dtype) * folded.norm)

    # The exact internal force next to s lies within near / 2 of it, so its slack is at least slack - near.
    blur = 16 * eps * (1 + jnp.abs(slack) + jnp.abs(upper))
    near = 2 * jnp.sqrt(2 * one) * (residual + 4 * eps * folded.norm * size) / jnp.where(room > 0, room, one)
    margin = slack - blur - jnp.where(full_rank & (room > 0), near, jnp.zeros_like(near))
    upper = upper + blur
    margin, upper = (
        jnp.minimum(margin, upper),
        jnp.maximum(margin, upper),
    )  # rounding must not turn the bracket round
    gap = upper - margin
    close = tolerance + 2 * blur
    marginal = full_rank & (margin >= -close) & (margin + gap <= close)

    def choose(status: Status, where: Array, otherwise: Array) -> Array:
        return jnp.where(where, jnp.int32(status.value), otherwise)

    status = choose(Status.MARGINAL, marginal, jnp.full(one.shape, Status.UNDECIDED.value, jnp.int32))
    status = choose(Status.NOT_RESISTANT, deficient | escapes, status)
    status = choose(Status.RESISTANT, resistant, status)
    status = choose(Status.INVALID, ~folded.valid, status)

    none = unbounded
    margin = jnp.where(none, -jnp.inf * one, margin)
    gap = jnp.where(none, jnp.zeros_like(gap), gap)
    nan = jnp.nan * one
    force = unfold(s, components, friction, torsion)
    force = jnp.where(none, jnp.zeros_like(force), force)

    use_null = deficient & ~escapes
    xi = tuple(jnp.where(use_null, b, a) for a, b in zip(xi, null, strict=True))
    physical = tuple(v if i < dimension else v / folded.length for i, v in enumerate(xi))
    twist = jnp.stack(_unit_twist(physical))
    twist = jnp.where(status == Status.RESISTANT.value, jnp.zeros_like(twist), twist)

    def valid(x: Array) -> Array:
        return jnp.where(folded.valid, x, nan)

    return Verdict(status, valid(margin), valid(gap), valid(count), valid(force), valid(twist))
