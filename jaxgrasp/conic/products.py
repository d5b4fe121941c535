"""Products of many small matrices, given by their columns, lanes on the last axis.

A vector is one array (m, L): an array an entry would cost the compiler a loop an entry. A matrix B of m rows is d
arrays (m, k, L), one for each component of the cones its columns belong to.
"""

from __future__ import annotations

from functools import reduce

import jax.numpy as jnp

from ..backend import stage
from ..core import Array
from .cone import Cone, cone_sum, entries

__all__ = ["gram", "matvec", "rmatvec", "vector_inner", "vector_norm"]


def vector_norm(v: Array) -> Array:
    """``|v|`` (L,)."""
    return jnp.sqrt(vector_inner(v, v))


def vector_inner(v: Array, w: Array) -> Array:
    """``<v, w>`` (L,)."""
    return cone_sum(v * w)


def matvec(columns: Cone, x: Cone) -> Array:
    """``B x`` (m, L)."""
    terms = [
        c[:, i : i + 1] * entry
        for c, part in zip(columns, x, strict=True)
        for i, entry in enumerate(entries(part))
    ]
    return reduce(jnp.add, terms)[:, 0]


def rmatvec(columns: Cone, y: Array) -> Cone:
    """``B^T y``, d arrays (k, L)."""
    factors = entries(y[:, None])
    return tuple(
        reduce(jnp.add, [row * f for row, f in zip(entries(c), factors, strict=True)])[0] for c in columns
    )


def gram(columns: Cone) -> tuple[Array, ...]:
    """Lower columns (m - j, L) of ``B B^T`` for B given as d arrays (m, k, L)."""
    # One stage a column: the CPU backend would split a larger one over threads, which a kernel may not.
    return tuple(_gram_column(columns, j) for j in range(columns[0].shape[0]))


def _gram_column(columns: Cone, j: int) -> Array:
    @stage
    def products(columns: Cone) -> Array:
        return matvec(tuple(c[j:] for c in columns), tuple(c[j] for c in columns))

    return products(columns)
