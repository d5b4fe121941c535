"""Contacts moved over a surface by gradients until the grasp is good, many starts at once.

    maximise  q(G(x(p)))  -  weight * sum of squared excesses,     x(p) the projection of p onto the surface

q is any differentiable function of a ``Grasp``: the margin by default. A start is the best of many random grasps,
which cost little to screen; its contacts climb the guide of q (the margin, for most), and from there q itself. On a
mesh they are then put exactly onto the triangles, with the faces' own normals, and settle there by short random moves;
every grasp is solved and proved again. Sources: the envelope theorem for the gradient; Zhu, Wang 2003 and Liu et al.
2021 (grasps by gradients).
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

from ..certificates import check
from ..contacts import ContactModel, Grasp, HardFinger
from ..core import Array, Float, Status, UserError
from ..resistance import WrenchResistance, wrench_resistance
from ..surfaces import Surface
from .climb import climb
from .objectives import FLOOR, Margin, Objective, lessons
from .objectives import objective as as_objective
from .requirements import SLACK, Requirement, total_excess
from .search import PlacementProgress, Search, expect_count
from .settle import settle

__all__ = ["Placement", "place_contacts"]

GROUP = 64  # starts drawn together: memory follows it, not the number of starts
DRAWS = 64  # rounds of random contacts before a region counts as empty
SHOWN = 8  # grasps in the words of a placement


@dataclass(frozen=True)
class Placement:
    """``argmax q`` over contacts on a surface: the best distinct grasps, and what became of every start.

    grasp     the grasps found, best first (n of them), positions about the surface's centre in m
    position  (n, k, 3) the same contacts in the surface's own frame
    value     (n,) the objective there          start   (n,) which start each comes from
    verdict   their ``WrenchResistance``         proved  (n,) bool: the independent checker accepted it
    before, after   (starts,) margins of every start and of where it ended
    resistant (starts,) bool: ended wrench resistant, with a certificate the checker accepts
    origin, end (starts, k, 3) m: where every start began and ended, in the surface's own frame
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
    origin: np.ndarray
    end: np.ndarray
    steps: np.ndarray
    excess: np.ndarray

    def __str__(self) -> str:
        """What became of the starts in a line, then the best grasps, one a line."""
        count, held = len(self.after), int(np.sum(self.resistant))
        rose = f"median margin {np.median(self.before):.3g} before, {np.median(self.after):.3g} after"
        lines = [
            f"{len(self.value)} distinct grasps of {self.end.shape[1]} contacts from {count} starts; {held} starts "
            f"ended wrench resistant with a proof; {rose}."
        ]
        status = np.asarray(self.verdict.status)
        for i in range(min(len(self.value), SHOWN)):
            proof = "proved" if self.proved[i] else "not proved"
            lines.append(
                f"{i:4d}  value {self.value[i]:.6g}, start {self.start[i]}, {Status(status[i]).name}, {proof}"
            )
        if len(self.value) > SHOWN:
            lines.append(f"      and {len(self.value) - SHOWN} more")
        return "\n".join(lines)


def _draw(
    surface: Surface, fingers: int, requirements: Sequence[Requirement], seeds: tuple[int, int], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Random contacts (count, k, 3) and normals within the requirements where they can be found."""
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    spare: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    limit = SLACK * float(surface.radius)
    total = 0
    for round_ in range(DRAWS if requirements else 1):
        # A number of its own for each group and round, from the seed alone.
        number = int(np.random.SeedSequence([*seeds, round_]).generate_state(1, np.uint32)[0])
        point, normal = surface.sample(number, count * fingers)
        point, normal = point.reshape(count, fingers, 3), normal.reshape(count, fingers, 3)
        excess = np.zeros(count)
        if requirements:
            there = jnp.asarray(point), jnp.asarray(normal)
            excess = np.asarray(total_excess(requirements, surface.traced, *there))
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


class _Task(NamedTuple):
    """What is asked, checked."""

    surface: Surface
    fingers: int
    model: ContactModel
    requirements: tuple[Requirement, ...]
    search: Search
    tell: Callable[[PlacementProgress], None]

    def about_centre(self, position: np.ndarray, normal: np.ndarray) -> Grasp:
        return Grasp(position - np.asarray(self.surface.centre), normal, self.model)


def _starts(task: _Task, guide: Objective) -> tuple[np.ndarray, np.ndarray]:
    """Points (S, k, 3), each the best of a few random grasps by its guide, and their margins."""
    points, normals = [], []
    starts, candidates = task.search.starts, task.search.candidates
    for group, first in enumerate(range(0, starts, GROUP)):
        # Every group is drawn whole: a start does not depend on how many there are.
        count = GROUP * candidates
        seeds = (task.search.seed, group)
        point, normal = _draw(task.surface, task.fingers, task.requirements, seeds, count)
        grasp = task.about_centre(point, normal)
        value = np.asarray(guide.value(grasp, guide.begin(grasp)))
        value = np.where(np.isfinite(value), value, -np.inf).reshape(GROUP, candidates)
        row = np.arange(min(GROUP, starts - first))
        chosen = row * candidates + value.argmax(axis=1)[row]
        points.append(point[chosen])
        normals.append(normal[chosen])
        done = first + len(row)
        task.tell(PlacementProgress("screening", done, starts, float(value[row].max())))
    origin = np.concatenate(points)
    verdict = wrench_resistance(task.about_centre(origin, np.concatenate(normals)))
    return origin, np.maximum(np.asarray(verdict.margin), FLOOR)


class _End(NamedTuple):
    """Where starts ended: points (S, k, 3) on the smooth surface, (S,) steps taken."""

    point: np.ndarray
    steps: np.ndarray


def _climbed(task: _Task, objective: Objective, origin: np.ndarray) -> _End:
    search = task.search
    end = _End(origin.copy(), np.zeros(len(origin), int))
    done, best, phase = 0, -np.inf, type(objective).__name__.lower()
    for ended in climb(
        task.surface.traced, task.model, objective, search.optimizer, task.requirements, origin, search.steps
    ):
        for one in ended:
            end.point[one.start], end.steps[one.start] = one.point, one.steps
            best = max(best, one.value)
        done += len(ended)
        task.tell(PlacementProgress(phase, done, search.starts, best))
    return end


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
    *,
    fingers: int = 3,
    model: ContactModel | None = None,
    objective: Objective | Callable[[Grasp], Float[Array, " B"]] | None = None,
    requirements: Sequence[Requirement] = (),
    search: Search | None = None,
    best: int = 16,
    progress: Callable[[PlacementProgress], None] | None = None,
) -> Placement:
    """``max q(grasp)`` over contacts on a surface, by gradients from many random starts; the best distinct grasps.

    surface       where the contacts are (``surfaces.of("mug")``, a mesh, a shape)
    fingers       k, contacts of a grasp
    model         their contact model, by default ``HardFinger(0.5)``: one number each, or one per contact (k,)
    objective     q: ``Margin()`` (default), ``Epsilon(norm, torque_scale)``, or a differentiable function of a batch of
                  grasps to (B,), such as ``lambda g: -jg.critical_friction(g).factor``. It is climbed from where the
                  climb of its ``guide`` ended, which is the margin where it names no other: most measures are flat
                  where a grasp does not hold
    requirements  ``Apart``, ``Within``, ``Beyond``, ``EdgeClearance``, ``JawWidth`` or your own ``Requirement``
    search        a ``Search``: starts, steps, candidates, settling, what is distinct, optimiser, seed
    best          grasps to return at most, each distinct from every better one
    progress      called with a ``PlacementProgress`` as starts end

    UserError where no contact can meet the requirements; ValueError for wrong arguments. NaN in the objective ends
    its own start alone. Of its ends and its beginning, a start keeps what is best on the exact surface.
    """
    if not isinstance(surface, Surface):
        raise ValueError(
            f"surface must be a jaxgrasp.surfaces.Surface such as surfaces.of('mug'), got {surface!r}"
        )
    for name, value in (("fingers", fingers), ("best", best)):
        expect_count(name, value)
    if not all(isinstance(r, Requirement) for r in requirements):
        raise ValueError("requirements must be those of jaxgrasp.placement, such as Apart(0.02)")
    search = Search() if search is None else search
    if not isinstance(search, Search):
        raise ValueError(f"search must be a jaxgrasp.placement.Search, got {search!r}")
    asked = Margin() if objective is None else as_objective(objective)
    model = HardFinger(0.5) if model is None else model
    tell = progress if progress is not None else lambda _: None
    task = _Task(surface, fingers, model, tuple(requirements), search, tell)
    guide = asked.guide()
    origin, before = _starts(task, guide)
    ends = [_climbed(task, guide, origin)]
    if type(asked) is not type(guide):
        ends.append(_climbed(task, asked, ends[0].point))
    return _judged(task, asked, origin, before, ends, best)


class _Exact(NamedTuple):
    """Contacts of S starts on the exact surface, and what they are worth there."""

    position: np.ndarray
    normal: np.ndarray
    verdict: WrenchResistance
    proved: np.ndarray
    excess: np.ndarray
    value: np.ndarray  # good enough to choose by

    @property
    def resistant(self) -> np.ndarray:
        """Wrench resistant, with a certificate the checker accepts."""
        return (np.asarray(self.verdict.status) == Status.RESISTANT) & self.proved

    def worth(self, limit: float) -> np.ndarray:
        """The value where the grasp is resistant and within ``limit`` of the requirements, elsewhere -inf."""
        held = self.resistant & (self.excess <= limit) & np.isfinite(self.value)
        return np.where(held, self.value, -np.inf)


def _exact(task: _Task, objective: Objective, position: np.ndarray, normal: np.ndarray) -> _Exact:
    grasp = task.about_centre(position, normal)
    verdict = wrench_resistance(grasp)
    there = jnp.asarray(position), jnp.asarray(normal)
    excess = np.asarray(total_excess(task.requirements, task.surface.traced, *there))
    if isinstance(objective, Margin):
        value = np.asarray(verdict.margin)
    else:  # in groups of one size, so that one program serves all
        count = len(position)
        rows = np.minimum(np.arange(-(-count // GROUP) * GROUP), count - 1).reshape(-1, GROUP)
        some = [grasp[group] for group in rows]
        value = np.concatenate([objective.value(g, lessons(objective, g)) for g in some])[:count]
    return _Exact(position, normal, verdict, check(grasp, verdict), excess, value)


def _settled(task: _Task, objective: Objective, exact: _Exact) -> _Exact:
    """Contacts after a while of random moves."""
    search = task.search
    position, normal, done, best = exact.position.copy(), exact.normal.copy(), 0, -np.inf
    for group in settle(
        task.surface, task.model, objective, task.requirements, position, normal, search.seed, search.settling
    ):
        position[group.start], normal[group.start] = group.position, group.normal
        done, best = done + len(group.start), max(best, group.best)
        task.tell(PlacementProgress("settling", done, search.starts, best))
    return _exact(task, objective, position, normal)


def _either(where: np.ndarray, a: Any, b: Any) -> np.ndarray:
    """Rows of ``a`` where ``where`` (S,), of ``b`` elsewhere."""
    return np.where(where.reshape(-1, *[1] * (a.ndim - 1)), a, b)


def _judged(
    task: _Task,
    objective: Objective,
    origin: np.ndarray,
    before: np.ndarray,
    ends: list[_End],
    best: int,
) -> Placement:
    """Exact contacts, verdicts and proofs of all starts; the best distinct ones among those within the requirements."""
    radius = float(task.surface.radius)
    limit = SLACK * radius

    def better(one: _Exact, other: _Exact) -> _Exact:
        won = one.worth(limit) > other.worth(limit)
        return jax.tree.map(functools.partial(_either, won), one, other)

    # The exact surface is not quite the smooth one: a climb may lose there what it won, and its start be better.
    exact = _exact(task, objective, *task.surface.exact_contact(ends[-1].point))
    for earlier in (*(end.point for end in ends[:-1]), origin):
        exact = better(_exact(task, objective, *task.surface.exact_contact(earlier)), exact)
    if task.search.settling and task.surface.faceted:
        exact = better(_settled(task, objective, exact), exact)
    order = np.flatnonzero(np.isfinite(exact.value) & (exact.excess <= limit))
    order = order[np.lexsort((-exact.value[order], ~exact.resistant[order]))]
    chosen = np.array(_distinct(exact.position, order, best, task.search.distinct * radius), int)
    final = np.zeros(0)
    if len(chosen):
        final = np.asarray(objective.final(task.about_centre(exact.position[chosen], exact.normal[chosen])))
    again = np.lexsort((-final, np.isnan(final)))
    chosen, final = chosen[again], final[again]
    verdict = jax.tree.map(lambda x: jnp.asarray(x[chosen]), exact.verdict)
    position, normal = exact.position[chosen], exact.normal[chosen]
    steps = np.sum([end.steps for end in ends], axis=0)
    return Placement(
        task.about_centre(position, normal), position, final, chosen, verdict, exact.proved[chosen], before,
        np.asarray(exact.verdict.margin), exact.resistant, origin, exact.position, steps, exact.excess,
    )  # fmt: skip
