"""Answers damaged on purpose, field by field, and whether what they then say is false: decided without the checker.

``changes`` are the ways to damage the numbers of a field, each for all lanes at once; ``malformed`` those that leave no
answer at all. ``Kind.false`` says lane by lane whether the damaged answer is false by clearly more than rounding: True,
or False where it is still true or cannot be told.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Kind", "attack", "attack_problem", "attack_shapes", "changes", "malformed", "replaced"]

SHARED = ("norm",)  # fields of all lanes together
NO_NORM = ("L2", "", None, 1, np.array(["L1", "L1"]), ["L1"], b"L1", [[1.0], [1.0, 2.0]])

CLEAR = 1e-6  # what is false by less may be rounding


class Kind(NamedTuple):
    """Answers of one kind, N lanes.

    check   (answer) -> (N,) bool, the checker with the problem that was asked
    false   (answer, field) -> (N,) bool: false by more than rounding; what ``field`` says, the others as they were
    others  (name, check, false (N,)) of other problems than the one that was asked
    """

    name: str
    answer: Any
    fields: tuple[str, ...]
    check: Callable[[Any], np.ndarray]
    false: Callable[[Any, str], np.ndarray]
    others: tuple[tuple[str, Callable[[Any], np.ndarray], np.ndarray], ...] = ()


def replaced(answer: Any, **fields: Any) -> Any:
    """The answer with other fields, whatever they are."""
    out = copy.copy(answer)
    for name, value in fields.items():
        object.__setattr__(out, name, value)
    return out


def _flipped(x: np.ndarray, bit: int) -> np.ndarray:
    whole = np.array(x, np.float64)
    return (whole.view(np.uint64) ^ np.uint64(1 << bit)).view(np.float64)


def changes(value: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[str, np.ndarray]]:
    """Names and damaged copies of the numbers of a field (N, ..)."""
    x = np.asarray(value)
    if x.dtype.kind in "iu":
        for shift in (-2, -1, 1, 2, 3):
            yield f"{shift:+d}", x + shift
        yield "sign", -x
        yield "other lane", np.roll(x, 1, axis=0)
        yield "2^31 - 1", np.full_like(x, 2**31 - 1)
        yield "any", rng.integers(-1, 30, x.shape).astype(x.dtype)
        return
    with np.errstate(all="ignore"):
        yield "sign", -x
        yield "zero", 0.0 * np.nan_to_num(x)
        for scale in (1e-300, 1e-150, 1e-30, 1e-9, 0.5, 0.99, 1.01, 2.0, 1e9, 1e30, 1e150, 1e300):
            yield f"times {scale:g}", x * scale
        for name, odd in (("NaN", np.nan), ("inf", np.inf), ("-inf", -np.inf)):
            yield name, np.full_like(x, odd)
        if x.ndim > 1:
            one = rng.integers(x.shape[1], size=len(x))
            for name, odd in (("one NaN", np.nan), ("one inf", np.inf), ("one 1e200", 1e200)):
                y = x.copy()
                y[np.arange(len(x)), one] = odd
                yield name, y
            yield "components turned round", np.roll(x, 1, axis=1)
        yield "plus 0.1", x + 0.1
        yield (
            "plus noise",
            x + 0.1 * rng.normal(size=x.shape) * np.max(np.abs(np.nan_to_num(x)), initial=1e-3),
        )
        for bit in (51, 48, 45, 40, 54):
            yield f"bit {bit}", _flipped(x, bit)
        for shift in (1, 2, 3):
            yield f"lane {shift} on", np.roll(x, shift, axis=0)


def malformed(value: Any) -> Iterator[tuple[str, Any]]:
    """What is no field at all: every lane must be refused, and nothing may be raised."""
    x = np.asarray(value)
    yield "one axis more", x[None]
    yield "one axis less", x.reshape(-1)[0] if x.size else np.zeros((3, 3))
    if x.ndim:
        yield "one lane more", np.concatenate([x, x[:1]])
        yield "no lane", x[:0]
    yield "complex", x.astype(complex)
    yield "objects", x.astype(object)
    yield "text", x.astype(str)
    yield "dates", np.zeros(x.shape, "datetime64[s]")
    yield "ragged", [[1.0], [1.0, 2.0]]
    yield "a word", "RESISTANT"
    yield "None", None
    yield "bool", x.astype(bool)
    yield "a dict", {"a": 1}


def damage(kind: Kind, field: str, rng: np.random.Generator) -> Iterator[tuple[str, Any]]:
    """The damaged answers of one field."""
    if field in SHARED:
        other = {"L1": "Linf", "Linf": "L1"}[getattr(kind.answer, field)]
        yield "another", replaced(kind.answer, **{field: other})
        return
    for name, value in changes(getattr(kind.answer, field), rng):
        yield name, replaced(kind.answer, **{field: value})


def attack(kind: Kind, field: str, rng: np.random.Generator) -> tuple[dict[str, Counter], list[str]]:
    """Counts by the name of the change; the holes, as text."""
    counts, holes = {}, []
    before = kind.check(kind.answer)
    for name, said in damage(kind, field, rng):
        changed = getattr(said, field) if field in SHARED else np.asarray(getattr(said, field))
        if field not in SHARED:
            old = np.asarray(getattr(kind.answer, field))
            same = (changed == old) | ((changed != changed) & (old != old))
            same = same.reshape(len(before), -1).all(-1)
        else:
            same = np.zeros(len(before), bool)
        try:
            accepted = kind.check(said)
        except Exception as error:
            holes.append(f"{kind.name}, {field}, {name}: {type(error).__name__}: {error}")
            continue
        false = kind.false(said, field) & ~same & before
        tried = ~same & before
        counts[name] = _counted(tried, false, accepted)
        holes += [f"{kind.name}, {field}, {name}, lane {i}" for i in np.flatnonzero(false & accepted)]
    return counts, holes


def attack_shapes(kind: Kind, field: str) -> tuple[Counter, list[str]]:
    """Fields that are none: all lanes refused, nothing raised."""
    counts, holes = Counter(), []
    damaged = malformed(getattr(kind.answer, field)) if field not in SHARED else enumerate(NO_NORM)
    for name, value in [*damaged, ("missing", None)]:
        said = replaced(kind.answer, **{field: value})
        if name == "missing":
            object.__delattr__(said, field)
        counts["tried"] += 1
        counts["false"] += 1
        try:
            refused = not np.any(kind.check(said))
        except Exception as error:  # a hole like any other
            refused, name = False, f"{name}: {type(error).__name__}"
        counts["refused of the false"] += refused
        holes += [] if refused else [f"{kind.name}, {field}, {name}"]
    return counts, holes


def attack_problem(kind: Kind) -> tuple[dict[str, Counter], list[str]]:
    """The answers as they are, to other problems."""
    counts, holes, before = {}, [], kind.check(kind.answer)
    for name, check, false in kind.others:
        accepted = check(kind.answer)
        counts[name] = _counted(before, false & before, accepted)
        holes += [f"{kind.name}, {name}, lane {i}" for i in np.flatnonzero(false & before & accepted)]
    return counts, holes


def _counted(tried: np.ndarray, false: np.ndarray, accepted: np.ndarray) -> Counter:
    return Counter({
        "tried": int(tried.sum()), "false": int(false.sum()),
        "refused of the false": int((false & ~accepted).sum()),
        "still true or undecided": int((tried & ~false).sum()),
        "of these refused": int((tried & ~false & ~accepted).sum()),
    })  # fmt: skip
