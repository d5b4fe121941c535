"""Contacts moved over a surface by gradients until the grasp is good, many starts at once.

    maximise  q(G(x(p)))  -  weight * sum of squared excesses,     x(p) the projection of p onto the surface

q is any differentiable function of a ``Grasp``: the margin by default. Every step projects, solves, differentiates
through solver and surface, and lets an optax optimiser move p. A start keeps the best point it has seen, stops when it
no longer improves, and never disturbs the others. At the end contacts are put exactly onto a mesh's triangles, with the
faces' own normals, and every grasp is solved and proved again there. Sources: the envelope theorem for the gradient;
Zhu, Wang 2003 and Liu et al. 2021 (grasps by gradients of closure measures).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax

from ._types import Array
from .certificate import check_certificate
from .contacts import ContactModel, HardFinger
from .errors import UserError
from .grasp import Grasp
from .requirements import SLACK, Requirement
from .resistance import WrenchResistance, wrench_resistance
from .status import Status
from .surfaces import MeshSurface, Surface

__all__ = ["Placement", "PlacementProgress", "place_contacts"]

BLOCK = 256  # starts optimised together: one compilation
CANDIDATES = 8  # random grasps a start is the best of
PENALTY = 1e2  # per squared radius of excess
PATIENCE, IMPROVEMENT = 15, 1e-3  # steps without that much improvement end a start
DRAWS = 64  # rounds of random contacts before a region counts as empty
FLOOR = -10.0  # margins below it (and -inf) count as it


def margin(grasp: Grasp) -> Array:
    """t*, at least -10 so that grasps without any internal force can be compared."""
    return jnp.maximum(wrench_resistance(grasp).margin, FLOOR)


Objective = Callable[[Grasp], Array]


class PlacementProgress(NamedTuple):
    """How far a placement is: starts finished, of how many, and the best value so far."""

    done: int
    starts: int
    best: float


@dataclass(frozen=True)
class Placement:
    """The best distinct grasps, and what became of every start.

    grasp     the grasps found, best first (n of them), positions about the surface's centre in m
    position  (n, k, 3) the same contacts in the surface's own frame
    value     (n,) the objective there          start   (n,) which start each comes from
    verdict   their ``WrenchResistance``         proved  (n,) bool: the independent checker accepted it
    before, after   (starts,) margins of every start and of where it ended
    resistant (starts,) bool: ended wrench resistant, with a certificate the checker accepts
    steps     (starts,) steps taken; a start with a NaN objective ends at its last good point
    excess    (starts,) m: how far the requirements are from being met; only grasps within them are in ``grasp``
    """

    grasp: Grasp
    position: np.ndarray
    value: np.ndarray
    start: np.ndarray
    verdict: WrenchResistance
    proved: np.ndarray
    before: np.ndarray
    after: np.ndarray
    resistant: np.ndarray
    steps: np.ndarray
    excess: np.ndarray


class _State(NamedTuple):
    """Starts of a block: where they are, the best they saw, how long ago."""

    point: Array  # (B, k, 3)
    optimizer: Any
    best: Array  # (B,) penalised objective
    best_point: Array
    waited: Array  # (B,) steps since it improved enough
    steps: Array
    alive: Array


def _total_excess(
    requirements: tuple[Requirement, ...], surface: Surface, position: Array, normal: Array
) -> Array:
    total = jnp.zeros(position.shape[:-2], position.dtype)
    for requirement in requirements:
        total = total + requirement.excess(surface, position, normal) ** 2
    there = total > 0
    return jnp.where(there, jnp.sqrt(jnp.where(there, total, 1.0)), 0.0)


def _scores(objective: Objective, model: ContactModel, requirements, surface: Surface, point: Array) -> Array:
    """(B,) objective less the penalty at points (B, k, 3) near the surface."""
    position, normal = surface.contact(point)
    value = objective(Grasp(position - surface.centre, normal, model))
    excess = _total_excess(requirements, surface, position, normal) / surface.radius
    return value - PENALTY * excess * excess


@functools.lru_cache(maxsize=16)
def _climber(objective: Objective, optimizer: optax.GradientTransformation, requirements, steps: int):
    """A block of starts taken uphill, compiled once for each objective, optimiser and set of requirements."""

    @jax.jit
    def climb(surface: Surface, model: ContactModel, point: Array) -> _State:
        def total(point: Array) -> tuple[Array, Array]:
            scores = _scores(objective, model, requirements, surface, point)
            return -jnp.sum(jnp.where(jnp.isfinite(scores), scores, 0.0)), scores

        def step(state: _State) -> _State:
            (_, scores), slope = jax.value_and_grad(total, has_aux=True)(state.point)
            good = jnp.isfinite(scores) & jnp.all(jnp.isfinite(slope), axis=(1, 2))
            much = scores > state.best + IMPROVEMENT * jnp.abs(state.best)
            better = state.alive & good & (scores > state.best)
            best_point = jnp.where(better[:, None, None], state.point, state.best_point)
            waited = jnp.where(much & good, 0, state.waited + 1)
            alive = state.alive & good & (waited < PATIENCE)
            slope = jnp.where(alive[:, None, None], slope, 0.0)
            with jax.numpy_dtype_promotion("standard"):  # optax mixes integers and floats
                move, optimizer_state = optimizer.update(slope, state.optimizer, state.point)
            moved = surface.project(state.point + move.astype(state.point.dtype))  # pyright: ignore
            moved = jnp.where(alive[:, None, None] & jnp.isfinite(moved), moved, state.point)
            best = jnp.where(better, scores, state.best)
            return _State(
                moved, optimizer_state, best, best_point, waited, state.steps + alive.astype(jnp.int32), alive
            )

        count = point.shape[0]
        start = _State(
            point, optimizer.init(point), jnp.full(count, -jnp.inf, point.dtype), point,
            jnp.zeros(count, jnp.int32), jnp.zeros(count, jnp.int32), jnp.ones(count, bool),
        )  # fmt: skip

        def unfinished(carry: tuple[Array, _State]) -> Array:
            return (carry[0] <= steps) & jnp.any(carry[1].alive)

        return lax.while_loop(unfinished, lambda c: (c[0] + 1, step(c[1])), (jnp.int32(0), start))[1]

    return climb


def _draw(
    surface: Surface, fingers: int, requirements, seed: int, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Random contacts (count, k, 3) and normals within the requirements where they can be found."""
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    spare: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    limit = SLACK * float(surface.radius)
    total = 0
    for round_ in range(DRAWS if requirements else 1):
        # A number of its own for each round, from the seed alone.
        number = int(np.random.SeedSequence([seed, round_]).generate_state(1, np.uint32)[0])
        point, normal = surface.sample(number, count * fingers)
        point, normal = point.reshape(count, fingers, 3), normal.reshape(count, fingers, 3)
        excess = np.zeros(count)
        if requirements:
            excess = np.asarray(_total_excess(requirements, surface, jnp.asarray(point), jnp.asarray(normal)))
        good = excess <= limit
        kept.append((point[good], normal[good]))
        spare.append((point[~good], normal[~good], excess[~good]))
        total += int(good.sum())
        if total >= count:
            break
    point, normal = (np.concatenate(x) for x in zip(*kept, strict=True))
    if total < count:  # the least bad ones: the optimiser may bring them in
        more = [np.concatenate(x) for x in zip(*spare, strict=True)]
        order = np.argsort(np.where(np.isfinite(more[2]), more[2], np.inf), kind="stable")[: count - total]
        if total == 0 and (not len(order) or more[2][order[0]] > float(surface.radius)):
            raise UserError(
                "no contact on this surface meets the requirements: the region is empty or misses it"
            )
        point, normal = np.concatenate([point, more[0][order]]), np.concatenate([normal, more[1][order]])
    return point[:count], normal[:count]


def _starts(surface, fingers, model, requirements, seed, starts) -> tuple[np.ndarray, np.ndarray]:
    """Points (S, k, 3), each the best of a few random grasps by its margin, and those margins."""
    point, normal = _draw(surface, fingers, requirements, seed, starts * CANDIDATES)
    grasp = Grasp(point - np.asarray(surface.centre), normal, model)
    value = np.asarray(margin(grasp)).reshape(starts, CANDIDATES)
    value = np.where(np.isfinite(value), value, -np.inf)
    chosen = value.argmax(axis=1)
    row = np.arange(starts)
    return point.reshape(starts, CANDIDATES, fingers, 3)[row, chosen], value[row, chosen]


def _exactly(surface: Surface, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Contacts as they are on the real surface: a mesh's triangles and face normals."""
    if isinstance(surface, MeshSurface):
        near = surface.project_exact(point)
        return near.point, near.normal
    position, normal = surface.contact(point)
    return np.asarray(position), np.asarray(normal)


def _distinct(position: np.ndarray, order: np.ndarray, most: int, apart: float) -> list[int]:
    """The first ``most`` of ``order`` whose contacts, matched as well as possible, are ``apart`` from all before."""
    chosen: list[int] = []
    orders = [list(p) for p in permutations(range(position.shape[1]))] if position.shape[1] <= 5 else [None]
    for i in order:
        if len(chosen) == most:
            break
        others = position[chosen]
        gaps = [
            np.linalg.norm((others if p is None else others[:, p]) - position[i], axis=-1).max(axis=-1)
            for p in orders
        ]
        if not chosen or np.min(gaps, axis=0).min() > apart:
            chosen.append(int(i))
    return chosen


def place_contacts(
    surface: Surface,
    fingers: int = 3,
    model: ContactModel | None = None,
    objective: Objective = margin,
    starts: int = 256,
    steps: int = 150,
    optimizer: optax.GradientTransformation | None = None,
    requirements: Sequence[Requirement] = (),
    best: int = 16,
    distinct: float = 0.1,
    seed: int = 0,
    progress: Callable[[PlacementProgress], None] | None = None,
) -> Placement:
    """``max q(grasp)`` over contacts on a surface, by gradients from many random starts; the best distinct grasps.

    surface       where the contacts are (``surfaces.of("mug")``, a mesh, a shape)
    fingers       k, contacts of a grasp
    model         their contact model, by default ``HardFinger(0.5)``: one number each, or one per contact (k,)
    objective     q: a differentiable function of a batch of grasps to (*batch,), such as the margin (default) or
                  ``lambda g: jg.epsilon_quality(g, tolerance=0.1).upper``
    starts        random starts, each the best of 8 random grasps by its margin
    steps         of the optimiser at most; a start that no longer improves ends earlier
    optimizer     an optax optimiser over points in m; by default Adam whose rate falls from 5 % of the radius
    requirements  ``Apart``, ``Within``, ``Beyond``, ``EdgeClearance``, ``JawWidth`` or your own ``Requirement``
    best          grasps to return at most, each ``distinct`` (of the radius) away from every better one
    seed          the same seed gives the same grasps
    progress      called with a ``PlacementProgress`` after every block of starts

    UserError where no contact can meet the requirements; ValueError for wrong arguments. NaN in the objective ends
    its own start alone.
    """
    if not isinstance(surface, Surface):
        raise ValueError(
            f"surface must be a jaxgrasp.surfaces.Surface such as surfaces.of('mug'), got {surface!r}"
        )
    for name, value in (("fingers", fingers), ("starts", starts), ("steps", steps), ("best", best)):
        if not isinstance(value, int | np.integer) or value < 1:
            raise ValueError(f"{name} must be an integer of 1 or more, got {value!r}")
    if not all(isinstance(r, Requirement) for r in requirements):
        raise ValueError("requirements must be jaxgrasp.requirements such as Apart(0.02)")
    model = HardFinger(0.5) if model is None else model
    if optimizer is None:
        optimizer = _default_optimizer(float(surface.radius), steps)
    asked = tuple(requirements)
    origin, before = _starts(surface, fingers, model, asked, seed, starts)
    climb = _climber(objective, optimizer, asked, steps)
    ends, taken = [], []
    for first in range(0, starts, BLOCK):
        block = origin[first : first + BLOCK]
        missing = BLOCK - len(block)
        padded = np.concatenate([block, np.repeat(block[:1], missing, axis=0)])
        state = climb(surface, model, jnp.asarray(padded, surface.centre.dtype))
        ends.append(np.asarray(state.best_point)[: len(block)])
        taken.append(np.asarray(state.steps)[: len(block)])
        if progress is not None:
            top = float(np.max(np.asarray(state.best)[: len(block)]))
            progress(PlacementProgress(min(first + BLOCK, starts), starts, top))
    return _judged(
        surface, model, objective, asked, np.concatenate(ends), before, np.concatenate(taken), best, distinct
    )


@functools.lru_cache(maxsize=16)
def _default_optimizer(radius: float, steps: int) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(0.05 * radius, steps, alpha=0.02))


def _judged(surface, model, objective, asked, end, before, steps, best, distinct) -> Placement:
    """Exact contacts, verdicts and proofs of all starts; the best distinct ones among those within the requirements."""
    position, normal = _exactly(surface, end)
    grasp = Grasp(position - np.asarray(surface.centre), normal, model)
    verdict = wrench_resistance(grasp)
    proved = check_certificate(grasp, verdict)
    value = np.asarray(objective(grasp))
    excess = np.asarray(_total_excess(asked, surface, jnp.asarray(position), jnp.asarray(normal)))
    allowed = np.isfinite(value) & (excess <= SLACK * float(surface.radius))
    order = np.flatnonzero(allowed)
    order = order[np.argsort(-value[order], kind="stable")]
    chosen = np.array(_distinct(position, order, best, distinct * float(surface.radius)), int)
    resistant = (np.asarray(verdict.status) == Status.RESISTANT) & proved
    return Placement(
        grasp[chosen], position[chosen], value[chosen], chosen, jax.tree.map(lambda x: x[chosen], verdict),
        proved[chosen], before, np.asarray(verdict.margin), resistant, steps, excess,
    )  # fmt: skip
