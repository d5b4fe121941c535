"""``A = L Q``: the folded map with orthonormal rows, and the projection onto its null space."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..backend import stage, to_lanes
from ..conic import (
    Cholesky,
    Cone,
    cone_min,
    cone_sum,
    interior_distance,
    inverse_frobenius,
    matvec,
    orthonormal_rows,
    rmatvec,
    solve_transposed,
    vector_norm,
)
from ..core import Array, rank_tolerance, rounding_constant, unit_roundoff
from .folded import Contacts, Folded, fold, resultant
from .models import Component

__all__ = [
    "Projection",
    "Tile",
    "minus_transposed",
    "normalized",
    "onto_null_space",
    "project",
    "smallest_slack",
    "stored_norm",
    "tile_of",
    "to_body",
    "to_twist",
]

stored_norm = stage(vector_norm)


class Projection(NamedTuple):
    """``A = L Q``: Q has orthonormal rows, hence the same null space and the same margin, and far better numbers.

    basis   the tile with Q in place of A
    factor  L
    sigma   (L,) proven lower bound of the smallest singular value of A, 0 where it is not above ``rank_tolerance``
            times |A|; sigma > 0 proves rank m
    """

    basis: Folded
    factor: Cholesky
    sigma: Array


def project(folded: Folded) -> Projection:
    """Orthonormalise the rows of A; ``sigma >= 1 / |L^-1| - c eps |A|`` allows for rounding in L."""
    dtype = folded.norm.dtype
    columns, factor = orthonormal_rows(folded.columns, rank_tolerance(dtype) * folded.norm)
    basis = folded._replace(columns=columns, resultant=resultant(columns[0]))
    rounding = rounding_constant() * unit_roundoff(dtype) * folded.norm
    sigma = 1 / jnp.sqrt(inverse_frobenius(factor)) - rounding
    clear = sigma > rank_tolerance(dtype) * folded.norm
    return Projection(basis, factor, jnp.where(clear, sigma, jnp.zeros_like(sigma)))


class Tile(NamedTuple):
    """A tile of grasps ready for a program: lanes on the last axis, but for the contacts, which are rows.

    components  of a contact's force, in the chapter's order      dimension  2 or 3
    """

    contacts: Contacts
    folded: Folded
    projection: Projection
    components: tuple[Component, ...]
    dimension: int

    @property
    def coefficients(self) -> tuple[Array, Array]:
        """``mu, gamma`` of the contacts (k, L), 0 where there is none."""
        there, zero = self.folded.exists > 0, jnp.zeros_like(self.folded.exists)
        friction, torsion = to_lanes(self.contacts.friction), to_lanes(self.contacts.torsion)
        return jnp.where(there, friction, zero), jnp.where(there, torsion, zero)


def tile_of(contacts: Contacts, components: tuple[Component, ...], dimension: int) -> Tile:
    """The rows ``contacts``, folded and orthonormalised."""
    folded = fold(contacts, components)
    return Tile(contacts, folded, project(folded), components, dimension)


def to_body(twist: Array, length: Array, dimension: int) -> Array:
    """(velocity; angular velocity) in m/s and rad/s of a twist of A, whose lengths are over ``length``."""
    return jnp.concatenate([twist[:dimension], twist[dimension:] / length])


def to_twist(projection: Projection, y: Array) -> Array:
    """The twist lambda of A for the multipliers y of Q: ``A^T lambda = Q^T y``, ``lambda = L^-T y``."""
    return solve_transposed(projection.factor, y)


@stage
def _applied(columns: Cone, s: Cone) -> Array:
    return matvec(columns, s)


@stage
def minus_transposed(columns: Cone, s: Cone, y: Array) -> Cone:
    """``s - A^T y`` for the columns of A, contact by contact."""
    return tuple(a - b for a, b in zip(s, rmatvec(columns, y), strict=True))


def onto_null_space(projection: Projection, s: Cone) -> Cone:
    """``s - Q^T Q s``, twice, so that A s is rounding."""
    columns = projection.basis.columns
    for _ in range(2):
        s = minus_transposed(columns, s, _applied(columns, s))
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
