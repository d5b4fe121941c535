"""Ellipsoid and superquadric: convex surfaces F(x) = 1 with F(t x) = t F(x), the gauge of the body inside.

The nearest point solves ``(I - n n^T) (x - p) + (F(x) - 1) s n = 0``, n the unit normal and s a length. It is
found by Newton steps over the tangent plane, ``T^T (I + lambda grad^2 F) T step = T^T (p - x)``, each followed by
``x / F(x)`` (an ellipsoid's by a scalar equation). Its derivatives come from the equation above by the implicit
function theorem, in p and in the shape's parameters. Sources: Absil, Mahony, Sepulchre, Optimization algorithms on
matrix manifolds, 2008, section 6.2; Jaklič, Leonardis, Solina, Segmentation and recovery of superquadrics, 2000.
"""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..core import Array, ArrayLike, Float, contact_frame, cross
from .surface import Surface, centre_or_origin, directions, generator, parameter, same_dtype

__all__ = ["Ellipsoid", "Gauge", "Superquadric"]

SEARCHES = 14  # Newton steps of which the best of several lengths is taken
POLISHES = 4  # steps at the end, of which the one that brings the equation nearest to 0 is taken
LENGTHS = 6  # step lengths 1, 1/2, .., 1/32
STIFFEST = 0.05  # least eigenvalue of the Newton matrix; I alone has 1
SOFT = 1e-6  # |u| is sqrt(u^2 + SOFT^2): F changes by less than 1e-12, and has all its derivatives
ROOTS = 12  # Newton steps for an ellipsoid's multiplier
NARROWEST = 0.2  # least exponent


def _solve(matrix: Array, b: Array) -> Array:
    """``matrix^-1 b`` for 3 x 3 by Cramer's rule, finite where the determinant is 0."""
    one, two, three = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    determinant = jnp.sum(one * cross(two, three))
    least = jnp.full_like(determinant, 1e-9)
    # A focal point: the nearest point jumps there, and any derivative is a convention.
    determinant = jnp.where(jnp.abs(determinant) < least, least, determinant)
    parts = [jnp.sum(b * cross(two, three)), jnp.sum(one * cross(b, three)), jnp.sum(one * cross(two, b))]
    return jnp.stack(parts) / determinant


class Gauge(Surface):
    """A convex surface about ``centre`` given by its gauge F, positively homogeneous of degree 1.

    ``project`` is exact to rounding outside the body, and inside as far as the nearest point is unique; where it
    is not, one of the nearest points, or of the locally nearest, is taken.
    """

    semiaxes: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def gauge(self, x: Float[Array, " 3"]) -> Float[Array, ""]:
        """F at a point relative to the centre, without a unit: below 1 inside, above outside."""

    def _residual(self, x: Array, point: Array) -> Array:
        value, slope = jax.value_and_grad(self.gauge)(x)
        normal = slope / jnp.sqrt(jnp.sum(slope * slope))
        away = x - point
        return away - normal * jnp.sum(normal * away) + (value - 1) * jnp.mean(self.semiaxes) * normal

    def _step(self, x: Array, point: Array) -> Array:
        slope, bend = jax.grad(self.gauge)(x), jax.hessian(self.gauge)(x)
        square = jnp.sum(slope * slope)
        tangent = jnp.stack(contact_frame(slope / jnp.sqrt(square)), axis=-1)
        away = point - x
        multiplier = jnp.sum(away * slope) / square
        right = jnp.sum(tangent * away[:, None], axis=0)
        curved = multiplier * jnp.sum(
            tangent[:, :, None] * jnp.sum(bend[:, :, None] * tangent[None], axis=1)[:, None], axis=0
        )
        a, b, d = 1 + curved[0, 0], curved[0, 1], 1 + curved[1, 1]
        least = (a + d) / 2 - jnp.sqrt(((a - d) / 2) ** 2 + b**2)
        shift = jnp.maximum(jnp.zeros_like(least), STIFFEST - least)
        a, d = a + shift, d + shift
        u = jnp.stack([d * right[0] - b * right[1], a * right[1] - b * right[0]]) / (a * d - b * b)
        return jnp.sum(tangent * u, axis=1)

    def _search(self, point: Array) -> Array:
        shortest = jax.nn.one_hot(jnp.argmin(self.semiaxes), 3, dtype=point.dtype)
        middle = jnp.sum((point / self.semiaxes) ** 2) < 1e-6
        start = jnp.where(middle, point + self.semiaxes * shortest, point)
        lengths = jnp.asarray([2.0**-i for i in range(LENGTHS)] + [0.0], point.dtype)

        def descend(count: Any, x: Array) -> Array:
            tried = x + lengths[:, None] * self._step(x, point)
            tried = tried / jax.vmap(self.gauge)(tried)[:, None]
            # Near the end the distance has no digits left; the equation has.
            far = jnp.sum((tried - point) ** 2, axis=1)
            wrong = jnp.sum(jax.vmap(self._residual, in_axes=(0, None))(tried, point) ** 2, axis=1)
            return tried[jnp.argmin(jnp.where(count < SEARCHES, far, wrong))]

        return jax.lax.fori_loop(0, SEARCHES + POLISHES, descend, start / self.gauge(start))

    def _contact(self, point: Float[Array, " 3"]) -> tuple[Array, Array]:
        local = point - self.centre

        def tangent_solve(linear: Any, b: Array) -> Array:
            return _solve(jax.jacobian(linear)(jnp.zeros_like(b)), b)

        x = jax.lax.custom_root(
            lambda y: self._residual(y, local), local, lambda _, __: self._search(local), tangent_solve
        )
        return self.centre + x, self._normal_on(self.centre + x)

    def _normal_on(self, x: Float[Array, " 3"]) -> Array:
        slope = jax.grad(self.gauge)(x - self.centre)
        return -slope / jnp.sqrt(jnp.sum(slope * slope))

    @eqx.filter_jit
    def _values(self, points: Float[Array, "N 3"]) -> Float[Array, " N"]:
        return jax.vmap(self.gauge)(points)

    @eqx.filter_jit
    def _slopes(self, points: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
        return jax.vmap(jax.grad(self.gauge))(points)

    def _stretch(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points of the surface over unit directions u, and their area for each area of the unit sphere."""
        semiaxes = np.asarray(self.semiaxes, np.float64)
        out = jnp.asarray(semiaxes * u, self.semiaxes.dtype)
        value = np.asarray(self._values(out), np.float64)
        x = np.asarray(out, np.float64) / value[:, None]
        slope = np.asarray(self._slopes(jnp.asarray(x, out.dtype)), np.float64)
        # The cone over a piece of the surface has a third of area times height n . x = 1 / |grad F|.
        return x, semiaxes.prod() / value**3 * np.linalg.norm(slope, axis=1)

    def sample(self, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Uniform by rejection from the stretched sphere; exact but for its bound, 1.05 times any density seen."""
        random = generator(seed, count)
        bound = 1.05 * float(self._stretch(directions(generator(0, 0), 20_000))[1].max())
        found, have = [np.empty((0, 3))], 0
        while have < count:
            x, density = self._stretch(directions(random, 4096))
            kept = x[random.random(4096) * bound < density]
            found.append(kept)
            have += len(kept)
        x = np.concatenate(found)[:count]
        outward = np.array(self._slopes(jnp.asarray(x, self.semiaxes.dtype)), np.float64)
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        return np.asarray(self.centre, np.float64) + x, -outward


class Ellipsoid(Gauge):
    """``sum_i (x_i / a_i)^2 = 1``. semiaxes a (3,), centre (3,) in m; ValueError where an axis is not positive."""

    semiaxes: Float[Array, " 3"]
    centre: Float[Array, " 3"]

    def __init__(self, semiaxes: Float[ArrayLike, " 3"], centre: Float[ArrayLike, " 3"] | None = None):
        self.semiaxes, self.centre = same_dtype(
            parameter(semiaxes, (3,), "semiaxes"), centre_or_origin(centre)
        )

    @property
    def radius(self) -> Float[Array, ""]:
        """The longest semiaxis, m."""
        return jnp.max(self.semiaxes)

    def gauge(self, x: Float[Array, " 3"]) -> Float[Array, ""]:
        """``|(x_i / a_i)|``."""
        return jnp.sqrt(jnp.sum((x / self.semiaxes) ** 2) + SOFT**4)

    def _search(self, point: Array) -> Array:
        """``x_i = a_i^2 p_i / (t + a_i^2)``, t the root of ``|x_i / a_i| = 1`` by Newton on ``1 / |x_i / a_i|``.

        From the left, where that is above 1, it converges monotonically. Source: Moré, Sorensen, Computing a trust
        region step, 1983.
        """
        a = self.semiaxes
        # Inside, off the plane across the shortest axis, where two points can be nearest.
        least = (
            (self.gauge(point) < 1).astype(a.dtype)
            * 1e-9
            * a
            * jax.nn.one_hot(jnp.argmin(a), 3, dtype=a.dtype)
        )
        point = jnp.where(jnp.abs(point) < least, least, point)

        def newton(_: Any, t: Array) -> Array:
            y = a * point / (t + a**2)
            square = jnp.sum(y * y)
            return t + square / jnp.sum(y * y / (t + a**2)) * (jnp.sqrt(square) - 1)

        t = jax.lax.fori_loop(0, ROOTS, newton, jnp.max(a * jnp.abs(point) - a**2))
        x = a**2 * point / (t + a**2)
        return x / self.gauge(x)


def _norm(u: Array, v: Array, power: Array) -> Array:
    """``(u^q + v^q)^(1/q)`` for positive u and v, without overflow."""
    largest = jax.lax.stop_gradient(jnp.maximum(u, v))
    return largest * ((u / largest) ** power + (v / largest) ** power) ** (1 / power)


def _longest(a: Array, b: Array, power: Array) -> Array:
    """Largest distance of ``|x / a|^q + |y / b|^q = 1`` from 0 (Hölder): ``(a^s + b^s)^(1/s)``, s = 2 q / (q - 2)."""
    large, small = jnp.maximum(a, b), jnp.minimum(a, b)
    inverse = (power - 2) / (2 * power)
    tiny = jnp.full_like(inverse, 1e-9)
    return large * (1 + (small / large) ** (1 / jnp.maximum(inverse, tiny))) ** inverse


class Superquadric(Gauge):
    """``((|x/a|^(2/e2) + |y/b|^(2/e2))^(e2/e1) + |z/c|^(2/e1)) = 1``: from ellipsoid (1, 1) to nearly a box (0.2, 0.2).

    semiaxes (a, b, c) and centre (3,) in m; exponents (e1, e2) without a unit, 0.2 to 1: above 1 the curvature
    is infinite where a coordinate is 0. Curvature is 0 there below 1. ValueError for numbers outside.
    """

    semiaxes: Float[Array, " 3"]
    exponents: Float[Array, " 2"]
    centre: Float[Array, " 3"]

    def __init__(
        self,
        semiaxes: Float[ArrayLike, " 3"],
        exponents: Float[ArrayLike, " 2"],
        centre: Float[ArrayLike, " 3"] | None = None,
    ):
        self.semiaxes, self.exponents, self.centre = same_dtype(
            parameter(semiaxes, (3,), "semiaxes"),
            parameter(exponents, (2,), "exponents"),
            centre_or_origin(centre),
        )
        if not isinstance(self.exponents, Tracer):
            known = np.asarray(self.exponents)
            if (known < NARROWEST - 1e-6).any() or (known > 1).any():
                raise ValueError(
                    f"exponents must lie between {NARROWEST} and 1, got {known.tolist()}; a rounder edge than 1 is "
                    "none, and sharper ones than 0.2 are a RoundedBox or a mesh"
                )

    @property
    def radius(self) -> Float[Array, ""]:
        """Largest distance from the centre, m, in closed form."""
        a, b, c = self.semiaxes[0], self.semiaxes[1], self.semiaxes[2]
        return _longest(_longest(a, b, 2 / self.exponents[1]), c, 2 / self.exponents[0])

    def gauge(self, x: Float[Array, " 3"]) -> Float[Array, ""]:
        """The left side to the power e1 / 2."""
        u = jnp.sqrt((x / self.semiaxes) ** 2 + SOFT**2)
        return _norm(_norm(u[0], u[1], 2 / self.exponents[1]), u[2], 2 / self.exponents[0])
