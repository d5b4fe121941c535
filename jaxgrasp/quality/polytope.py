"""A polytope that grows inside a convex body until the largest ball about the origin is bracketed on both sides.

    |a| over the facets {p : a . p = 1} of the polytope:   1 / max |a|  <=  radius  <=  min over directions d of h(d)

h is the body's support function, h(d) = max over the body of d . p for unit d. The nearest facet asks for the body's
outermost point along its normal: that point either proves the facet near enough or becomes a vertex, whereby the
facets it sees give way to a cone of new ones (beneath-beyond, which is the double description of the polar body).
A new facet's a lies between those of the two facets that shared its ridge, so no system is ever solved. Sources:
Zheng, An efficient algorithm for a grasp quality measure, 2013 (growth at the nearest facet); Motzkin et al. 1953.

Facets are simplices in arrays of fixed capacity, for one body; a batch is mapped over bodies. A facet out of use has
a = 0: it lies infinitely far away, sees nothing, and needs no mask.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..backend import while_loop
from ..core import Array, visibility_tolerance

__all__ = ["Capacity", "Growth", "Polytope", "begin", "grow", "widen"]


class Capacity(NamedTuple):
    """Room for facets and vertices in all, and for the facets seen and the ridges around them at one insertion."""

    facets: int
    vertices: int
    seen: int
    ridges: int


class Growth(NamedTuple):
    """How a polytope stopped."""

    RUNNING = 0
    CLOSED = (
        1  # the bracket is as narrow as asked for, or no point of the body lies outside the nearest facet
    )
    FULL = 2  # out of room


class Polytope(NamedTuple):
    """Vertices, simplicial facets, the bracket, for one body.

    labels     pytree of (V, ..): what the support function said about each vertex
    points     (V, m) vertices; those not in use are 0
    corners    (F, m) int32 vertex numbers of each facet
    across     (F, m) int32 the facet on the other side of the ridge opposite each corner
    polar      (F, m) a, with a . p = 1 on the facet; 0 where not in use
    upper      the smallest h(d) seen, with its unit ``direction`` (m,)
    state      a member of Growth
    """

    labels: Array
    points: Array
    corners: Array
    across: Array
    polar: Array
    vertices: Array
    facets: Array
    upper: Array
    direction: Array
    state: Array

    @property
    def lower(self) -> Array:
        """1 / max |a|: the ball the polytope contains."""
        return 1 / jnp.sqrt(jnp.max(jnp.sum(self.polar**2, axis=-1)))


Support = Callable[[Array], tuple[Array, Array, Array]]


def _cross_polytope(m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signs (2^m, m) of the orthants, corners 2 j + [negative], and the orthant across each ridge."""
    number = np.arange(2**m)
    negative = (number[:, None] >> np.arange(m)) & 1
    corners = 2 * np.arange(m) + negative
    across = number[:, None] ^ (1 << np.arange(m))
    return 1 - 2 * negative, corners.astype(np.int32), across.astype(np.int32)


def begin(axes: Array, labels: Array) -> Polytope:
    """The cross-polytope with vertices ``+-axes[j]``, (m, m) orthogonal, labelled (2 m, ..): +, -, ..."""
    m, dtype = axes.shape[0], axes.dtype
    signs, corners, across = _cross_polytope(m)
    square = jnp.sum(axes * axes, axis=-1, keepdims=True)
    polar = jnp.einsum("fj,jm->fm", jnp.asarray(signs, dtype), axes / square)
    points = jnp.stack([axes, -axes], axis=1).reshape(2 * m, m)
    return Polytope(
        labels,
        points,
        jnp.asarray(corners),
        jnp.asarray(across),
        polar,
        jnp.int32(2 * m),
        jnp.int32(2**m),
        jnp.asarray(jnp.inf, dtype),
        jnp.zeros(m, dtype),
        jnp.int32(Growth.RUNNING),
    )


def widen(polytope: Polytope, capacity: Capacity) -> Polytope:
    """The same polytope with more room; it goes on growing if it was out of room."""

    def padded(array, length):
        return jnp.pad(array, [(0, length - array.shape[0])] + [(0, 0)] * (array.ndim - 1))

    V, F = capacity.vertices, capacity.facets
    again = jnp.where(polytope.state == Growth.FULL, jnp.int32(Growth.RUNNING), polytope.state)
    return polytope._replace(
        labels=padded(polytope.labels, V), points=padded(polytope.points, V),
        corners=padded(polytope.corners, F), across=padded(polytope.across, F),
        polar=padded(polytope.polar, F), state=again,
    )  # fmt: skip


def _partners(corners: Array, skipped: Array, exists: Array, most_vertices: int) -> Array:
    """For facets (R, m) that all share the new vertex, at position ``skipped``: who shares which subridge.

    Entry (i, l) is the number of the facet with the same corners as i but for the new vertex and corner l. Equal
    subridges meet in a sort by a random sum of their corners. One 64-bit word holds that sum and the entry's number:
    XLA sorts single words ten times faster than pairs. 51 bits or more of sum make a false match a matter of 1e-8.
    """
    R, m = corners.shape
    place = jnp.arange(m, dtype=jnp.int32)
    used = exists[:, None] & (place != skipped[:, None])
    entry = jnp.arange(R * m, dtype=jnp.int32)

    def sums(word: np.ndarray, dtype) -> Array:
        value = jnp.where(place == skipped[:, None], jnp.zeros((), dtype), jnp.asarray(word, dtype)[corners])
        return (jnp.sum(value, axis=1, keepdims=True, dtype=dtype) - value).reshape(-1)

    random = np.random.default_rng(0)
    if jnp.dtype(jnp.result_type(float)).itemsize == 8:  # 64-bit JAX
        bits = (R * m - 1).bit_length()
        word = random.integers(0, 2**64, most_vertices, dtype=np.uint64)
        key = (sums(word, jnp.uint64) << jnp.uint64(bits)) | entry.astype(jnp.uint64)
        last = jnp.uint64(2**64 - 2**bits) | entry.astype(jnp.uint64)
        key = jnp.sort(jnp.where(used.reshape(-1), key, last))
        order = (key & jnp.uint64(2**bits - 1)).astype(jnp.int32)
    else:
        words = random.integers(0, 2**32, (2, most_vertices), dtype=np.uint32)
        keys = [jnp.where(used.reshape(-1), sums(w, jnp.uint32), jnp.uint32(2**32 - 1)) for w in words]
        order = lax.sort((*keys, entry), num_keys=2)[-1]
    first, second = order[0::2], order[1::2]
    partner = jnp.zeros(R * m, jnp.int32).at[first].set(second).at[second].set(first)
    return (partner // m).reshape(R, m)


def _insert(polytope: Polytope, point: Array, label: Array, capacity: Capacity) -> Polytope:
    """The polytope with one more vertex, which the nearest facet sees."""
    corners, across, polar = polytope.corners, polytope.across, polytope.polar
    m, dtype = point.shape[0], point.dtype
    height = polar @ point
    sees = height > 1 + visibility_tolerance(dtype)
    seen_count = jnp.sum(sees, dtype=jnp.int32)
    (seen,) = jnp.nonzero(sees, size=capacity.seen, fill_value=capacity.facets)
    seen = seen.astype(jnp.int32)
    is_seen = jnp.arange(capacity.seen, dtype=jnp.int32) < seen_count
    rim = is_seen[:, None] & ~sees[across.at[seen].get(mode="clip")]
    ridge_count = jnp.sum(rim, dtype=jnp.int32)
    (ridge,) = jnp.nonzero(rim.reshape(-1), size=capacity.ridges, fill_value=0)
    ridge = ridge.astype(jnp.int32)
    number = jnp.arange(capacity.ridges, dtype=jnp.int32)
    exists = number < ridge_count

    gone, place = seen[ridge // m], ridge % m  # the facet that goes, the corner the new vertex replaces
    kept = across[gone, place]
    before, beyond = height[gone], height[kept]
    weight = (before - 1) / (before - beyond)
    new_polar = polar[gone] + weight[:, None] * (polar[kept] - polar[gone])
    at_place = jnp.arange(m, dtype=jnp.int32) == place[:, None]
    new_corners = jnp.where(at_place, polytope.vertices, corners[gone])

    # Slots of the facets that go, then fresh ones.
    old = seen[jnp.minimum(number, capacity.seen - 1)]
    fresh = polytope.facets + number - seen_count
    slot = jnp.where(number < seen_count, old, fresh)
    target = jnp.where(exists, slot, capacity.facets)
    partner = _partners(new_corners, place, exists, capacity.vertices)
    new_across = jnp.where(at_place, kept[:, None], slot[partner])

    back = jnp.argmax(across[kept] == gone[:, None], axis=1)
    room = (
        (seen_count <= capacity.seen)
        & (ridge_count <= capacity.ridges)
        & (polytope.facets + jnp.maximum(ridge_count - seen_count, 0) <= capacity.facets)
        & (polytope.vertices < capacity.vertices)
    )
    cleared = polar.at[seen].set(0, mode="drop")
    grown = polytope._replace(
        labels=polytope.labels.at[polytope.vertices].set(label, mode="drop"),
        points=polytope.points.at[polytope.vertices].set(point, mode="drop"),
        corners=corners.at[target].set(new_corners, mode="drop"),
        across=across.at[jnp.where(exists, kept, capacity.facets), back]
        .set(slot, mode="drop")
        .at[target]
        .set(new_across, mode="drop"),
        polar=cleared.at[target].set(new_polar, mode="drop"),
        vertices=polytope.vertices + 1,
        facets=polytope.facets + jnp.maximum(ridge_count - seen_count, 0),
    )
    full = polytope._replace(state=jnp.int32(Growth.FULL))
    return jax.tree.map(lambda new, same: jnp.where(room, new, same), grown, full)


def grow(polytope: Polytope, support: Support, tolerance: Array, capacity: Capacity) -> Polytope:
    """Grow until ``lower >= (1 - tolerance) upper``, nothing is left outside, or the room is used up.

    support  maps a unit direction (m,) to ``(h, point, label)``: the body's outermost point and h = point . direction
    """

    def running(polytope: Polytope) -> Array:
        return polytope.state == Growth.RUNNING

    def step(polytope: Polytope) -> Polytope:
        square = jnp.sum(polytope.polar**2, axis=-1)
        nearest = jnp.argmax(square)
        lower = 1 / jnp.sqrt(square[nearest])
        direction = polytope.polar[nearest] * lower
        value, point, label = support(direction)
        better = value < polytope.upper
        upper = jnp.where(better, value, polytope.upper)
        polytope = polytope._replace(upper=upper, direction=jnp.where(better, direction, polytope.direction))
        flush = value <= lower * (1 + 2 * visibility_tolerance(value.dtype))
        done = ~(lower < (1 - tolerance) * upper) | flush
        closed = polytope._replace(state=jnp.int32(Growth.CLOSED))
        grown = _insert(polytope, point, label, capacity)
        return jax.tree.map(lambda a, b: jnp.where(done, a, b), closed, grown)

    return while_loop(running, step, polytope)
