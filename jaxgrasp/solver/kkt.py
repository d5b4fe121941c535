"""The Newton system of a ``ConvexProgram``: O(k) blocks, one small factorisation, any number of right-hand sides.

With p = W^-1 du in frame coordinates, the rows R = (B; E), the rates delta = price / slack of the level:

    K p = h - W e_0 head + W e_0 delta dxi - W R^T dr
    R W p - (0; dr_E / rate) = rows
    sum_i delta_i (dxi - du_0,i) = level

Eliminating p leaves a positive definite system in dr with the columns ``C = R W L^-T``, K = L L^T. The level xi borders
the blocks as the shaft of an arrow and adds one column to C; the two-sided rows add a diagonal.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from .._types import Array, pivot_tolerance
from ..cones import Cone, cone_sum, inner
from .blocks import Blocks, Frame, factor_blocks
from .convex import Bounds, ConvexProgram, Optional, as_vector
from .linear import Cholesky, cholesky, gram, matvec, rmatvec
from .linear import solve as solve_factored
from .stages import stage

__all__ = ["KKT", "Direction", "factor"]


class Direction(NamedTuple):
    """p in frame coordinates, dxi (L,) or None, dr (m + q, L)."""

    p: Cone
    xi: Optional
    rows: Array


class Shaft(NamedTuple):
    """The level's share: ``L^-1 W e_0 delta``, C times that, and the pivot of xi."""

    part: Cone
    column: Array
    pivot: Array


class KKT(NamedTuple):
    """A factored Newton system."""

    blocks: Blocks
    columns: Cone  # C, d arrays (m + q, k, L)
    cholesky: Cholesky
    shaft: Shaft | None

    def solve(self, h: Cone, head: Array, level: Optional, rows: Array) -> Direction:
        """h in frame coordinates (k, L), head (k, L), level (L,), rows (m + q, L)."""
        start, target, along = _reduced(self.blocks, self.columns, self.shaft, h, head, level, rows)
        multipliers = solve_factored(self.cholesky, as_vector(target))
        return _expanded(self.blocks, self.columns, self.shaft, start, along, multipliers)


@stage
def _reduced(
    blocks: Blocks, columns: Cone, shaft: Shaft | None, h: Cone, head: Array, level: Optional, rows: Array
) -> tuple[Cone, Array, Optional]:
    start = tuple(a - b for a, b in zip(blocks.solve_lower(h), blocks.solve_head(head), strict=True))
    target = matvec(columns, start) - rows
    if shaft is None:
        return start, target, None
    along = level + cone_sum(inner(shaft.part, start))
    return start, target + shaft.column * (along / shaft.pivot), along


@stage
def _expanded(
    blocks: Blocks, columns: Cone, shaft: Shaft | None, start: Cone, along: Optional, multipliers
) -> Direction:
    p = tuple(a - b for a, b in zip(start, rmatvec(columns, multipliers), strict=True))
    xi = None
    if shaft is not None:
        for i, value in enumerate(multipliers):
            along = along - shaft.column[i] * value
        xi = along / shaft.pivot
        p = tuple(a + b * xi for a, b in zip(p, shaft.part, strict=True))
    return Direction(blocks.solve_upper(p), xi, jnp.stack(multipliers))


@stage
def _scaled_columns(blocks: Blocks, columns: Cone) -> Cone:
    frame = blocks.frame
    return blocks.solve_lower(frame.scale(frame.to_frame(columns)))


@stage
def _shaft_part(blocks: Blocks, level: Array) -> tuple[Cone, Array]:
    assert blocks.head is not None
    return blocks.solve_head(level), cone_sum(level / (1 + level * blocks.head))


@stage
def _shaft_column(columns: Cone, part: Cone, pivot: Array) -> tuple[Array, Array]:
    column = matvec(columns, part)
    return column, (column / jnp.sqrt(pivot))[:, None]


@stage
def _with_diagonal(matrix: list[Array], rates: Array) -> list[Array]:
    first = len(matrix) - rates.shape[0]
    return [
        column if j < first else jnp.concatenate([(column[0] + 1 / rates[j - first])[None], column[1:]])
        for j, column in enumerate(matrix)
    ]


@stage
def _blocks(frame: Frame, program: ConvexProgram, rates: Bounds) -> Blocks:
    head = rates.cap
    if rates.head is not None:
        head = rates.head if head is None else head + rates.head
    return factor_blocks(frame, head, program.curvature, rates.level)


def factor(program: ConvexProgram, frame: Frame, rates: Bounds) -> KKT:
    """Factor the Newton system for the scaling ``frame`` and the ``rates`` price / slack of the inequalities."""
    blocks = _blocks(frame, program, rates)
    columns = _scaled_columns(blocks, program.columns)
    shaft, wide = None, columns
    if rates.level is not None:
        part, pivot = _shaft_part(blocks, rates.level)
        column, extra = _shaft_column(columns, part, pivot)
        shaft, wide = Shaft(part, column, pivot), (*columns, extra)
    matrix = gram(wide)
    if rates.upper is not None and rates.lower is not None:
        matrix = _with_diagonal(list(matrix), rates.upper + rates.lower)
    return KKT(blocks, columns, cholesky(tuple(matrix), pivot_tolerance(program.exists.dtype)), shaft)
