"""``A = L Q`` with orthonormal rows of Q, by modified Gram-Schmidt with reorthogonalisation, lanes on the last axis.

Source: Bjoerck 1967 (modified Gram-Schmidt); Parlett, The Symmetric Eigenvalue Problem, 1980, section 6.9 (Kahan and
Parlett: twice is enough).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ..backend import stage
from ..core import Array
from .cholesky import Cholesky
from .cone import Cone, cone_sum, entries
from .products import matvec

__all__ = ["orthonormal_rows"]


@stage
def _stacked(columns: Cone) -> Array:
    """(m, K, L): the columns of all components side by side."""
    return jnp.concatenate(columns, axis=1)


@stage
def _overlaps(rows: list[Array], rest: Array) -> Array:
    """``<q, r>`` (i, L) of the rows q found so far with the next remainder r."""
    return jnp.stack([cone_sum(row * rest[0]) for row in rows])


@stage
def _reorthogonalized(rows: list[Array], rest: Array, overlaps: Array) -> Array:
    """``r - sum_q <q, r> q``."""
    remainder = rest[0]
    for overlap, row in zip(entries(overlaps), rows, strict=True):
        remainder = remainder - overlap * row
    return remainder


@stage
def _row_norm(remainder: Array, floor: Array) -> tuple[Array, Array]:
    """The norm, and its reciprocal, which is 0 where the norm is not above ``floor``."""
    norm = jnp.sqrt(cone_sum(remainder * remainder))
    independent = norm > floor
    reciprocal = 1 / jnp.where(independent, norm, jnp.ones_like(norm))
    return norm, jnp.where(independent, reciprocal, jnp.zeros_like(norm))


@stage
def _row(remainder: Array, reciprocal: Array) -> Array:
    return remainder * reciprocal


@stage
def _products_below(rest: Array, row: Array) -> Array:
    """``<r, row>`` of the remainders below (m - 1 - i, L)."""
    return matvec((rest[1:],), (row,))


@stage
def _projected_out(rest: Array, row: Array, products: Array) -> Array:
    """The remainders below without their component along ``row``."""
    return rest[1:] - products[:, None] * row[None]


@stage
def _column(norm: Array, reciprocal: Array, products: Array | None) -> Array:
    """A column of L, from its diagonal entry down: 0 where the row depends on those above it."""
    pivot = jnp.where(reciprocal > 0, norm, jnp.zeros_like(norm))[None]
    return pivot if products is None else jnp.concatenate([pivot, products])


@stage
def _grown(floor: Array, lower: list[Array], floors: list[Array], inverse: list[Array]) -> Array:
    """``floor + sum_j |L_ij| floor_j / L_jj``: an error in row j turns q_j by its share of the pivot."""
    i = len(lower)
    for j, column in enumerate(lower):
        floor = floor + jnp.abs(column[i - j]) * floors[j] * inverse[j]
    return floor


def orthonormal_rows(columns: Cone, floor: Array | list[Array]) -> tuple[Cone, Cholesky]:
    """``A = L Q`` with orthonormal rows of Q, by modified Gram-Schmidt, for A given as d arrays (m, k, L).

    A row whose remainder is not longer than its floor depends on those above it and becomes zero. ``floor``: one a row,
    or the error of a row of A, which grows with the inverse pivots above. Each remainder is cleared of the rows above
    once more: twice is enough (Kahan, Parlett) for orthogonality to rounding. The components stand side by side in one
    array: compiling costs a fusion an array.
    """
    m = columns[0].shape[0]
    rest = _stacked(columns)
    rows: list[Array] = []
    lower: list[Array] = []
    inverse: list[Array] = []
    floors: list[Array] = []
    for i in range(m):
        remainder = _reorthogonalized(rows, rest, _overlaps(rows, rest)) if rows else rest[0]
        floors.append(floor[i] if isinstance(floor, list) else _grown(floor, lower, floors, inverse))
        norm, reciprocal = _row_norm(remainder, floors[i])
        row, products = _row(remainder, reciprocal), None
        if i < m - 1:
            products = _products_below(rest, row)
            rest = _projected_out(rest, row, products)
        lower.append(_column(norm, reciprocal, products))
        rows.append(row)
        inverse.append(reciprocal)
    return _apart(rows, [c.shape[1] for c in columns]), Cholesky(tuple(lower), tuple(inverse))


def _apart(rows: list[Array], heights: list[int]) -> Cone:
    """The rows as d arrays (m, k, L) again."""
    ends = np.cumsum(heights)

    @stage
    def run(rows: list[Array]) -> Cone:
        return tuple(
            jnp.stack([row[end - height : end] for row in rows])
            for end, height in zip(ends, heights, strict=True)
        )

    return run(rows)
