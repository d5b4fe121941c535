"""The Newton system of a ``ConvexConeProgram`` in scaled coordinates, factored once for any number of right-hand sides.

With p = W^-1 du in frame coordinates, the rows R = (B; E), the rates delta = price / slack of the level:

    K p = h - W e_0 head + W e_0 delta dxi - W R^T dr
    R W p - (0; dr_E / rate) = rows
    sum_i delta_i (dxi - du_0,i) = level

Eliminating p leaves a positive definite system ``S S^T dr = ..`` with the columns ``C = R W L^-T``, K = L L^T, in S.
The level xi borders the blocks and adds one column to C; the two-sided rows add a diagonal. That is O(k) blocks and one
small factorisation. S S^T is never formed: near a degenerate optimum its condition number is that of S squared,
1 / gap^2, and half of the digits of the step would be lost. ``S = T Q`` with orthonormal rows of Q gives p by a
projection and dr by ``T^-T``. Source: Golub, Van Loan, Matrix Computations, section 6.2 (equality-constrained least
squares by the QR factorisation).
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from ..backend import stage
from ..core import Array, unit_roundoff
from .cholesky import Cholesky, solve_lower, solve_transposed
from .cone import Cone, cone_sum, inner
from .cone_blocks import ConeBlocks, factor_blocks
from .convex_cone_program import Bounds, ConvexConeProgram, OptionalArray
from .gram_schmidt import orthonormal_rows
from .jordan_frame import JordanFrame
from .products import matvec, rmatvec

__all__ = ["ScaledDirection", "ScaledKKT", "ScaledSides", "factor_scaled_kkt"]


class ScaledSides(NamedTuple):
    """A right-hand side: h in frame coordinates and head (k, L), level (L,) or None, rows (m + q, L)."""

    h: Cone
    head: Array
    level: OptionalArray
    rows: Array


class ScaledDirection(NamedTuple):
    """A solution: p in frame coordinates, dxi (L,) or None, dr (m + q, L)."""

    p: Cone
    xi: OptionalArray
    rows: Array


class Border(NamedTuple):
    """The level's row and column: ``L^-1 W e_0 delta``, and 1 over the root of the pivot of xi."""

    column: Cone
    inverse_root: Array


class ScaledKKT(NamedTuple):
    """A factored Newton system."""

    blocks: ConeBlocks
    basis: Cone  # Q: d arrays (m + q, k, L), then the border's (m + q, 1, L)
    triangle: Cholesky  # T
    border: Border | None

    def solve(self, rhs: ScaledSides) -> ScaledDirection:
        """By projection: the unconstrained solution, moved along the rows of Q until ``R W p = rows``."""
        target = solve_lower(self.triangle, rhs.rows)
        free = _unconstrained(self.blocks, self.border, rhs)
        components = _components(self.basis, free, target)
        multipliers = solve_transposed(self.triangle, components)
        p = _projected(self.basis, free, components)
        return _back_substituted(self.blocks, self.border, p, multipliers)


# Stages, so that nothing below is computed once for each of its readers.


@stage
def _forward_substituted(blocks: ConeBlocks, h: Cone, head: Array) -> Cone:
    return tuple(a - b for a, b in zip(blocks.solve_lower(h), blocks.solve_head(head), strict=True))


@stage
def _border_component(border: Border, free: Cone, level: Array) -> Array:
    return ((level + cone_sum(inner(border.column, free))) * border.inverse_root)[None]


def _unconstrained(blocks: ConeBlocks, border: Border | None, rhs: ScaledSides) -> Cone:
    """The solution without the rows, in the coordinates of L and of the border."""
    free = _forward_substituted(blocks, rhs.h, rhs.head)
    return free if border is None else (*free, _border_component(border, free, rhs.level))


_product = stage(matvec)


@stage
def _difference(product: Array, target: Array) -> Array:
    return product - target


def _components(basis: Cone, free: Cone, target: Array) -> Array:
    """``Q free - target``."""
    return _difference(_product(basis[: len(free)], free), target)


@stage
def _projected(basis: Cone, free: Cone, components: Array) -> Cone:
    """``free - Q^T components``."""
    return tuple(a - b for a, b in zip(free, rmatvec(basis[: len(free)], components), strict=True))


@stage
def _back_substituted(
    blocks: ConeBlocks, border: Border | None, p: Cone, multipliers: Array
) -> ScaledDirection:
    xi = None
    if border is not None:
        xi = p[-1][0] * border.inverse_root
        p = tuple(a + b * xi for a, b in zip(p[:-1], border.column, strict=True))
    return ScaledDirection(blocks.solve_upper(p), xi, multipliers)


@stage
def _scaled_columns(blocks: ConeBlocks, columns: Cone) -> Cone:
    frame = blocks.frame
    return blocks.solve_lower(frame.scale(frame.to_frame(columns)))


@stage
def _border(blocks: ConeBlocks, level: Array) -> Border:
    assert blocks.head_response is not None
    return Border(blocks.solve_head(level), lax.rsqrt(cone_sum(level / (1 + level * blocks.head_response))))


@stage
def _border_rows(columns: Cone, border: Border) -> Array:
    return (matvec(columns, border.column) * border.inverse_root)[:, None]


@stage
def _diagonal(rates: Array, rhs: Array) -> Array:
    """(m + q, q, L): 0 over the roots of 1 / rate."""
    root = lax.rsqrt(rates)
    rows = [jnp.zeros((rhs.shape[0], *rates.shape), rates.dtype)]
    for j in range(rates.shape[0]):
        rows.append(jnp.stack([root[i] if i == j else 0 * root[i] for i in range(rates.shape[0])])[None])
    return jnp.concatenate(rows)


def _largest(x: Array) -> Array:
    """The largest entry of each lane (L,), by halves: XLA turns a long ``jnp.max`` into windows, which a kernel cannot
    hold."""
    rows = x.reshape(-1, x.shape[-1])
    while rows.shape[0] > 1:
        half = (rows.shape[0] + 1) // 2
        rows = jnp.maximum(rows[:half], rows[-half:])
    return rows[0]


@stage
def _rounding_floors(columns: Cone) -> Array:
    """Rows of S no longer than this are rounding as a whole."""
    largest = reduce(jnp.maximum, [_largest(jnp.abs(c)) for c in columns])
    return jnp.asarray(4 * unit_roundoff(largest.dtype), largest.dtype) * largest


@stage
def _blocks(frame: JordanFrame, program: ConvexConeProgram, rates: Bounds) -> ConeBlocks:
    head = rates.cap
    if rates.head is not None:
        head = rates.head if head is None else head + rates.head
    return factor_blocks(frame, head, program.curvature, rates.level)


@stage
def _relative_floors(columns: Cone, share: float) -> list[Array]:
    """``share`` of the length of each row."""
    return [
        share * jnp.sqrt(cone_sum(jnp.concatenate([c[i] * c[i] for c in columns])))
        for i in range(columns[0].shape[0])
    ]


def factor_scaled_kkt(
    program: ConvexConeProgram, frame: JordanFrame, rates: Bounds, dependent: float | None = None
) -> ScaledKKT:
    """Factor the Newton system for the scaling ``frame`` and the ``rates`` price / slack of the inequalities.

    A row of S counts as dependent where its remainder is rounding, or not more than the share ``dependent`` of it.
    """
    blocks = _blocks(frame, program, rates)
    columns = _scaled_columns(blocks, program.columns)
    border, wide = None, columns
    if rates.level is not None:
        border = _border(blocks, rates.level)
        wide = (*wide, _border_rows(columns, border))
    if rates.upper is not None and rates.lower is not None:
        wide = (*wide, _diagonal(rates.upper + rates.lower, program.rhs))
    floor = _rounding_floors(wide) if dependent is None else _relative_floors(wide, dependent)
    basis, triangle = orthonormal_rows(wide, floor)
    return ScaledKKT(blocks, basis, triangle, border)
