"""What contacts must satisfy wherever the optimiser takes them: each requirement says by how much it is violated.

``excess(surface, position, normal) >= 0`` in m per grasp, 0 where satisfied: its square is added to what placement
minimises, and only grasps whose excess is within ``SLACK`` of the object's radius are returned.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from itertools import combinations

import equinox as eqx
import jax.numpy as jnp

from ..core import Array, Float, safe_root
from ..surfaces import SmoothSurface

__all__ = ["SLACK", "Apart", "Beyond", "EdgeClearance", "JawWidth", "Requirement", "Within", "total_excess"]

SLACK = 1e-3  # of the object's radius


class Requirement(eqx.Module):
    """Positions (.., k, 3) in m in the surface's frame, inward normals, and how far they are from what is asked."""

    @abc.abstractmethod
    def excess(
        self, surface: SmoothSurface, position: Float[Array, "*batch k 3"], normal: Float[Array, "*batch k 3"]
    ) -> Float[Array, "*batch"]:
        """``sqrt(sum of squared violations)`` in m; 0 where satisfied."""


def _short(x: Array) -> Array:
    """(sum of max(x, 0)^2)^(1/2) over the last axis."""
    return safe_root(jnp.sum(jnp.maximum(x, 0.0) ** 2, axis=-1))


def _pairs(position: Array) -> list[tuple[int, int]]:
    return list(combinations(range(position.shape[-2]), 2))


def _distances(position: Array) -> Array:
    apart = [position[..., a, :] - position[..., b, :] for a, b in _pairs(position)]
    return jnp.stack([safe_root(jnp.sum(d * d, axis=-1)) for d in apart], axis=-1)


@eqx.filter_jit
def total_excess(
    requirements: Sequence[Requirement],
    surface: SmoothSurface,
    position: Float[Array, "*batch k 3"],
    normal: Float[Array, "*batch k 3"],
) -> Float[Array, "*batch"]:
    """Root of the sum of squares of all excesses, m; its derivative is 0 where it is."""
    total = jnp.zeros(position.shape[:-2], position.dtype)
    for requirement in requirements:
        total = total + requirement.excess(surface, position, normal) ** 2
    return safe_root(total)


class Apart(Requirement):
    """``|p_i - p_j| >= distance`` (m) for all pairs of contacts: fingers have a width."""

    distance: float

    def excess(
        self, surface: SmoothSurface, position: Float[Array, "*batch k 3"], normal: Float[Array, "*batch k 3"]
    ) -> Float[Array, "*batch"]:
        """``(sum over pairs of max(distance - |p_i - p_j|, 0)^2)^(1/2)``, m."""
        if position.shape[-2] < 2:
            return jnp.zeros(position.shape[:-2], position.dtype)
        return _short(self.distance - _distances(position))


class JawWidth(Requirement):
    """``least <= |p_1 - p_2| <= most`` (m) between the first two contacts: what a jaw opens to."""

    most: float
    least: float = 0.0

    def excess(
        self, surface: SmoothSurface, position: Float[Array, "*batch k 3"], normal: Float[Array, "*batch k 3"]
    ) -> Float[Array, "*batch"]:
        """By how much the jaw would have to open or close, m."""
        width = _distances(position[..., :2, :])
        return _short(jnp.concatenate([width - self.most, self.least - width], axis=-1))


class EdgeClearance(Requirement):
    """``surface.edge_distance(p_i) >= distance`` (m): contacts stay off sharp edges."""

    distance: float

    def excess(
        self, surface: SmoothSurface, position: Float[Array, "*batch k 3"], normal: Float[Array, "*batch k 3"]
    ) -> Float[Array, "*batch"]:
        """``(sum of max(distance - edge_distance(p_i), 0)^2)^(1/2)``, m; 0 where there are no edges."""
        clear = surface.edge_distance(position)
        return _short(jnp.where(jnp.isfinite(clear), self.distance - clear, 0.0))


class Within(Requirement):
    """``inside(p_i) >= 0`` for every contact: a reachable region, or the complement of a forbidden part.

    inside  maps a point (3,) in m, in the surface's frame, to a signed distance in m: positive where contacts may be
    """

    inside: Callable[[Float[Array, " 3"]], Float[Array, ""]] = eqx.field(static=True)

    def excess(
        self, surface: SmoothSurface, position: Float[Array, "*batch k 3"], normal: Float[Array, "*batch k 3"]
    ) -> Float[Array, "*batch"]:
        """``(sum of max(-inside(p_i), 0)^2)^(1/2)``, m."""
        return _short(-jnp.vectorize(self.inside, signature="(d)->()")(position))


class Beyond(Requirement):
    """``|p_i - centre| >= radius`` (m) for every contact: a ball that is forbidden, such as a spout or a blade."""

    centre: tuple[float, float, float]
    radius: float

    def excess(
        self, surface: SmoothSurface, position: Float[Array, "*batch k 3"], normal: Float[Array, "*batch k 3"]
    ) -> Float[Array, "*batch"]:
        """``(sum of max(radius - |p_i - centre|, 0)^2)^(1/2)``, m."""
        away = position - jnp.asarray(self.centre, position.dtype)
        return _short(self.radius - safe_root(jnp.sum(away * away, axis=-1)))
