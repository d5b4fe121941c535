"""Contacts settled on the exact surface: short random moves to points of it, the best of a few kept where it is better.

    x <- argmax q over {x, x'_1, .., x'_n},    x'_j the surface's point next to x_i + spread * N(0, 1)

A mesh's triangles are flat, so q jumps where a contact crosses an edge of them, and no gradient sees that. What an
objective with a memory has learnt at one trial bounds it at all the others, so that only the best of them is looked at
closely. The spread grows with every success and shrinks with every failure. Source: Beyer, Schwefel, Evolution
strategies, Natural Computing 1, 2002: a (1 + n) strategy, each start on its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..contacts import ContactModel, Grasp
from ..core import Array
from ..surfaces import SmoothSurface, Surface
from .objectives import Objective, lessons, look
from .requirements import SLACK, Requirement, total_excess

__all__ = ["ROUNDS", "TRIALS", "Settled", "settle"]

GROUP = 64  # starts at a time
ROUNDS = 32
TRIALS = 16  # a round
CLOUD = 1 << 15  # points that contacts may move to: neighbours are 1 to 2 % of the radius apart
SPREAD = 0.1  # of the radius, at first
GROWTH, DECAY = 1.2, 0.85


class _Task(NamedTuple):
    """What is asked, and where."""

    surface: SmoothSurface
    model: ContactModel
    objective: Objective
    requirements: tuple[Requirement, ...]

    def grasp(self, position: np.ndarray, normal: np.ndarray) -> Grasp:
        return _grasp(self.surface.centre, self.model, position, normal)

    def worth(self, position: np.ndarray, normal: np.ndarray, memory: Any) -> np.ndarray:
        """(B,) objective; -inf where it is no number or a requirement is not met."""
        # Not in one program with the rest: most objectives bring programs of their own, compiled long before.
        value = np.asarray(self.objective.value(self.grasp(position, normal), memory))
        sound = np.isfinite(value)
        if self.requirements:
            sound &= np.asarray(_met(self.requirements, self.surface, position, normal))
        return np.where(sound, value, -np.inf)


@jax.jit
def _grasp(centre: Array, model: ContactModel, position: Array, normal: Array) -> Grasp:
    return Grasp(position - centre, normal, model)


@jax.jit
def _met(
    requirements: tuple[Requirement, ...], surface: SmoothSurface, position: Array, normal: Array
) -> Array:
    return total_excess(requirements, surface, position, normal) <= SLACK * surface.radius


class _Cloud:
    """Points of the exact surface, and the one of them next to a given one."""

    def __init__(self, surface: Surface):
        from scipy.spatial import KDTree

        self.point, self.normal = surface.sample(0, CLOUD)
        self.tree = KDTree(self.point)

    def moved(
        self, position: np.ndarray, normal: np.ndarray, by: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Points next to those (B, k, 3) moved ``by`` (B, TRIALS, k, 3) along their tangents; 0 leaves one alone."""
        shape = by.shape
        along = by - normal[:, None] * np.sum(by * normal[:, None], axis=-1, keepdims=True)
        position, normal = (np.broadcast_to(x[:, None], shape).copy() for x in (position, normal))
        away = np.any(by != 0, axis=-1)
        nearest = self.tree.query(position[away] + along[away])[1]
        position[away], normal[away] = self.point[nearest], self.normal[nearest]
        return position, normal


class Settled(NamedTuple):
    """The starts of a group, where their contacts (n, k, 3) came to rest on the exact surface, the best value."""

    start: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    best: float


def settle(
    surface: Surface,
    model: ContactModel,
    objective: Objective,
    requirements: tuple[Requirement, ...],
    position: np.ndarray,
    normal: np.ndarray,
    seed: int,
    rounds: int = ROUNDS,
) -> Iterator[Settled]:
    """Where contacts (S, k, 3) on the exact surface come to rest, a group of starts after the other.

    A start is never left with less than it had, as far as its objective's memory knows. What it does depends on the
    seed and its own number alone.
    """
    task = _Task(surface.traced, model, objective, requirements)
    cloud = _Cloud(surface)
    for group, first in enumerate(range(0, len(position), GROUP)):
        start = np.arange(first, min(first + GROUP, len(position)))
        rows = np.minimum(np.arange(first, first + GROUP), len(position) - 1)
        random = np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, group])))
        here, inward, worth = _rest(task, cloud, random, position[rows], normal[rows], rounds)
        yield Settled(start, here[: len(start)], inward[: len(start)], float(worth[: len(start)].max()))


def _rest(
    task: _Task,
    cloud: _Cloud,
    random: np.random.Generator,
    position: np.ndarray,
    normal: np.ndarray,
    rounds: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where contacts (B, k, 3) come to rest, with normals and worth."""
    learns = task.objective.interval > 1
    memory = lessons(task.objective, task.grasp(position, normal))
    worth = task.worth(position, normal, memory)
    spread = np.full(len(position), SPREAD * float(task.surface.radius))
    for _ in range(rounds):
        by = spread[:, None, None, None] * _moves(random, position.shape)
        tried, inward = cloud.moved(position, normal, by)
        every = [x.reshape(-1, *x.shape[2:]) for x in (tried, inward)]
        known = jax.tree.map(lambda x: jnp.repeat(x, TRIALS, axis=0), memory)
        values = task.worth(*every, known).reshape(-1, TRIALS)
        chosen = np.arange(len(values)), values.argmax(axis=1)
        new, trial = values[chosen], (tried[chosen], inward[chosen])
        if learns:
            memory = look(task.objective, task.grasp(*trial), memory)
            new = task.worth(*trial, memory)
            worth = np.minimum(worth, task.worth(position, normal, memory))
        better = new > worth
        position = np.where(better[:, None, None], trial[0], position)
        normal = np.where(better[:, None, None], trial[1], normal)
        worth = np.where(better, new, worth)
        spread *= np.where(better, GROWTH, DECAY)
    return position, normal, worth


def _moves(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Normal moves (B, TRIALS, k, 3) of contacts (B, k, 3), each as likely 0 as not, at least one of a grasp's not."""
    shape = (shape[0], TRIALS, *shape[1:])
    moved = random.random(shape[:-1]) < 0.5
    one = random.integers(shape[-2], size=shape[:-2])
    moved |= np.arange(shape[-2]) == one[..., None]
    return random.normal(size=shape) * moved[..., None]
