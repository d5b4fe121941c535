"""Stored answers of the CPU in float64, and how an answer of another machine is judged beside them.

For each k: statuses, lower bounds of margins to 1e-11, costs to 1e-9, widths of brackets as powers of two, and one
number for the gradient of each lane, its component along a seeded direction. Positions and loads come from seeds.
What float32 cannot do on the CPU either is counted there, so that only more of it is wrong elsewhere.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from gpu_cases import (
    BLOCK,
    CRITERIA,
    INFEASIBLE,
    NOT_RESISTANT,
    OPTIMAL,
    RESISTANT,
    SILENT,
    Task,
    block,
    bracket_of,
    evidence_of,
    first_lanes,
    program_of,
    proved,
    to_host,
)

CONTACTS = (2, 3, 4, 8)
SINGLE = ("margin", "gentlest")  # also counted in float32
COUNTED = ("rejected", "contradictions", "brackets_apart")
GRADIENTS = ("margin-gradient", "gentlest-gradient", "least-norm-force-gradient")
COST_ERROR, GRADIENT_ERROR = 1e-8, 1e-6  # relative to max(1, |reference|), float64
# Rounding of a bracket's ends, relative to max(1, |end|): the library's smallest gap worth iterating for.
ROUNDING = {
    "float64": 2e4 * float(np.finfo(np.float64).eps),
    "float32": 160 * float(np.finfo(np.float32).eps),
}
MARGIN_BITS, COST_BITS = 36, 30  # kept of a stored number's mantissa: 1e-11 and 1e-9


# Storage -----------------------------------------------------------------------------------------------


def _packed(x: np.ndarray, bits: int) -> np.ndarray:
    """Rounded to ``bits``; bytes of equal weight side by side, which compresses well."""
    with np.errstate(invalid="ignore"):
        mantissa, exponent = np.frexp(x)
        rounded = np.ldexp(np.round(np.ldexp(mantissa, bits)), exponent - bits)
    kept = np.where(np.isfinite(x), rounded, x).astype("<f8")
    return np.ascontiguousarray(kept.view(np.uint8).reshape(-1, 8).T)


def _bits(task: Task) -> int:
    return COST_BITS if task.of_forces else MARGIN_BITS


def _unpacked(planes: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(planes.T).view("<f8").reshape(-1)


def _exponent(width: np.ndarray) -> np.ndarray:
    """The smallest e with ``width <= 2^e``, as int8; -128 for 0, 127 for infinite widths."""
    with np.errstate(divide="ignore"):
        e = np.ceil(np.log2(width))
    return np.clip(np.nan_to_num(e, nan=127, posinf=127, neginf=-128), -128, 127).astype(np.int8)


def _checksum(contacts: int) -> int:
    return zlib.crc32(b"".join(np.round(x * 2**20).astype("<i8").tobytes() for x in block(contacts, 0)))


def make_reference(path: Path, lanes: int, say: Callable[[str], None]) -> None:
    """Solve the first ``lanes`` of every k here, on the CPU in float64, and store the answers at ``path``."""
    if jax.default_backend() != "cpu":
        raise SystemExit("the reference is made on the CPU: set JAX_PLATFORMS=cpu")
    stored: dict[str, Any] = {"lanes": np.int64(lanes)}
    for k in CONTACTS:
        stored[f"{k}.data"] = np.int64(_checksum(k))
        for question in ("margin", *CRITERIA, *GRADIENTS):
            task = Task(question, k, "float64", lanes)
            add = _slopes if task.with_gradient else _answers
            stored |= {f"{k}.{question}.{name}": array for name, array in add(task).items()}
            say(f"reference {task.label}")
        for question in SINGLE:
            task = Task(question, k, "float32", lanes)
            stored[f"{k}.{question}.float32"] = _counts(task, Reference(stored))
            say(f"reference {task.label}")
    beside = path.with_suffix(".tmp.npz")
    np.savez_compressed(beside, **stored)
    beside.replace(path)


def _solved(task: Task, data: tuple[np.ndarray, ...], tolerances: tuple[float, ...] = (1e-8,)) -> list[Any]:
    """Answers and gradients at each tolerance, by one program; data near ``data`` from the second on."""
    run = jax.jit(lambda tolerance, *data: program_of(task, tolerance)(*data))
    noise = np.random.default_rng(3)
    solved = []
    for tolerance in tolerances:
        solved.append(to_host(run(np.asarray(tolerance, task.dtype), *data), 0, task.batch))
        data = tuple(x * (1 + 1e-11 * noise.normal(size=x.shape)) for x in data)
    return solved


def _answers(task: Task) -> dict[str, np.ndarray]:
    data = first_lanes(task, task.batch)
    ((answer, _),) = _solved(task, data)
    if not proved(task.kind, data, answer).all():
        raise SystemExit(f"{task.label}: the checker rejects an answer of this CPU; no reference")
    lower, upper = bracket_of(answer)
    with np.errstate(invalid="ignore"):
        width = np.where(lower == upper, 0.0, upper - lower)
    end = upper if task.of_forces else lower
    return {
        "status": np.asarray(answer.status, np.int8),
        "end": _packed(end, _bits(task)),
        "width": _exponent(width),
    }


def _counts(task: Task, reference: Reference) -> np.ndarray:
    """Of each of ``COUNTED``, the lanes in float32 here."""
    ((answer, _),) = _solved(task, first_lanes(task, task.batch))
    figures, _ = reference.judge(task, answer, ())
    return np.array([figures[name] for name in COUNTED], np.int32)


def _slopes(task: Task) -> dict[str, np.ndarray]:
    """NaN where a change at the level of rounding moves the derivative: kinks, and a step more or less at the end.

    Both sides stop at the same gap: a margin's derivative at a gap of 1e-8 is itself known to about 1e-6 only.
    """
    (answer, here), (_, there) = _solved(task, first_lanes(task, task.batch), (1e-8, 1.01e-8))
    slope, size = _along(task, here)
    other, _ = _along(task, there)
    regular = np.abs(slope - other) <= 0.1 * GRADIENT_ERROR * np.maximum(1, size)
    if task.of_forces:
        regular &= evidence_of(answer)[1]
    return {"slope": np.where(regular, slope, np.nan).astype(np.float32)}


def _along(task: Task, gradients: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Each lane's gradient along its seeded unit direction, and the gradient's length."""
    lanes = len(gradients[0])
    flat = np.concatenate([np.asarray(g, np.float64).reshape(lanes, -1) for g in gradients], -1)
    direction = np.random.default_rng([4, task.contacts]).normal(size=(BLOCK, flat.shape[-1]))[:lanes]
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return np.sum(direction * flat, -1), np.linalg.norm(flat, axis=-1)


# Judgement ---------------------------------------------------------------------------------------------


class Reference:
    """The stored answers; ``judge`` says what of an answer is not right."""

    def __init__(self, stored: dict[str, Any]):
        self._stored = stored
        self.lanes = int(stored["lanes"])

    @classmethod
    def read(cls, path: Path) -> Reference:
        with np.load(path) as file:
            stored = {name: file[name] for name in file.files}
        for k in CONTACTS:
            if int(stored[f"{k}.data"]) != _checksum(k):
                raise SystemExit(f"{path} was made for other grasps: make it again with --make-reference")
        return cls(stored)

    def judge(self, task: Task, answer: Any, gradients: Any) -> tuple[dict[str, Any], list[str]]:
        """Figures, and the failures in words, of an answer for the first lanes of ``task``."""
        lanes = len(answer.status)
        figures: dict[str, Any] = {"lanes": lanes}
        accepted = proved(task.kind, first_lanes(task, lanes), answer)
        figures["rejected"] = int((~accepted).sum())
        figures["silent"] = int(np.isin(answer.status, SILENT).sum())
        compare = self._forces if task.of_forces else self._margins
        figures |= compare(task, answer)
        if task.with_gradient:
            figures |= self._gradient(task, gradients)
        allowed = self._allowed(task)
        over = {name: figures[name] for name in WRONG if figures.get(name, 0) > allowed.get(name, 0)}
        return figures, [f"{WRONG[name]} in {count} lanes" for name, count in over.items()]

    def _allowed(self, task: Task) -> dict[str, int]:
        """In float32, twice what the CPU's float32 shows and a few lanes more; in float64, none."""
        counts = self._stored.get(f"{task.contacts}.{task.kind.replace('verdict', 'margin')}.float32")
        if task.dtype != "float32" or counts is None:
            return {}
        return {name: 2 * int(count) + 8 for name, count in zip(COUNTED, counts, strict=True)}

    def _entry(self, task: Task, name: str, lanes: int) -> np.ndarray:
        key = f"{task.contacts}.{task.kind.replace('verdict', 'margin')}.{name}"
        return _unpacked(self._stored[key])[:lanes] if name == "end" else self._stored[key][:lanes]

    def _brackets(self, task: Task, answer: Any) -> tuple[np.ndarray, ...]:
        """Ours and the reference's ends, and the room for rounding."""
        lanes = len(answer.status)
        lower, upper = (np.asarray(x, np.float64) for x in bracket_of(answer))
        end = self._entry(task, "end", lanes)
        width = np.ldexp(1.0, self._entry(task, "width", lanes).astype(int))
        low, high = (end - width, end) if task.of_forces else (end, end + width)
        finite = np.where(np.isfinite(end), np.abs(end), 1.0)
        room = (ROUNDING[task.dtype] + 2.0 ** -_bits(task)) * np.maximum(1, finite)
        return lower, upper, low, high, room

    def _margins(self, task: Task, answer: Any) -> dict[str, Any]:
        """Verdicts may differ where both brackets contain 0; in float32 a lane may also claim nothing there."""
        lower, upper, low, high, room = self._brackets(task, answer)
        status, wanted = np.asarray(answer.status), self._entry(task, "status", len(lower))
        ours = (lower <= room) & (upper >= -room)
        both = ours & (low <= room) & (high >= -room)
        open_here = ours & ~np.isin(status, (RESISTANT, NOT_RESISTANT)) if task.dtype == "float32" else False
        with np.errstate(invalid="ignore"):
            apart = np.maximum(lower - high, low - upper)
            gap = (upper - lower) / np.maximum(1, np.abs(lower))
        apart[(lower == low) & ~np.isfinite(low)] = 0.0
        return {
            "contradictions": int(((status != wanted) & ~both & ~open_here).sum()),
            "other_words": int((status != wanted).sum()),
            "brackets_apart": int((~(apart <= room)).sum()),
            "largest_gap": float(np.max(gap[np.isfinite(gap)], initial=0.0)),
        }

    def _forces(self, task: Task, answer: Any) -> dict[str, Any]:
        """Statuses may differ where either lane is STALLED; costs agree to 1e-8 in float64, else by brackets."""
        bound, cost, low, high, room = self._brackets(task, answer)
        status, wanted = np.asarray(answer.status), self._entry(task, "status", len(cost))
        free = np.isin(status, SILENT) | np.isin(wanted, SILENT)
        optimal = (status == OPTIMAL) & (wanted == OPTIMAL)
        with np.errstate(invalid="ignore"):
            apart = np.maximum(bound - high, low - cost)
            error = np.abs(cost - high) / np.maximum(1, np.abs(high))
        figures = {
            "contradictions": int(((status != wanted) & ~free).sum()),
            "other_words": int((status != wanted).sum()),
            "optimal": int(optimal.sum()),
            "infeasible": int((status == INFEASIBLE).sum()),
            "brackets_apart": int((~(apart <= room) & optimal).sum()),
            "largest_cost_error": float(np.max(error[optimal], initial=0.0)),
        }
        if task.dtype == "float64":
            figures["costs_off"] = int((~(error <= COST_ERROR) & optimal).sum())
        return figures

    def _gradient(self, task: Task, gradients: Any) -> dict[str, Any]:
        slope, size = _along(task, gradients)
        wanted = self._stored[f"{task.contacts}.{task.question}.slope"][: len(slope)].astype(np.float64)
        compared = np.isfinite(wanted)
        with np.errstate(invalid="ignore"):
            error = np.abs(slope - wanted) / np.maximum(1, size)
        figures: dict[str, Any] = {
            "gradients_not_finite": int((~np.isfinite(size)).sum()),
            "gradients_compared": int(compared.sum()),
            "median_gradient_error": float(np.median(error[compared])) if compared.any() else 0.0,
            "largest_gradient_error": float(np.max(error[compared], initial=0.0)),
        }
        if task.dtype == "float64":
            figures["gradients_off"] = int((~(error <= GRADIENT_ERROR) & compared).sum())
        return figures


WRONG = {
    "rejected": "the checker rejects the answer",
    "contradictions": "the status contradicts the reference",
    "brackets_apart": "the bracket lies beside the reference's",
    "costs_off": f"the cost is off by more than {COST_ERROR:g}",
    "gradients_off": f"the gradient is off by more than {GRADIENT_ERROR:g}",
    "gradients_not_finite": "the gradient is not finite",
}
