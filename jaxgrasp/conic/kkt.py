"""The Newton system of a ``ConvexProgram``: O(k) blocks, one small factorisation, any number of right-hand sides.

With p = W^-1 du in frame coordinates, the rows R = (B; E), the rates delta = price / slack of the level:

    K p = h - W e_0 head + W e_0 delta dxi - W R^T dr
    R W p - (0; dr_E / rate) = rows
    sum_i delta_i (dxi - du_0,i) = level

Eliminating p leaves a positive definite system ``S S^T dr = ..`` with the columns ``C = R W L^-T``, K = L L^T, in S.
The level xi borders the blocks as the shaft of an arrow and adds one column to C; the two-sided rows add a diagonal.
S S^T is never formed: near a degenerate optimum its condition number is that of S squared, 1 / gap^2, and half of the
digits of the step would be lost. ``S = T Q`` with orthonormal rows of Q gives p by a projection and dr by ``T^-T``.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from ..backend import stage
from ..core import Array, unit_roundoff
from .arrow_blocks import Blocks, Frame, factor_blocks
from .cone import Cone, cone_sum, inner
from .convex_program import Bounds, ConvexProgram, Optional, as_vector
from .linear import Cholesky, Vector, matvec, orthonormal_rows, rmatvec, solve_lower, solve_transposed

__all__ = ["KKT", "Direction", "factor"]


class Direction(NamedTuple):
    """p in frame coordinates, dxi (L,) or None, dr (m + q, L)."""

    p: Cone
    xi: Optional
    rows: Array


class Shaft(NamedTuple):
    """The level's share: ``L^-1 W e_0 delta``, and 1 over the root of the pivot of xi."""

    part: Cone
    root: Array


class KKT(NamedTuple):
    """A factored Newton system."""

    blocks: Blocks
    basis: Cone  # Q: d arrays (m + q, k, L), then the shaft's (m + q, 1, L)
    triangle: Cholesky  # T
    shaft: Shaft | None

    def solve(self, h: Cone, head: Array, level: Optional, rows: Array) -> Direction:
        """h in frame coordinates (k, L), head (k, L), level (L,), rows (m + q, L)."""
        pushed, _ = solve_lower(self.triangle, as_vector(rows))
        start = _without_equations(self.blocks, self.shaft, h, head, level)
        inside = _taken(self.basis, start, pushed)
        multipliers = solve_transposed(self.triangle, inside)
        p = _remaining(self.basis, start, inside)
        return _expanded(self.blocks, self.shaft, p, multipliers)


# Stages, so that nothing below is computed once for each of its readers.


@stage
def _pushed_down(blocks: Blocks, h: Cone, head: Array) -> Cone:
    return tuple(a - b for a, b in zip(blocks.solve_lower(h), blocks.solve_head(head), strict=True))


@stage
def _along_shaft(shaft: Shaft, start: Cone, level: Array) -> Array:
    return ((level + cone_sum(inner(shaft.part, start))) * shaft.root)[None]


def _without_equations(blocks: Blocks, shaft: Shaft | None, h: Cone, head: Array, level: Optional) -> Cone:
    """The solution without equations, in the coordinates of L and of the shaft."""
    start = _pushed_down(blocks, h, head)
    return start if shaft is None else (*start, _along_shaft(shaft, start, level))


_product = stage(matvec)


@stage
def _difference(taken: Array, pushed: Vector) -> Vector:
    return tuple(taken[i] - x for i, x in enumerate(pushed))


def _taken(basis: Cone, start: Cone, pushed: Vector) -> Vector:
    """What the rows of Q take from ``start``."""
    return _difference(_product(basis[: len(start)], start), pushed)


@stage
def _remaining(basis: Cone, start: Cone, inside: Vector) -> Cone:
    return tuple(a - b for a, b in zip(start, rmatvec(basis[: len(start)], inside), strict=True))


@stage
def _expanded(blocks: Blocks, shaft: Shaft | None, p: Cone, multipliers: Vector) -> Direction:
    xi = None
    if shaft is not None:
        xi = p[-1][0] * shaft.root
        p = tuple(a + b * xi for a, b in zip(p[:-1], shaft.part, strict=True))
    return Direction(blocks.solve_upper(p), xi, jnp.stack(multipliers))


@stage
def _scaled_columns(blocks: Blocks, columns: Cone) -> Cone:
    frame = blocks.frame
    return blocks.solve_lower(frame.scale(frame.to_frame(columns)))


@stage
def _shaft(blocks: Blocks, level: Array) -> Shaft:
    assert blocks.head is not None
    return Shaft(blocks.solve_head(level), lax.rsqrt(cone_sum(level / (1 + level * blocks.head))))


@stage
def _shaft_column(columns: Cone, shaft: Shaft) -> Array:
    return (matvec(columns, shaft.part) * shaft.root)[:, None]


@stage
def _diagonal(rates: Array, rhs: Array) -> Array:
    """(m + q, q, L): 0 over the roots of 1 / rate."""
    root = lax.rsqrt(rates)
    rows = [jnp.zeros((rhs.shape[0], *rates.shape), rates.dtype)]
    for j in range(rates.shape[0]):
        rows.append(jnp.stack([root[i] if i == j else 0 * root[i] for i in range(rates.shape[0])])[None])
    return jnp.concatenate(rows)


@stage
def _rounding(columns: Cone) -> Array:
    """Rows of S no longer than this are rounding as a whole."""
    largest = None
    for c in columns:
        size = jnp.max(jnp.max(jnp.abs(c), axis=0), axis=0)
        largest = size if largest is None else jnp.maximum(largest, size)
    assert largest is not None
    return jnp.asarray(4 * unit_roundoff(largest.dtype), largest.dtype) * largest


@stage
def _blocks(frame: Frame, program: ConvexProgram, rates: Bounds) -> Blocks:
    head = rates.cap
    if rates.head is not None:
        head = rates.head if head is None else head + rates.head
    return factor_blocks(frame, head, program.curvature, rates.level)


@stage
def _shares(columns: Cone, share: float) -> Vector:
    """``share`` of the length of each row."""
    return tuple(
        share * jnp.sqrt(cone_sum(jnp.concatenate([c[i] * c[i] for c in columns])))
        for i in range(columns[0].shape[0])
    )


def factor(program: ConvexProgram, frame: Frame, rates: Bounds, dependent: float | None = None) -> KKT:
    """Factor the Newton system for the scaling ``frame`` and the ``rates`` price / slack of the inequalities.

    A row of S counts as dependent where what is left of it is rounding, or this share of it.
    """
    blocks = _blocks(frame, program, rates)
    columns = _scaled_columns(blocks, program.columns)
    shaft, wide = None, columns
    if rates.level is not None:
        shaft = _shaft(blocks, rates.level)
        wide = (*wide, _shaft_column(columns, shaft))
    if rates.upper is not None and rates.lower is not None:
        wide = (*wide, _diagonal(rates.upper + rates.lower, program.rhs))
    floor = _rounding(wide) if dependent is None else _shares(wide, dependent)
    basis, triangle = orthonormal_rows(wide, floor)
    return KKT(blocks, basis, triangle, shaft)
