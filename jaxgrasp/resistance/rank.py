"""The rank of A where the projection cannot prove it full: by singular values, and by what rounding could make of them.

    rank = #{j : sigma_j > 64 eps sigma_1}         NOT_RESISTANT by rank: A'^T xi = 0 for some numbers within rounding

Both of A itself and of the map with mu > 0 replaced by 1 and gamma > 0 by L: its null twists are those of A, and little
friction does not hide them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from ..backend import kernel, to_rows
from ..conic import RowSVD, cone_max, cone_min, cone_sum, inner, rmatvec, row_svd
from ..contacts import Component, Contacts, fold
from ..core import Array, perturbation_tolerance, rank_tolerance, vanishing_friction

__all__ = ["Rank", "rank_kernel", "unnoticed"]


class Rank(NamedTuple):
    """Rank of A by its singular values: how many count (L,), the smallest of those (L,).

    null_twist  (m, L) the unit twist that the contacts notice least
    noticed     (L,) how much the one that notices it most does, in numbers of the grasp (``unnoticed``)
    """

    count: Array
    smallest: Array
    null_twist: Array
    noticed: Array


def unnoticed(rank: Rank) -> Array:
    """Whether some numbers within rounding of the grasp's do not notice the null twist at all."""
    return rank.noticed <= perturbation_tolerance(rank.noticed.dtype)


def _certain_contacts(contacts: Contacts, length: Array) -> Contacts:
    """Coefficients 1 and L in place of mu and gamma, and 0 where rounding could make them 0.

    A twist that these contacts do not notice, rounded numbers of the grasp do not notice either: mu x_t = 0 for mu > 0
    means x_t = 0. However little friction there is, their singular values are those of the geometry.
    """
    limit, L = vanishing_friction(length.dtype), length[:, None]
    one, zero = jnp.ones_like(contacts.friction), jnp.zeros_like(contacts.friction)
    return contacts._replace(
        friction=jnp.where(contacts.friction > limit, one, zero),
        torsion=jnp.where(contacts.torsion > limit * L, L, zero),
    )


def rank_kernel(components: tuple[Component, ...]) -> Callable[[Contacts], Rank]:
    """``Rank`` of a tile of rows."""

    @kernel
    def run(contacts: Contacts) -> Rank:
        folded = fold(contacts, components)
        certain = fold(_certain_contacts(contacts, folded.length), components, folded.length)
        # One after the other: a kernel twice as wide would be split over threads, which a kernel cannot be.
        both = jnp.stack([jnp.concatenate(x.columns, axis=1) for x in (folded, certain)])
        svd = lax.map(row_svd, both)
        values = svd.values[0]
        counts = values > rank_tolerance(values.dtype) * cone_max(values)
        smallest = cone_min(jnp.where(counts, values, jnp.full_like(values, jnp.inf)))
        _, null = RowSVD(svd.values[1], svd.vectors[1]).smallest()
        x = rmatvec(certain.columns, null)
        noticed = cone_max(certain.exists * jnp.sqrt(inner(x, x)))
        return Rank(cone_sum(counts.astype(values.dtype)), smallest, to_rows(null), noticed)

    return run
