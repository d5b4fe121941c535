"""The folded grasp map ``A = G diag(mu, mu, 1, gamma)`` of a tile of grasps, lanes on the last axis."""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..backend import stage, to_lanes
from ..conic import Cone, cone_max, cone_sum, entries, inner
from ..core import Array, cross_components, frame_components, normalize_components, require_precision
from .grasp import Grasp
from .models import Component
from .validity import sound

__all__ = ["Contacts", "Folded", "contacts_of", "fold", "normal_first", "resultant", "unfold"]


class Contacts(NamedTuple):
    """Grasps as rows: position, normal (N, k, dim); friction, torsion, active (N, k)."""

    position: Array
    normal: Array
    friction: Array
    torsion: Array
    active: Array


class Folded(NamedTuple):
    """The folded grasp map A of a tile, lengths divided by L.

    columns  d arrays (m, k, L): normal column first, then the scaled tangents and spin
    exists   (k, L) ones and zeros      count   (L,) active contacts
    length   (L,) L in m                valid   (L,) bool: the numbers are a grasp
    norm     (L,) Frobenius norm of A   resultant  (m, L): a, the wrench of unit normal forces
    """

    columns: Cone
    exists: Array
    count: Array
    length: Array
    valid: Array
    norm: Array
    resultant: Array


def _coordinates(points: Array) -> tuple[Array, ...]:
    """(k, dim, L) to dim arrays (k, L)."""
    return tuple(points[:, i] for i in range(points.shape[1]))


_largest = stage(cone_max)  # what it is the largest of is stored, not computed again for each contact


@stage
def _length(position: Array) -> Array:
    x = _coordinates(position)
    largest = jnp.sqrt(cone_max(inner(x, x)))
    return jnp.where(largest > 0, largest, jnp.ones_like(largest))


@stage
def _unit(normal: Array) -> tuple[Array, ...]:
    return normalize_components(_coordinates(normal))


@stage
def _column(point: Array, direction: tuple[Array, ...], factor: Array) -> Array:
    moment = cross_components(_coordinates(point), direction)
    return jnp.stack([factor * x for x in (*direction, *moment)])


@stage
def _spin_column(normal: tuple[Array, ...], factor: Array) -> Array:
    return jnp.stack([*(jnp.zeros_like(x) for x in normal), *(factor * x for x in normal)])


@stage
def resultant(normal_column: Array) -> Array:
    return cone_sum(normal_column.swapaxes(0, 1))


@stage
def _frobenius(columns: Cone) -> Array:
    rows = [entries((row * row).swapaxes(0, 1)) for c in columns for row in entries(c)]
    return jnp.sqrt(reduce(jnp.add, [reduce(jnp.add, squares) for squares in rows])[0, 0])


def fold(contacts: Contacts, components: tuple[Component, ...], length: Array | None = None) -> Folded:
    """A of a tile of L rows. Contacts that do not count get zero columns; invalid lanes are all zero.

    ``length`` (L,) is what lengths are divided by, by default the largest distance of a contact from the origin.
    """
    position, normal, friction, torsion, active = (to_lanes(x) for x in contacts)
    dtype, dimension = position.dtype, position.shape[1]
    valid = sound(_coordinates(position), _coordinates(normal), friction, torsion, active, _largest)
    live = active & valid
    exists = live.astype(dtype)
    point = jnp.where(live[:, None], position, jnp.zeros_like(position))
    length = _length(point) if length is None else length
    point = point / length
    last = np.eye(dimension, dtype=dtype)[-1:, :, None]
    direction = _unit(jnp.where(live[:, None], normal, last))
    frames = frame_components(direction)

    mu = jnp.where(live, friction, jnp.zeros_like(friction))
    gamma = jnp.where(live, torsion, jnp.zeros_like(torsion)) / length
    columns = []
    for component in normal_first(components):
        if component is Component.NORMAL:
            columns.append(_column(point, direction, exists))
        elif component is Component.SPIN:
            columns.append(_spin_column(direction, gamma))
        else:
            columns.append(_column(point, frames[0 if component is Component.TANGENT_1 else 1], mu))
    return Folded(
        tuple(columns),
        exists,
        jnp.maximum(cone_sum(exists), jnp.ones_like(length)),
        length,
        valid,
        _frobenius(tuple(columns)),
        resultant(columns[0]),
    )


def normal_first(components: tuple[Component, ...]) -> tuple[Component, ...]:
    """The order of scaled forces: the normal component, then the others in the chapter's order."""
    return (Component.NORMAL, *(c for c in components if c is not Component.NORMAL))


def contacts_of(grasp: Grasp) -> Contacts:
    """The arrays the lanes are made of; ValueError where they are neither float32 nor float64."""
    require_precision(grasp.dtype, "the grasp")
    return Contacts(
        grasp.position,
        grasp.normal,
        grasp.model.friction_coefficient,
        grasp.model.torsion_coefficient,
        grasp.active,
    )


def unfold(s: Cone, components: tuple[Component, ...], friction: Array, torsion: Array) -> Array:
    """``f = (mu s_1, mu s_2, s_0, gamma s_3)`` per contact in the chapter's order, flattened to (k n, L)."""
    scaled = dict(zip(normal_first(components), s, strict=True))
    coefficient = {Component.SPIN: torsion}
    parts = [
        scaled[c] if c is Component.NORMAL else coefficient.get(c, friction) * scaled[c] for c in components
    ]
    stacked = jnp.stack(parts, axis=1)
    return stacked.reshape(-1, stacked.shape[-1])
