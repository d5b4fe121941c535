"""Ball, box and can: surfaces at a fixed distance of something simpler, with projections in closed form.

``x = c + r (p - c) / |p - c|``, c the point nearest to p of the core: a point, a box, a cylinder. Inside the core,
where no direction is given, p moves straight to the nearest flat side.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..core import Array, ArrayLike, Float
from .surface import Surface, centre_or_origin, directions, generator, on_host, parameter, same_dtype, unit_or

__all__ = ["Cylinder", "RoundedBox", "Sphere"]


def _check_rounding(rounding: Array, smallest: Array, what: str) -> None:
    if isinstance(rounding, Tracer) or isinstance(smallest, Tracer):
        return
    if float(rounding) > float(smallest):
        raise ValueError(
            f"rounding must not exceed {what}, {float(smallest):.6g} m, got {float(rounding):.6g} m"
        )


class Sphere(Surface):
    """``|x - centre| = radius``. radius () and centre (3,) in m; ValueError where the radius is not positive.

    At its centre, ``project`` gives the point above it.
    """

    radius: Float[Array, ""]
    centre: Float[Array, " 3"]

    def __init__(self, radius: Float[ArrayLike, ""], centre: Float[ArrayLike, " 3"] | None = None):
        self.radius, self.centre = same_dtype(parameter(radius, (), "radius"), centre_or_origin(centre))

    def _contact(self, point: Float[Array, " 3"]) -> tuple[Array, Array]:
        outward, _ = unit_or(point - self.centre, jnp.asarray([0.0, 0.0, 1.0], point.dtype))
        return self.centre + self.radius * outward, -outward

    def sample(self, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Exactly uniform (Archimedes: height and angle are uniform)."""
        outward = directions(generator(seed, count), count)
        radius, centre = on_host(self.radius, self.centre)
        return centre + radius * outward, -outward


class RoundedBox(Surface):
    """All points at distance ``rounding`` of the box with half extents ``half_extents - rounding``.

    half_extents (3,), rounding (), centre (3,) in m, along the axes. ``edge_distance`` is the distance to where the
    rounding begins, negative (and least in its middle) within. ValueError where a length is not positive or the
    rounding exceeds the least half extent.
    """

    half_extents: Float[Array, " 3"]
    rounding: Float[Array, ""]
    centre: Float[Array, " 3"]

    def __init__(
        self,
        half_extents: Float[ArrayLike, " 3"],
        rounding: Float[ArrayLike, ""],
        centre: Float[ArrayLike, " 3"] | None = None,
    ):
        self.half_extents, self.rounding, self.centre = same_dtype(
            parameter(half_extents, (3,), "half_extents"),
            parameter(rounding, (), "rounding"),
            centre_or_origin(centre),
        )
        _check_rounding(self.rounding, jnp.min(self.half_extents), "the least half extent")

    @property
    def radius(self) -> Float[Array, ""]:
        """``|half_extents - rounding| + rounding``, m."""
        return jnp.sqrt(jnp.sum((self.half_extents - self.rounding) ** 2)) + self.rounding

    def _contact(self, point: Float[Array, " 3"]) -> tuple[Array, Array]:
        local = point - self.centre
        core = self.half_extents - self.rounding
        sign = jnp.where(local < 0, -jnp.ones_like(local), jnp.ones_like(local))
        side = jax.nn.one_hot(jnp.argmax(jnp.abs(local) - core), 3, dtype=local.dtype)
        inner = jnp.clip(local, -core, core)
        outward, away = unit_or(local - inner, sign * side)
        foot = jnp.where((away == 0) & (side > 0), sign * core, inner)
        return self.centre + foot + self.rounding * outward, -outward

    def _edge_distance(self, point: Float[Array, " 3"]) -> Array:
        x, _ = self._contact(point)
        beyond = jnp.abs(x - self.centre) - (self.half_extents - self.rounding)
        return -jnp.sort(beyond)[1]

    def sample(self, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Exactly uniform: three pairs of faces, three cylinders and a ball, cut and moved apart."""
        random = generator(seed, count)
        half, rounding, centre = on_host(self.half_extents, self.rounding, self.centre)
        core = half - rounding
        following = np.roll(core, -1), np.roll(core, -2)
        faces = 8 * following[0] * following[1]
        area = np.concatenate([faces, 4 * np.pi * rounding * core, [4 * np.pi * rounding**2]])
        kind = np.searchsorted(np.cumsum(area), random.random(count) * area.sum(), side="right")
        kind = np.minimum(kind, len(area) - 1)
        outward, foot = directions(random, count), random.uniform(-1, 1, (count, 3))
        for axis in range(3):
            flat, tube = kind == axis, kind == 3 + axis
            outward[flat] = np.sign(foot[flat, axis])[:, None] * np.eye(3)[axis]
            outward[tube, axis] = 0
            outward[tube] /= np.linalg.norm(outward[tube], axis=1, keepdims=True)
        # Where a direction is, the foot is the corner or side of the core that lies that way.
        foot = core * np.where(outward != 0, np.sign(outward), foot)
        return centre + foot + rounding * outward, -outward


class Cylinder(Surface):
    """All points at distance ``rounding`` of the cylinder about z with both lengths less by ``rounding``.

    side (radius of the round side), half_height, rounding (), centre (3,) in m. ``edge_distance`` as for
    ``RoundedBox``. On the axis, ``project`` to the side goes along +x. ValueError where a length is not positive or the
    rounding exceeds ``side`` or ``half_height``.
    """

    side: Float[Array, ""]
    half_height: Float[Array, ""]
    rounding: Float[Array, ""]
    centre: Float[Array, " 3"]

    def __init__(
        self,
        side: Float[ArrayLike, ""],
        half_height: Float[ArrayLike, ""],
        rounding: Float[ArrayLike, ""],
        centre: Float[ArrayLike, " 3"] | None = None,
    ):
        self.side, self.half_height, self.rounding, self.centre = same_dtype(
            parameter(side, (), "side"),
            parameter(half_height, (), "half_height"),
            parameter(rounding, (), "rounding"),
            centre_or_origin(centre),
        )
        _check_rounding(self.rounding, jnp.minimum(self.side, self.half_height), "side or half_height")

    def _core(self) -> Array:
        return jnp.stack([self.side, self.half_height]) - self.rounding

    @property
    def radius(self) -> Float[Array, ""]:
        """``|(side, half_height) - rounding| + rounding``, m."""
        return jnp.sqrt(jnp.sum(self._core() ** 2)) + self.rounding

    def _contact(self, point: Float[Array, " 3"]) -> tuple[Array, Array]:
        local, core = point - self.centre, self._core()
        spoke, across = unit_or(local[:2], jnp.asarray([1.0, 0.0], local.dtype))
        flat = jnp.stack([across, local[2]])  # the half-plane through p and the axis
        sign = jnp.where(flat < 0, -jnp.ones_like(flat), jnp.ones_like(flat))
        side = jax.nn.one_hot(jnp.argmax(jnp.abs(flat) - core), 2, dtype=local.dtype)
        inner = jnp.clip(flat, -core, core)
        direction, away = unit_or(flat - inner, sign * side)
        foot = jnp.where((away == 0) & (side > 0), sign * core, inner) + self.rounding * direction
        outward = jnp.concatenate([direction[0] * spoke, direction[1:]])
        # Near the axis x is p's own, not the spoke's: that keeps derivatives finite on the caps.
        turned = jnp.where(direction[0] == 0, local[:2], foot[0] * spoke)
        return self.centre + jnp.concatenate([turned, foot[1:]]), -outward

    def _edge_distance(self, point: Float[Array, " 3"]) -> Array:
        local = self._contact(point)[0] - self.centre
        across = unit_or(local[:2], jnp.zeros(2, local.dtype))[1]
        return -jnp.min(jnp.stack([across, jnp.abs(local[2])]) - self._core())

    def sample(self, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Exactly uniform: two discs, the side, and the rim as a bent cylinder and a ball."""
        random = generator(seed, count)
        (side, height), rounding, centre = on_host(self._core(), self.rounding, self.centre)
        area = np.array(
            [2 * side**2, 4 * (side + rounding) * height, 2 * np.pi * rounding * side, 4 * rounding**2]
        )
        kind = np.searchsorted(np.cumsum(area), random.random(count) * area.sum(), side="right")
        kind = np.minimum(kind, 3)
        upper, turn = np.where(random.random(count) < 0.5, 1.0, -1.0), random.uniform(0, 2 * np.pi, count)
        u = random.random(count)
        # Elevation of the normal: area grows as cos on the ball's share, evenly on the bent cylinder's.
        sine = np.select([kind == 0, kind == 1, kind == 2], [1.0, 0.0, np.sin(np.pi / 2 * u)], u)
        cosine = np.where(kind == 0, 0.0, np.sqrt(1 - sine**2))
        across = np.where(kind == 0, side * np.sqrt(u), side + rounding * cosine)
        z = np.where(kind == 1, height * u, height + rounding * sine)
        spoke = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        outward = np.concatenate([cosine[:, None] * spoke, (upper * sine)[:, None]], axis=1)
        return centre + np.concatenate([across[:, None] * spoke, (upper * z)[:, None]], axis=1), -outward
