"""Contacts taken uphill on a surface by an optax optimiser, a block of starts at a time, each start on its own.

    p <- retract(p + scale * optimizer(grad (q(G(p)) - weight * sum of squared excesses)))

A start keeps the best point it has seen. Where it no longer improves it goes back there and halves its steps; where
these have become small, or its objective is no number, it ends. Ended starts leave their lane to the next one in the
queue, so the cost follows the steps that are taken. Every lane has an optimiser state of its own.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax

from ..backend import tile_width
from ..contacts import ContactModel, Grasp, filled
from ..core import Array
from ..surfaces import SmoothSurface
from .objectives import Objective, look
from .requirements import Requirement, total_excess

__all__ = ["Ended", "climb"]

ROUNDS = 8  # between two looks at the queue, where there is nothing to learn between them
PENALTY = 1e2  # per squared radius of excess
PATIENCE, IMPROVEMENT = 6, 1e-3  # rounds without that much improvement halve a start's steps
SMALLEST = 2.0**-5  # of the optimiser's own steps: a start that would take smaller ones ends


class _Lanes(NamedTuple):
    """Starts on their way, (B, ..): where they are, the best they saw, how long ago."""

    point: Array  # (B, k, 3)
    optimizer: Any
    memory: Any  # of the objective
    best: Array  # (B,) penalised objective
    best_point: Array
    waited: Array  # (B,) rounds since it improved enough
    scale: Array  # (B,) of the optimiser's steps
    steps: Array
    alive: Array


class Ended(NamedTuple):
    """A start that has ended: its number, its best point (k, 3), the penalised objective there, steps taken."""

    start: int
    point: np.ndarray
    value: float
    steps: int


class _Plan(NamedTuple):
    """What is fixed at trace time; ``asked`` is what is left of objective and requirements without their numbers."""

    optimizer: optax.GradientTransformation
    asked: Any


@jax.jit
def _grasp(surface: SmoothSurface, model: ContactModel, point: Array) -> tuple[Grasp, Array, Array]:
    """The grasp at points (B, k, 3) of the surface, its positions and normals."""
    position, normal = surface.slide(point)
    return Grasp(position - surface.centre, normal, model), position, normal


class _Ground(NamedTuple):
    """What every step needs."""

    surface: SmoothSurface
    model: ContactModel
    objective: Objective
    requirements: tuple[Requirement, ...]

    def grasp(self, point: Array) -> tuple[Grasp, Array, Array]:
        return _grasp(self.surface, self.model, point)

    def scores(self, point: Array, memory: Any) -> tuple[Array, Array]:
        """The sum of the finite ones of (B,) scores, and these: objective less penalty."""
        grasp, position, normal = self.grasp(point)
        excess = total_excess(self.requirements, self.surface, position, normal) / self.surface.radius
        scores = self.objective.value(grasp, memory) - PENALTY * excess * excess
        return jnp.sum(jnp.where(jnp.isfinite(scores), scores, 0.0)), scores


def _kept(where: Array, new: Any, old: Any) -> Any:
    """``new`` in the lanes ``where``, ``old`` in the others."""
    return jax.tree.map(functools.partial(filled, where), new, old)


def _ground(plan: _Plan, numbers: Any, surface: SmoothSurface, model: ContactModel) -> _Ground:
    return _Ground(surface, model, *eqx.combine(numbers, plan.asked))


@functools.partial(jax.jit, static_argnums=0)
def _begin(plan: _Plan, numbers: Any, surface: SmoothSurface, model: ContactModel, point: Array) -> _Lanes:
    """Fresh lanes at points (B, k, 3)."""
    ground = _ground(plan, numbers, surface, model)
    count, dtype, zero = point.shape[0], point.dtype, jnp.zeros(point.shape[0], jnp.int32)
    return _Lanes(
        point, jax.vmap(plan.optimizer.init)(point), ground.objective.begin(ground.grasp(point)[0]),
        jnp.full(count, -jnp.inf, dtype), point, zero, jnp.ones(count, dtype), zero, jnp.ones(count, bool),
    )  # fmt: skip


@functools.partial(jax.jit, static_argnums=0)
def _advance(
    plan: _Plan, numbers: Any, surface: SmoothSurface, model: ContactModel, lanes: _Lanes, limit: Array
) -> _Lanes:
    """A few rounds, fewer where all lanes have ended; one of an objective that learns after each."""
    ground = _ground(plan, numbers, surface, model)
    rounds = ROUNDS if ground.objective.interval == 1 else 1

    def unfinished(carry: tuple[Array, _Lanes]) -> Array:
        return (carry[0] < rounds) & jnp.any(carry[1].alive)

    def one(carry: tuple[Array, _Lanes]) -> tuple[Array, _Lanes]:
        return carry[0] + 1, _round(plan.optimizer, ground, carry[1], limit)

    return lax.while_loop(unfinished, one, (jnp.int32(0), lanes))[1]


def _round(optimizer: optax.GradientTransformation, ground: _Ground, lanes: _Lanes, limit: Array) -> _Lanes:
    objective, surface = ground.objective, ground.surface
    memory, best = lanes.memory, lanes.best
    if objective.interval > 1:
        again = ground.scores(lanes.best_point, memory)[1]  # what is known now may bound the best point, too
        best = jnp.where(again < best, again, best)
    (_, scores), slope = jax.value_and_grad(ground.scores, has_aux=True)(lanes.point, memory)

    good = lanes.alive & jnp.isfinite(scores) & jnp.all(jnp.isfinite(slope), axis=(1, 2))
    improved = good & (scores > best + IMPROVEMENT * jnp.abs(best))
    better = good & (scores > best)
    best = jnp.where(better, scores, best)
    best_point = _kept(better, lanes.point, lanes.best_point)
    waited = jnp.where(improved, 0, lanes.waited + 1)
    stuck = waited >= PATIENCE
    scale = jnp.where(stuck, lanes.scale / 2, lanes.scale)
    alive = good & (scale >= SMALLEST) & (lanes.steps < limit)

    def step(slope: Array, point: Array, state: Any) -> tuple[Array, Any]:
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers and floats
            move, state = jax.vmap(optimizer.update)(-slope * surface.radius, state, point / surface.radius)
        far = scale[:, None, None] * surface.radius
        new = surface.retract(point + far * jnp.asarray(move, point.dtype))
        return jnp.where(jnp.isfinite(new), new, point), state

    def again_uphill(_: int, carry: tuple[Array, Any]) -> tuple[Array, Any]:
        slope = jax.grad(lambda p: ground.scores(p, memory)[0])(carry[0])
        return step(jnp.where(jnp.isfinite(slope), slope, 0.0), *carry)

    carry = step(slope, lanes.point, lanes.optimizer)
    if objective.interval > 1:
        carry = lax.fori_loop(1, objective.interval, again_uphill, carry)
    point = _kept(stuck, best_point, carry[0])
    moved = lanes._replace(point=point, optimizer=carry[1])
    return _kept(alive, moved, lanes)._replace(
        best=best, best_point=best_point, waited=jnp.where(stuck, 0, waited), scale=scale,
        steps=lanes.steps + jnp.where(alive, objective.interval, 0).astype(jnp.int32), alive=alive,
    )  # fmt: skip


def climb(
    surface: SmoothSurface,
    model: ContactModel,
    objective: Objective,
    optimizer: optax.GradientTransformation,
    requirements: tuple[Requirement, ...],
    origin: np.ndarray,
    steps: int,
) -> Iterator[list[Ended]]:
    """The starts that ended, as they end, for starts ``origin`` (S, k, 3) on the surface; at most ``steps`` each.

    The optimiser works in units of the surface's radius. Compiled once for each optimiser, shape of surface, and kind
    of objective and requirements, whatever their numbers.
    """
    numbers, asked = eqx.partition((objective, requirements), eqx.is_inexact_array_like)
    plan = _Plan(optimizer, asked)
    width = tile_width(1)  # starts at once: one tile of the solver
    dtype = surface.centre.dtype
    limit = jnp.int32(steps)
    owner = np.full(width, -1)
    waiting = 0
    lanes: Any = None
    while waiting < len(origin) or (owner >= 0).any():
        free = np.flatnonzero(owner < 0)[: len(origin) - waiting]
        if len(free) >= min(width // 4, len(origin) - waiting) > 0:
            given = np.broadcast_to(origin[:1], (width, *origin.shape[1:])).copy()
            given[free] = origin[waiting : waiting + len(free)]
            owner[free] = np.arange(waiting, waiting + len(free))
            waiting += len(free)
            fresh = _begin(plan, numbers, surface, model, jnp.asarray(given, dtype))
            fresh = fresh._replace(alive=jnp.asarray(owner >= 0))
            entered = np.isin(np.arange(width), free)
            lanes = fresh if lanes is None else _entered(jnp.asarray(entered), fresh, lanes)
        if objective.interval > 1:
            grasp = _grasp(surface, model, lanes.point)[0]
            lanes = lanes._replace(memory=look(objective, grasp, lanes.memory))
        lanes = _advance(plan, numbers, surface, model, lanes, limit)
        over = np.flatnonzero((owner >= 0) & ~np.asarray(lanes.alive))
        if len(over):
            point, best, taken = (np.asarray(x)[over] for x in (lanes.best_point, lanes.best, lanes.steps))
            ended = zip(owner[over].tolist(), point, best.tolist(), taken.tolist(), strict=True)
            yield [Ended(*x) for x in ended]
            owner[over] = -1


_entered = jax.jit(_kept)
