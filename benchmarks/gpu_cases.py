"""What the GPU check asks: seeded grasps and loads, one program for each question, its answers and their proofs.

Grasps lie on a grid of 2^-10, so that float32 and float64 get the same numbers, and are drawn in blocks, so that the
first lanes are the same in every batch.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxgrasp as jg

GRID = 2.0**-10
BLOCK = 4096  # lanes drawn at once; the reference holds the first block
FRESH = 32  # blocks that differ; larger batches repeat them


class Task(NamedTuple):
    """One question on one batch. ``question`` is "margin", "verdict" or a criterion, then perhaps "-gradient"."""

    question: str
    contacts: int
    dtype: str
    batch: int

    @property
    def label(self) -> str:
        return f"{self.question}-k{self.contacts}-{self.dtype}-{self.batch}"

    @property
    def kind(self) -> str:
        """The question without its derivative."""
        return self.question.removesuffix("-gradient").removesuffix("-force")

    @property
    def with_gradient(self) -> bool:
        return self.question.endswith("-gradient")

    @property
    def of_forces(self) -> bool:
        return self.kind in CRITERIA


# The library's public face: every use of it is in this section ---------------------------------------------

CRITERIA: dict[str, Callable[[], jg.forces.Criterion]] = {
    "gentlest": jg.Gentlest,
    "robust": jg.Robust,
    "smallest-sum": jg.SmallestSum,
    "sum-of-squares": jg.SumOfSquares,
    "least-norm": jg.LeastNorm,
}
RESISTANT, NOT_RESISTANT = jg.Status.RESISTANT.value, jg.Status.NOT_RESISTANT.value
OPTIMAL, INFEASIBLE = jg.Status.OPTIMAL.value, jg.Status.INFEASIBLE.value
SILENT = (jg.Status.UNDECIDED.value, jg.Status.STALLED.value)  # claim nothing
WORDS = {status.value: status.name for status in jg.Status}


def grasp_of(data: tuple[Any, ...]) -> jg.Grasp:
    return jg.Grasp(data[0], data[1], jg.HardFinger(data[2]))


def answer_of(kind: str, data: tuple[Any, ...], tolerance: Any = 1e-8) -> Any:
    """The library's answer, batch axis in front; ``data`` is position, normal, friction and, for forces, load."""
    if kind in CRITERIA:
        return jg.optimize_forces(grasp_of(data), data[3], criterion=CRITERIA[kind](), tolerance=tolerance)
    return jg.wrench_resistance(grasp_of(data), tolerance=tolerance, verdict_only=kind == "verdict")


def bracket_of(answer: Any) -> tuple[Any, Any]:
    """Proven lower and upper bound of the margin or of the cost."""
    return answer.lower, answer.upper


def evidence_of(answer: Any) -> tuple[Any, Any]:
    """Forces (N, k n), and whether their derivatives exist (N,)."""
    return answer.force, answer.smooth


def proved(kind: str, data: tuple[np.ndarray, ...], answer: Any) -> np.ndarray:
    """(N,) bool: the independent checker accepts the answer of each lane."""
    asked = {"wrench": data[3], "criterion": CRITERIA[kind]()} if kind in CRITERIA else {}
    return np.asarray(jg.check(grasp_of(data), answer, **asked))


# Data --------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=256)
def block(contacts: int, number: int) -> tuple[np.ndarray, ...]:
    """Hard fingers on the unit sphere with tilted normals, one mu a grasp, and a load; float64 on the grid.

    Two loads of three are the opposite of forces inside the cones, so that they can be balanced; the third is random.
    """
    rng = np.random.default_rng([2, contacts, number])
    position = rng.normal(size=(BLOCK, contacts, 3))
    position = _on_grid(position / np.linalg.norm(position, axis=-1, keepdims=True))
    normal = _on_grid(-position + 0.15 * rng.normal(size=position.shape))
    friction = _on_grid(rng.uniform(0.3, 0.8, size=(BLOCK, 1)) * np.ones((BLOCK, contacts)))
    inward = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    tangent = rng.normal(size=position.shape)
    tangent -= np.sum(tangent * inward, -1, keepdims=True) * inward
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    share = rng.uniform(0.0, 0.9, size=(BLOCK, contacts, 1)) * friction[..., None]
    force = _on_grid(rng.uniform(0.2, 0.8, size=(BLOCK, contacts, 1)) * (inward + share * tangent))
    moment = np.cross(position, force)
    balanced = -np.concatenate([force.sum(1), moment.sum(1)], -1)
    random = _on_grid(rng.normal(size=(BLOCK, 6)) * [1, 1, 1, 0.3, 0.3, 0.3])
    load = np.where(np.arange(BLOCK)[:, None] % 3 == 0, random, balanced)
    return position, normal, friction, load


def _on_grid(x: np.ndarray) -> np.ndarray:
    return np.round(x / GRID) * GRID


def first_lanes(task: Task, lanes: int) -> tuple[np.ndarray, ...]:
    """The first ``lanes`` (at most ``BLOCK``) of every batch of this task, in its dtype."""
    data = block(task.contacts, 0)[: 4 if task.of_forces else 3]
    return tuple(x[:lanes].astype(task.dtype) for x in data)


def batch_data(task: Task) -> tuple[jax.Array, ...]:
    """The whole batch on the device."""
    count = min(-(-task.batch // BLOCK), FRESH)
    parts = [block(task.contacts, number)[: 4 if task.of_forces else 3] for number in range(count)]
    repeats = -(-task.batch // (count * BLOCK))

    def whole(*pieces: np.ndarray) -> jax.Array:
        base = jnp.asarray(np.concatenate(pieces).astype(task.dtype))
        return jnp.tile(base, (repeats,) + (1,) * (base.ndim - 1))[: task.batch]

    return tuple(whole(*pieces) for pieces in zip(*parts, strict=True))


# Programs ----------------------------------------------------------------------------------------------


def program_of(task: Task, tolerance: Any = 1e-8) -> Callable[..., tuple[Any, Any]]:
    """``(answer, gradients)`` of position, normal, friction (, load); gradients are () without derivative."""

    def plain(*data: Any) -> tuple[Any, Any]:
        return answer_of(task.kind, data, tolerance), ()

    def total(*data: Any) -> tuple[Any, Any]:
        answer = answer_of(task.kind, data, tolerance)
        return jnp.sum(_differentiated(task, answer)), answer

    def both(*data: Any) -> tuple[Any, Any]:
        every = tuple(range(len(data)))
        (_, answer), gradients = jax.value_and_grad(total, argnums=every, has_aux=True)(*data)
        return answer, gradients

    return both if task.with_gradient else plain


def _differentiated(task: Task, answer: Any) -> Any:
    """What is summed over the batch before it is differentiated: margin, cost, or the square of the forces."""
    if task.question.endswith("-force-gradient"):
        force, smooth = evidence_of(answer)
        return jnp.where(smooth[:, None], force * force, jnp.zeros_like(force))
    lower, upper = bracket_of(answer)
    value = upper if task.of_forces else lower
    counted = jnp.isfinite(value)
    if task.of_forces:
        counted = counted & (answer.status == OPTIMAL)
    return jnp.where(counted, value, jnp.zeros_like(value))


def to_host(tree: Any, start: int, lanes: int) -> Any:
    """Lanes ``start`` to ``start + lanes`` as NumPy arrays."""
    return jax.tree.map(lambda x: np.asarray(x[start : start + lanes]), tree)
