"""What placement maximises: any function of grasps, or one that learns on its way where they are weakest.

``Epsilon`` is the smallest of infinitely many functions, ``min over |d| = 1 of h(d)``. It is climbed by exchange: each
grasp has a bank of directions; for a few steps the smallest h of the bank is climbed, then the bank learns the weakest
directions of where that led. Source: Hettich, Kortanek, Semi-infinite programming, SIAM Review 35(3), 1993, section 7.
"""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import PyTree

from ..conic import solve
from ..contacts import Grasp
from ..core import Array, ArrayLike, Float, wrench_dimension
from ..quality import NORMS, effort_map, epsilon_quality, facet_normal, signed_supports, torque_lengths
from ..resistance import wrench_resistance

__all__ = [
    "FLOOR",
    "Epsilon",
    "EpsilonFloor",
    "Margin",
    "Measure",
    "Objective",
    "lessons",
    "look",
    "objective",
]

Memory = PyTree[Array]  # (B, ..): what an objective has learnt about each grasp

LESSONS = 4
FLOOR = -10.0  # margins below it (and -inf) count as it


class Objective(eqx.Module):
    """A differentiable function of a batch of grasps (B,), with a memory (B, ..) of what it learnt about each.

    interval  steps between two calls of ``learn``; at 1 it is never called

    A pytree: objectives that differ in their numbers share compiled programs.
    """

    interval: ClassVar[int] = 1

    def begin(self, grasp: Grasp) -> Memory:
        """The memory of grasps that were not seen before."""
        return ()

    def guide(self) -> Objective:
        """What starts are chosen by and climbed first: most measures are flat where a grasp does not hold."""
        return Margin()

    def learn(self, grasp: Grasp, memory: Memory) -> Memory:
        """The memory after another look at the grasps as they are now."""
        return memory

    @abc.abstractmethod
    def value(self, grasp: Grasp, memory: Memory) -> Float[Array, " B"]:
        """What is climbed, as far as the memory knows."""

    def final(self, grasp: Grasp) -> Float[Array, " B"]:
        """The values to report."""
        return self.value(grasp, self.begin(grasp))


def look(objective: Objective, grasp: Grasp, memory: Memory) -> Memory:
    """``objective.learn``: compiled once for all who learn about as many grasps at a time."""
    numbers, asked = eqx.partition(objective, eqx.is_inexact_array_like)
    return _look(asked, numbers, grasp, memory)


@functools.partial(jax.jit, static_argnums=0)
def _look(asked: Objective, numbers: Any, grasp: Grasp, memory: Memory) -> Memory:
    return eqx.combine(numbers, asked).learn(grasp, memory)


def lessons(objective: Objective, grasp: Grasp) -> Memory:
    """The memory of grasps not seen before, after looks enough to choose between them by their ``value``."""
    memory = objective.begin(grasp)
    for _ in range(LESSONS if objective.interval > 1 else 0):
        memory = look(objective, grasp, memory)
    return memory


class Margin(Objective):
    """t* of ``wrench_resistance``, at least -10, so that grasps without any internal force can be compared."""

    def value(self, grasp: Grasp, memory: Memory) -> Float[Array, " B"]:
        """``max(t*, -10)``, no unit."""
        return jnp.maximum(wrench_resistance(grasp).margin, FLOOR)


class Measure(Objective):
    """``function(grasp)``: any differentiable function of a ``Grasp`` with batch shape (B,) to (B,)."""

    function: Callable[[Grasp], Float[Array, " B"]] = eqx.field(static=True)

    def value(self, grasp: Grasp, memory: Memory) -> Float[Array, " B"]:
        """``function(grasp)``."""
        return self.function(grasp)


class EpsilonFloor(Objective):
    """``sigma / (sqrt(2) k / t + sqrt(k))`` where t > 0: a lower bound of epsilon in closed form; t where it is not.

    sigma is ``tr((A A^T)^-1)^(-1/2)``, at most the smallest singular value of the scaled grasp map A. The margin's
    internal force has depth t / k when its normal forces sum to 1; what ``A^+ w`` of a wrench |w| = r adds to it takes
    at most ``sqrt(2) r / sigma`` of the depth and ``sqrt(k) r / sigma`` of effort. Ranks grasps nearly as epsilon does,
    for the price of a margin.

    torque_scale  as for ``Epsilon``
    """

    torque_scale: Float[ArrayLike, "*batch"] | None = None

    def value(self, grasp: Grasp, memory: Memory) -> Float[Array, " B"]:
        """``sigma / (sqrt(2) k / t + sqrt(k))``, or t where it is not positive."""
        t = jnp.maximum(wrench_resistance(grasp).margin, FLOOR)
        return _floor(grasp, torque_lengths(grasp, self.torque_scale), t)


@jax.jit
def _floor(grasp: Grasp, length: Array, t: Array) -> Array:
    A = effort_map(grasp, length)
    held = t > 0
    eye = jnp.eye(A.shape[-2], dtype=A.dtype)
    gram = jnp.where(held[..., None, None], jnp.einsum("...kan,...kbn->...ab", A, A), eye)
    inverse = solve(lax.stop_gradient(gram), jnp.broadcast_to(eye, gram.shape))
    slope = jnp.einsum("...ab,...bc->...ac", inverse, inverse)  # d tr(M^-1) = -tr(M^-2 dM)
    change = jnp.sum(slope * (gram - lax.stop_gradient(gram)), axis=(-2, -1))
    sigma = 1 / jnp.sqrt(jnp.trace(inverse, axis1=-2, axis2=-1) - change)
    count = jnp.sum(grasp.active, axis=-1, dtype=t.dtype)
    bound = sigma / (2**0.5 * count / jnp.where(held, t, 1.0) + jnp.sqrt(count))
    return jnp.where(held, bound, t)


class _Bank(NamedTuple):
    direction: Array  # (B, BANK, m) unit
    seen: Array  # (B,) int32: directions learnt so far; the oldest make way


BANK = 24  # directions of a grasp
RAYS, WARM, SHOTS = 4, 2, 2  # learnt at once: two of the bank's weakest and two new ones, two ray shots each
SOFTNESS = 0.03  # of the smallest h: directions so much stronger count e times less
ROWS = 1024  # of the table that new directions come from


@functools.cache
def _table(m: int) -> np.ndarray:
    """Fixed directions (ROWS, m), uniform over the sphere: the same for all grasps, in turn."""
    random = np.random.Generator(np.random.Philox(0)).normal(size=(ROWS, m))
    return random / np.linalg.norm(random, axis=1, keepdims=True)


class Epsilon(Objective):
    """Ferrari-Canny epsilon of ``epsilon_quality``; below 0 where a grasp is not resistant, so that it can be climbed.

    norm          "L1" or "Linf"
    torque_scale  m, one number for all grasps, such as the object's radius; by default each grasp's own L

    While climbing, the smallest h of the bank: never below epsilon, and epsilon where a direction of the bank is the
    weakest. Reported is the proven upper bound of a bracket of 1 %.
    """

    norm: str = eqx.field(static=True, default="L1")
    torque_scale: Float[ArrayLike, "*batch"] | None = None
    interval: ClassVar[int] = 5

    def __check_init__(self):
        if self.norm not in NORMS:
            raise ValueError(f"norm must be one of {', '.join(NORMS)}, got {self.norm!r}")

    def guide(self) -> Objective:
        """Its lower bound in closed form."""
        return EpsilonFloor(self.torque_scale)

    def begin(self, grasp: Grasp) -> _Bank:
        """An empty bank of directions."""
        m = wrench_dimension(grasp.dimension)
        count = jnp.zeros(grasp.batch_shape, jnp.int32)
        return _Bank(jnp.zeros((*grasp.batch_shape, BANK, m), grasp.dtype), count)

    def learn(self, grasp: Grasp, memory: _Bank) -> _Bank:
        """The bank with the weakest directions of the grasps as they are now."""
        still: Any = jax.tree.map(lax.stop_gradient, grasp)
        weakest = jnp.argsort(self._supports(still, memory), axis=-1)[:, :WARM]
        warm = jnp.take_along_axis(memory.direction, weakest[..., None], axis=1)
        turn = memory.seen[:, None] + jnp.arange(RAYS, dtype=jnp.int32)
        fresh = jnp.asarray(_table(memory.direction.shape[-1]), grasp.dtype)[turn % ROWS]
        known = (memory.seen > 0)[:, None, None]
        rays = jnp.concatenate([jnp.where(known, warm, fresh[:, :WARM]), fresh[:, WARM:]], axis=1)
        length = torque_lengths(still, self.torque_scale)
        rays = lax.fori_loop(0, SHOTS, lambda _, d: facet_normal(still, self.norm, length, d), rays)
        lane = jnp.arange(rays.shape[0], dtype=jnp.int32)[:, None]
        return _Bank(memory.direction.at[lane, turn % BANK].set(rays), memory.seen + RAYS)

    def _supports(self, grasp: Grasp, memory: _Bank) -> Array:
        return _supports(grasp, self.norm, torque_lengths(grasp, self.torque_scale), memory)

    def value(self, grasp: Grasp, memory: _Bank) -> Float[Array, " B"]:
        """``min h(d)`` over the directions of the bank: never below epsilon."""
        return _smallest(self._supports(grasp, memory))

    def final(self, grasp: Grasp) -> Float[Array, " B"]:
        """The proven upper bound of epsilon, in a bracket of 1 %."""
        return epsilon_quality(grasp, norm=self.norm, torque_scale=self.torque_scale).upper


@functools.partial(jax.jit, static_argnums=1)
def _supports(grasp: Grasp, norm: str, length: Array, memory: _Bank) -> Array:
    h = signed_supports(effort_map(grasp, length), grasp.active, norm, memory.direction)
    return jnp.where(jnp.arange(BANK, dtype=jnp.int32) < memory.seen[:, None], h, jnp.inf)


@jax.jit
def _smallest(h: Array) -> Array:
    """min h; its derivative a weighted mean of those of the weakest directions: ridges would make the climb zigzag."""
    least = jnp.min(h, axis=-1, keepdims=True)
    width = jnp.maximum(SOFTNESS * jnp.abs(least), jnp.finfo(h.dtype).tiny ** 0.5)
    weight = jnp.exp((least - h) / width)
    weight = lax.stop_gradient(weight / jnp.sum(weight, axis=-1, keepdims=True))
    mean = jnp.sum(jnp.where(weight > 0, weight * jnp.where(weight > 0, h, 0.0), 0.0), axis=-1)
    return lax.stop_gradient(least[..., 0] - mean) + mean


def objective(given: Objective | Callable[[Grasp], Array]) -> Objective:
    """``given`` as an ``Objective``: itself, or a function of grasps as a ``Measure``; ValueError for anything else."""
    if isinstance(given, Objective):
        return given
    if callable(given) and not isinstance(given, type):
        return Measure(cast(Callable[[Grasp], Array], given))
    raise ValueError(
        f"objective must be a jaxgrasp.placement.Objective such as Epsilon(), or a function of grasps; got {given!r}"
    )
