"""Wrench resistance where solvers break: how many lanes stay undecided, and how many answers the checker refuses.

    python benchmarks/adversarial.py [--json FILE] [--markdown FILE] [--count 1000000] [--precisions float64 float32]

Equal shares of every kind of grasp: those of ``tests/tables/grasps.py``, contacts that nearly coincide, no friction,
very little of it, and friction within 1e-3 to 1e-9 of the critical one. Each share goes through the five contact
models (frictionless, hard and soft in space; frictionless and hard in the plane), 1 to 16 contacts, and scales from
1e-6 to 1e6 m. A lane is undecided in earnest where its status is UNDECIDED and the margin is more than 1e-6 from 0.
Float32 lanes are the float64 ones, rounded; their brackets are compared with those of the rounded numbers in float64,
where both are proved exactly.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
import zlib
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "tables"))

import jax
import numpy as np
from figures import parser_of_tables, write_table

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402

grasps: Any = importlib.import_module("grasps")
KINDS, random_contacts, random_coefficients = grasps.KINDS, grasps.random_contacts, grasps.random_coefficients
MORE = ("near duplicate", "no friction", "little friction", "near critical")
SHAPES = (2, 4, 8, 16)  # contacts, padding included: the active ones are 1 to 16
EARNEST = 1e-6  # margins nearer to 0 may stay undecided
CHUNK = 16384


class Model(NamedTuple):
    """A contact model in space or in the plane."""

    name: str
    dimension: int

    def grasp(self, position, normal, friction, torsion, active) -> jg.Grasp:
        models = {
            "frictionless": lambda: jg.Frictionless(),
            "hard": lambda: jg.HardFinger(friction),
            "soft": lambda: jg.SoftFinger(friction, torsion),
        }
        return jg.Grasp(position, normal, models[self.name](), active)


MODELS = tuple(
    Model(*x) for x in (("frictionless", 3), ("hard", 3), ("soft", 3), ("frictionless", 2), ("hard", 2))
)


def draw(kind: str, model: Model, width: int, count: int, chunk: int = 0) -> tuple[np.ndarray, ...]:
    """Position, normal, friction, torsion and mask of ``count`` grasps of one kind, float64."""
    rng = np.random.default_rng([zlib.crc32(f"{kind} {model} {width}".encode()), chunk])
    if kind in KINDS:
        position, normal = _of_kind(rng, kind, count, width, model.dimension)
    else:
        position, normal, _ = random_contacts(rng, count, width, model.dimension)
    friction, torsion = random_coefficients(rng, count, width)
    if kind == "near duplicate":
        apart = 10 ** rng.uniform(-15, -3, (count, 1))
        position[:, 1] = position[:, 0] + apart * rng.normal(size=position[:, 0].shape)
        normal[:, 1] = normal[:, 0] + apart * rng.normal(size=position[:, 0].shape)
    elif kind == "no friction":
        friction, torsion = 0 * friction, 0 * torsion
    elif kind == "little friction":
        friction = 10 ** rng.uniform(-6, -3, (count, 1)) * np.ones((count, width))
        torsion = torsion * friction
    least = width // 2 + 1 if width > 2 else 1
    active = np.arange(width) < rng.integers(least, width + 1, (count, 1))
    if kind == "near critical":
        friction = _near_critical(rng, model, position, normal, friction, torsion, active)
    scale = 10 ** rng.uniform(-6, 6, (count, 1))
    return scale[..., None] * position, normal, friction, scale * torsion, active


def _of_kind(rng, kind: str, count: int, k: int, dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """``random_contacts`` until there are ``count`` of one kind."""
    found: list[tuple[np.ndarray, np.ndarray]] = []
    while sum(len(p) for p, _ in found) < count:
        position, normal, kinds = random_contacts(rng, 12 * count, k, dimension)
        here = kinds == KINDS.index(kind)
        found.append((position[here], normal[here]))
    position, normal = (np.concatenate(x)[:count] for x in zip(*found, strict=True))
    return position, normal


def _near_critical(rng, model: Model, position, normal, friction, torsion, active) -> np.ndarray:
    """mu of a grasp that needs friction, next to what it needs: |mu / mu* - 1| from 1e-3 to 1e-9."""
    if model.name == "frictionless":
        return friction
    friction = np.where(friction > 0, friction, 0.3)
    factor = np.asarray(jg.critical_friction(model.grasp(position, normal, friction, torsion, active)).factor)
    needs = (factor > 0) & np.isfinite(factor)
    off = 10 ** rng.uniform(-9, -3, len(factor)) * rng.choice([-1.0, 1.0], len(factor))
    return friction * np.where(needs, factor * (1 + off), 1.0)[:, None]


class Tally(NamedTuple):
    """Counts over the lanes of one row."""

    lanes: int = 0
    resistant: int = 0
    not_resistant: int = 0
    marginal: int = 0
    undecided: int = 0
    earnest: int = 0
    exactly: int = 0
    to_rounding: int = 0
    refused: int = 0
    refused_marginal: int = 0
    contradicted: int = 0

    def __add__(self, other: Any) -> Tally:
        return Tally(*(a + b for a, b in zip(self, other, strict=True)))


def tally(grasp: jg.Grasp) -> Tally:
    """One chunk's counts; in float32 the same numbers are solved in float64 beside it."""
    answer = jg.wrench_resistance(grasp)
    status = np.asarray(answer.status)
    lower, upper = np.asarray(answer.lower, np.float64), np.asarray(answer.upper, np.float64)
    near_zero = np.minimum(np.abs(lower), np.abs(upper)) <= EARNEST
    near_zero |= (lower < 0) & (upper > 0) & (np.abs(lower) <= EARNEST)
    proof = jg.prove(grasp, answer).status
    accepted = proof != jg.Status.REFUSED
    contradicted = 0
    if grasp.dtype == np.float32:
        wide = jax.tree.map(lambda x: x if x.dtype == bool else x.astype(np.float64), grasp)
        exact = jg.wrench_resistance(wide)
        # A proof to rounding speaks of other numbers.
        both = (proof == jg.Status.PROVED_EXACTLY) & (
            jg.prove(wide, exact).status == jg.Status.PROVED_EXACTLY
        )
        apart = (lower > np.asarray(exact.upper)) | (upper < np.asarray(exact.lower))
        contradicted = int((both & apart).sum())
    is_ = {s: status == s.value for s in jg.Status}
    marginal, undecided = is_[jg.Status.MARGINAL], is_[jg.Status.UNDECIDED]
    return Tally(
        len(status),
        int(is_[jg.Status.RESISTANT].sum()),
        int(is_[jg.Status.NOT_RESISTANT].sum()),
        int(marginal.sum()),
        int(undecided.sum()),
        int((undecided & ~near_zero).sum()),
        int((proof == jg.Status.PROVED_EXACTLY).sum()),
        int((proof == jg.Status.PROVED_TO_ROUNDING).sum()),
        int((~accepted).sum()),
        int((~accepted & marginal).sum()),
        contradicted,
    )


def measure(kind: str, dtype: str, count: int) -> tuple[Tally, dict[str, int]]:
    """All models and numbers of contacts of one kind; undecided in earnest by model and shape beside it."""
    total, parts = Tally(), {}
    share = -(-count // (len(MODELS) * len(SHAPES)))
    for model in MODELS:
        for width in SHAPES:
            here = Tally()
            for chunk, start in enumerate(range(0, share, CHUNK)):
                data = draw(kind, model, width, CHUNK if share > CHUNK else share, chunk)
                data = tuple(
                    x[: share - start] if x.dtype == bool else x[: share - start].astype(dtype) for x in data
                )
                here += tally(model.grasp(*data))
            total += here
            if here.earnest:
                parts[f"{model.name} {model.dimension}D k<={width}"] = here.earnest
    return total, parts


def markdown(rows: dict[str, Tally]) -> str:
    """One table, a kind a row, counts as shares where they are small."""
    lines = ["| kind | " + " | ".join(x.replace("_", " ") for x in Tally._fields) + " | earnest % |"]
    lines.append("| --- |" + " ---: |" * (len(Tally._fields) + 1))
    for kind, row in rows.items():
        share = 100 * row.earnest / max(row.lanes, 1)
        lines.append(f"| {kind} | " + " | ".join(str(x) for x in row) + f" | {share:.4f} |")
    return "\n".join(lines)


def main() -> None:
    """Measure, print, write."""
    parser = parser_of_tables(__doc__)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--precisions", nargs="+", default=["float64", "float32"])
    parser.add_argument("--kinds", nargs="+", default=[*KINDS, *MORE])
    options = parser.parse_args()
    figures: dict[str, Any] = {}
    texts = []
    for dtype in options.precisions:
        start, rows, where = time.perf_counter(), {}, {}
        for kind in options.kinds:
            rows[kind], where[kind] = measure(kind, dtype, options.count // len(options.kinds))
            print(dtype, kind, rows[kind], where[kind], flush=True)
        rows["all"] = sum(rows.values(), Tally())
        texts.append(f"{dtype}\n\n{markdown(rows)}")
        print(f"\n{texts[-1]}\n{time.perf_counter() - start:.0f} s\n", flush=True)
        figures[dtype] = {"rows": {k: v._asdict() for k, v in rows.items()}, "earnest": where}
    write_table(options, "\n\n".join(texts), **figures)


if __name__ == "__main__":
    main()
