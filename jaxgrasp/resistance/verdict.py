"""From a solved lane to a verdict with its proof: polish, certify, translate back (theory section 2).

The conditions are the checker's (``certificates/resistance.py``) with a larger rounding constant, evaluated in the
working dtype: what passes here passes there. Nothing is claimed that was not certified.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp

from ..backend import stage
from ..conic import Cone, cone_min, cone_sum, entries, inner, interior_distance, matvec, rmatvec, vector_norm
from ..contacts import Folded, Tile, normalized, onto_null_space, smallest_slack, to_body, to_twist, unfold
from ..core import Array, Status, first_of, nan_where, rounding_constant, unit_roundoff
from .problem import bound_of, upper_bound
from .rank import Rank, unnoticed

__all__ = ["Verdict", "judge", "lower_end"]


BALANCED = 128  # units of rounding, of |A| |s|: half of what the checker takes for an internal force


class Verdict(NamedTuple):
    """The answer of each lane, in the units of the caller; lanes on the last axis."""

    status: Array
    margin: Array
    upper: Array
    rank: Array
    internal_force: Array  # (k n, L)
    escape_twist: Array  # (m, L)
    bound_twist: Array  # (m, L)


class Primal(NamedTuple):
    """What the solver's forces show: the internal force s next to them, and how far an exact one is.

    slack      (L,) min_i s_0,i - |s_1..,i|       near   (L,) some exact internal force has at least slack - near
    resistant  (L,) bool: it is inside every cone, and A has full rank
    """

    s: Cone
    slack: Array
    near: Array
    resistant: Array


class Dual(NamedTuple):
    """What the solver's multipliers show: an upper bound of t*, the twist behind it, and the one that escapes.

    escapes    (L,) bool: no contact can oppose the twist     deficient  (L,) bool: A has not full rank
    """

    upper: Array
    bound_twist: Array
    twist: Array
    escapes: Array
    deficient: Array


class Bracket(NamedTuple):
    """t* lies in [lower, upper] (L,); ``blur`` is what rounding can do to an end."""

    lower: Array
    upper: Array
    blur: Array


@stage
def _norms(columns: Cone, s: Cone) -> tuple[Array, Array]:
    """``|A s|`` and ``|s|``."""
    return vector_norm(matvec(columns, s)), jnp.sqrt(cone_sum(inner(s, s)))


@stage
def _unit_twist(y: Array) -> Array:
    size = vector_norm(y)
    safe = jnp.where((size > 0) & jnp.isfinite(size), size, jnp.ones_like(size))
    return y / safe


@stage
def _velocities(columns: Cone, exists: Array, xi: Array) -> tuple[Cone, Array]:
    """``x_i = A_i^T xi``, and ``|A_i|`` (k, L)."""
    square = reduce(jnp.add, [row * row for c in columns for row in entries(c)])[0]
    return rmatvec(columns, xi), exists * jnp.sqrt(square)


@stage
def _escape_depth(exists: Array, x: Cone, size: Array, rounding: Array) -> Array:
    """``min_i x_0,i - |x_1..,i| - c eps |A_i|``: positive proves that the twist behind x escapes."""
    depth = interior_distance(x) - rounding * size
    return cone_min(jnp.where(exists > 0, depth, jnp.full_like(depth, jnp.inf)))


def judge(tile: Tile, rank: Rank, u: Cone, y: Array, unbounded: Array, tolerance: Array) -> Verdict:
    """Certify one tile at the solver's forces u and multipliers y.

    rank       consulted only where the projection could not prove full rank itself
    unbounded  (L,) bool: t* = -inf
    """
    folded, m = tile.folded, y.shape[0]
    count = jnp.where(tile.projection.sigma > 0, m * jnp.ones_like(folded.norm), rank.count)
    full_rank = count >= m
    primal = _primal_evidence(tile, rank, full_rank, u)
    dual = _dual_evidence(tile, rank, full_rank, y)
    bracket = _bracket(primal, dual)
    status = _status(folded.valid, full_rank, primal, dual, bracket, tolerance)

    force = unfold(primal.s, tile.components, *tile.coefficients)
    bound_twist = _unit_twist(to_body(dual.bound_twist, folded.length, tile.dimension))
    twist = _unit_twist(to_body(dual.twist, folded.length, tile.dimension))
    twist = jnp.where(status == Status.RESISTANT.value, jnp.zeros_like(twist), twist)
    one = jnp.ones_like(folded.norm)

    def valid(x: Array) -> Array:
        return nan_where(~folded.valid, x)

    return Verdict(
        status,
        valid(jnp.where(unbounded, -jnp.inf * one, bracket.lower)),
        valid(jnp.where(unbounded, -jnp.inf * one, bracket.upper)),
        valid(count),
        valid(jnp.where(unbounded, jnp.zeros_like(force), force)),
        valid(twist),
        valid(bound_twist),
    )


def _rounding(folded: Folded) -> Array:
    dtype = folded.norm.dtype
    return jnp.asarray(rounding_constant() * unit_roundoff(dtype), dtype)


def _primal_evidence(tile: Tile, rank: Rank, full_rank: Array, u: Cone) -> Primal:
    """The exact internal force next to ``s = u - t e``: of A, or where its rank is not full of one within rounding."""
    folded, projection, rounding = tile.folded, tile.projection, _rounding(tile.folded)
    eps, one = unit_roundoff(folded.norm.dtype), jnp.ones_like(folded.norm)
    t = 1 - cone_sum(folded.exists * u[0]) / folded.count
    s = (folded.exists * (u[0] + t), *(folded.exists * x for x in u[1:]))
    s = normalized(folded, onto_null_space(projection, s))
    slack = smallest_slack(folded.exists, s)
    residual, size = _norms(folded.columns, s)
    svd = rank.smallest - rounding * folded.norm / 2
    room = jnp.where(projection.sigma > 0, projection.sigma - rounding * folded.norm, svd)
    known = (room > 0) & (full_rank | unnoticed(rank))
    safe = jnp.where(known, room, one)
    shift = jnp.sqrt(2 * one) * (residual + rounding * folded.norm * size) / safe
    # The exact internal force lies within half of this of s; its mean normal force is 1 to within ``drift``.
    distance = 2 * (residual + _evaluation(folded) * folded.norm * size) / safe + 4 * eps * size
    drift = distance / jnp.sqrt(folded.count)
    near = 2 * (distance + jnp.abs(slack) * drift)
    meant = jnp.abs(cone_sum(s[0]) - folded.count) < 0.5  # not so where s had no mean to be scaled by
    meant = meant & (residual <= BALANCED * eps * folded.norm * size)
    near = jnp.where(known & meant & (drift < 0.5), near, jnp.inf * one)
    return Primal(s, slack, near, full_rank & known & (shift < slack))


def _evaluation(folded: Folded) -> Array:
    """Rounding of ``A s`` over |A| |s| in the working dtype, and what a float64 checker with proven bounds allows."""
    terms = len(folded.columns) * folded.count
    return jnp.maximum(4 * unit_roundoff(terms.dtype), (terms + 16) * unit_roundoff("float64"))


def _dual_evidence(tile: Tile, rank: Rank, full_rank: Array, y: Array) -> Dual:
    """The bound of t*, and the twist behind it, evaluated as the twist is stored: on A.

    Where t* is huge and negative the iterates may stall, but the twist of the projection still escapes.
    """
    folded, basis = tile.folded, tile.projection.basis
    simple = basis.resultant
    better = upper_bound(basis, -simple) < upper_bound(basis, y)
    opposing = jnp.where(better, simple, -y)
    xi = _unit_twist(to_twist(tile.projection, opposing))
    x, size = _velocities(folded.columns, folded.exists, xi)
    escapes = _escape_depth(folded.exists, x, size, _rounding(folded)) > 0
    upper = bound_of(folded, x, _evaluation(folded) * size)
    deficient = ~full_rank & unnoticed(rank)
    use_null = deficient & ~escapes
    return Dual(upper, xi, jnp.where(use_null, rank.null_twist, xi), escapes, deficient)


def _bracket(primal: Primal, dual: Dual) -> Bracket:
    eps = unit_roundoff(primal.slack.dtype)
    blur = 16 * eps * (1 + jnp.abs(primal.slack) + jnp.abs(dual.upper))
    lower, upper = primal.slack - blur - primal.near, dual.upper + blur
    return Bracket(lower_end(lower, upper, blur), upper, blur)


def lower_end(lower: Array, upper: Array, blur: Array) -> Array:
    """``lower`` as far as it may be said beside ``upper``: rounding, ``blur``, must not turn the bracket round.

    Forces far beyond their mean show nothing, nor do those that contradict the twist by more than rounding.
    """
    nothing = (lower < -1 / (64 * unit_roundoff(lower.dtype))) | (lower > upper + 4 * blur)
    return jnp.where(nothing, -jnp.inf, jnp.minimum(lower, upper))


def _status(
    valid: Array, full_rank: Array, primal: Primal, dual: Dual, bracket: Bracket, tolerance: Array
) -> Array:
    close = tolerance + 2 * bracket.blur
    marginal = full_rank & (bracket.lower >= -close) & (bracket.upper <= close)
    return first_of(
        [
            (~valid, Status.INVALID),
            (primal.resistant, Status.RESISTANT),
            (dual.deficient | dual.escapes, Status.NOT_RESISTANT),
            (marginal, Status.MARGINAL),
        ],
        Status.UNDECIDED,
    )
