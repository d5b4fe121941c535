"""What every surface answers: the nearest point, the inward normal there, distance, curvature, sharp edges.

``x(p) = argmin |x - p|`` over the surface, with ``dx/dp = T (I + lambda K)^-1 T^T`` on the tangent plane
(K the shape operator, lambda the signed distance) and 0 across it. Source: do Carmo, Differential geometry of
curves and surfaces, 1976, sections 3.2 and 3.3.
"""

from __future__ import annotations

import abc
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..core import Array, ArrayLike, Float, contact_frame, nan_where, real_array

__all__ = [
    "SmoothSurface",
    "Surface",
    "centre_or_origin",
    "directions",
    "generator",
    "on_host",
    "parameter",
    "same_dtype",
    "unit_or",
]


def _points(value: ArrayLike, dtype: Any) -> Array:
    """``value`` as (*batch, 3) of ``dtype``; ValueError for any other shape."""
    array = real_array(value, "points")
    if array.ndim < 1 or array.shape[-1] != 3:
        raise ValueError(f"points must have shape (*batch, 3), got {array.shape}")
    return array.astype(dtype)


def parameter(value: ArrayLike, shape: tuple[int, ...], name: str, positive: bool = True) -> Array:
    """A real parameter of a shape; ValueError for a wrong shape and, where the value is known, a wrong number."""
    array = real_array(value, name)
    if array.shape != shape:
        what = "a number" if shape == () else f"an array of shape {shape}"
        raise ValueError(f"{name} must be {what}, got shape {array.shape}")
    if not isinstance(array, Tracer):
        known = np.asarray(array)
        if not np.isfinite(known).all() or (positive and (known <= 0).any()):
            raise ValueError(f"{name} must be {'positive and ' * positive}finite, got {known.tolist()}")
    return array


def centre_or_origin(centre: Float[ArrayLike, " 3"] | None) -> Array:
    """A shape's centre, by default the origin."""
    return parameter(jnp.zeros(3) if centre is None else centre, (3,), "centre", positive=False)


def same_dtype(*values: Array) -> tuple[Array, ...]:
    """Parameters in the widest of their dtypes."""
    dtype = max((v.dtype for v in values), key=lambda d: d.itemsize)
    return tuple(v.astype(dtype) for v in values)


def directions(random: np.random.Generator, count: int) -> np.ndarray:
    """Points (count, 3), uniform over the unit sphere (Archimedes: height and angle are uniform)."""
    height, turn = random.uniform(-1, 1, count), random.uniform(0, 2 * np.pi, count)
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)


def on_host(*values: Array) -> tuple[np.ndarray, ...]:
    """Parameters in float64."""
    return tuple(np.asarray(v, np.float64) for v in values)


def generator(seed: int, count: int) -> np.random.Generator:
    """The generator of a sample; ValueError for a seed or count that is negative."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"the seed must be an integer of 0 or more, got {seed!r}")
    if count < 0:
        raise ValueError(f"the count of points must be 0 or more, got {count}")
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(int(seed))))


def unit_or(v: Float[Array, " d"], other: Float[Array, " d"]) -> tuple[Array, Array]:
    """``v / |v|`` and ``|v|``; ``other`` (and derivative 0) where v = 0."""
    square = jnp.sum(v * v)
    there = square > 0
    length = jnp.sqrt(jnp.where(there, square, jnp.ones_like(square)))
    return jnp.where(there, v / length, other), jnp.where(there, length, jnp.zeros_like(length))


class SmoothSurface(eqx.Module):
    """A closed surface in metres as a compiled program sees it: what may be differentiated, and nothing else.

    centre  (3,) centre of mass, m
    radius  () largest distance of the surface from it, m

    Everything below takes points (*batch, 3) in m, works under jit, vmap and grad, and gives NaN for a point with
    NaN or infinite coordinates, in that lane alone. Pass a surface to a jitted function as an argument: it is a
    pytree, and a closure would compile its arrays in.
    """

    centre: eqx.AbstractVar[Float[Array, " 3"]]
    radius: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def _contact(self, point: Float[Array, " 3"]) -> tuple[Array, Array]:
        """Nearest point and inward unit normal there, for one finite point."""

    def _normal_on(self, x: Float[Array, " 3"]) -> Array:
        """Inward unit normal at a point of the surface, and some smooth continuation of it off the surface."""
        return self._contact(x)[1]

    def _retract(self, point: Float[Array, " 3"]) -> Array:
        """A point of the surface, for one that is near it: ``_contact`` where nothing cheaper is known."""
        return self._contact(point)[0]

    def _tangent_normal(self, x: Float[Array, " 3"]) -> Array:
        """A unit normal of the surface that ``_contact`` projects onto, at a point of it."""
        return self._normal_on(x)

    def _slide(self, point: Float[Array, " 3"]) -> tuple[Array, Array]:
        across = jax.lax.stop_gradient(self._tangent_normal(point))
        change = point - jax.lax.stop_gradient(point)
        x = jax.lax.stop_gradient(point) + change - across * jnp.sum(across * change)
        return x, self._normal_on(x)

    def _edge_distance(self, point: Float[Array, " 3"]) -> Array:
        return jnp.full((), jnp.inf, point.dtype)

    def _distance(self, point: Float[Array, " 3"]) -> Array:
        x, normal = self._contact(point)
        return -jnp.sum(normal * (point - x))

    def _curvature(self, point: Float[Array, " 3"]) -> Array:
        on, normal = self._contact(point)
        tangents = jnp.stack(contact_frame(normal), axis=-1)
        shape = -jax.jacfwd(self._normal_on)(on)  # along the surface any continuation has the same derivative
        block = jnp.sum(tangents[:, :, None] * jnp.sum(shape[:, :, None] * tangents, axis=1)[:, None], axis=0)
        mean, half = (block[0, 0] + block[1, 1]) / 2, (block[0, 0] - block[1, 1]) / 2
        _, spread = unit_or(jnp.stack([half, (block[0, 1] + block[1, 0]) / 2]), jnp.zeros(2, point.dtype))
        return jnp.stack([mean - spread, mean + spread])

    def _answer(self, question: str, shape: str, point: Any) -> Any:
        return _lanes(self.traced, question, shape, _points(point, self.centre.dtype))

    @property
    def traced(self) -> SmoothSurface:
        """What to hand to a jitted function: equal shapes of arrays, equal programs."""
        return self

    def contact(
        self, point: Float[ArrayLike, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3"]]:
        """``project`` and ``normal`` at the price of one of them."""
        return self._answer("_contact", "(d),(d)", point)

    def project(self, point: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """``argmin_x |x - p|`` over the surface, m; a fixed one of them where several are nearest."""
        return self.contact(point)[0]

    def slide(
        self, point: Float[ArrayLike, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3"]]:
        """``contact`` for points that are on the surface: ``dx/dp = T T^T``, at a fraction of the price."""
        return self._answer("_slide", "(d),(d)", point)

    def retract(self, point: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """A point of the surface for points near it, such as after a small step: nearly ``project``, cheaper."""
        return self._answer("_retract", "(d)", point)

    def normal(self, point: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Inward unit normal at ``project(point)``; on the surface its derivative is minus the shape operator."""
        return self.contact(point)[1]

    def distance(self, point: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch"]:
        """``+-|p - project(p)|``: signed distance, m, negative inside."""
        return self._answer("_distance", "()", point)

    def curvature(self, point: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 2"]:
        """Principal curvatures at ``project(point)``, 1/m, the smaller first; positive where convex (1/r on a ball).

        The eigenvalues of ``-T^T (dn/dp) T`` for the inward normal n and tangents T. Their own derivatives are those
        of simple eigenvalues, and 0 in the difference of two equal ones.
        """
        return self._answer("_curvature", "(c)", point)

    def edge_distance(self, point: Float[ArrayLike, "*batch 3"]) -> Float[Array, "*batch"]:
        """Distance of ``project(point)`` to the nearest sharp edge, m; infinite where the surface has none."""
        return self._answer("_edge_distance", "()", point)


class Surface(SmoothSurface):
    """A ``SmoothSurface`` of which the host knows more: random points, and where contacts really are.

    faceted  whether the real surface is another one than the smooth one, with jumping normals
    """

    faceted: ClassVar[bool] = False

    @abc.abstractmethod
    def sample(self, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """``count`` points (count, 3) in m, uniform over the area, and inward unit normals there.

        On the host, in float64; the same seed gives the same bytes. ValueError for a negative seed or count.
        """

    def exact_contact(self, point: Float[ArrayLike, "*batch 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Positions (*batch, 3) in m and inward normals of contacts on the real surface, for a mesh its triangles."""
        position, normal = self.contact(point)
        return np.asarray(position), np.asarray(normal)


@partial(jax.jit, static_argnums=(1, 2))
def _lanes(surface: SmoothSurface, question: str, shape: str, point: Array) -> Any:
    """One compilation a shape: a call outside jit would otherwise compile its loops anew each time."""

    def lane(p: Array) -> Any:
        finite = jnp.isfinite(p).all()
        answer = getattr(surface, question)(jnp.where(finite, p, surface.centre + surface.radius))
        return jax.tree.map(lambda a: nan_where(~finite, a), answer)

    return jnp.vectorize(lane, signature=f"(d)->{shape}")(point)
