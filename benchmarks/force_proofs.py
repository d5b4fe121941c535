"""Proofs of optimal forces and of loads that cannot be held: how many are exact, to rounding, or refused.

    python benchmarks/force_proofs.py [--json FILE] [--markdown FILE] [--count 2000] [--seeds 5]

The problems are those of ``tests/tables/force_problems.py``: random grasps of all kinds, loads that are any, balanced
well inside the cones, balanced on their edge, or just beyond it; every criterion, with and without caps and torque
limits. Rows tell grasps of full rank (smallest singular value above 1e-9 of the largest) in general position from those
that a symmetry, or a load on an edge of the cones, makes special, and both from grasps whose rank is not full.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "tables"))

import jax
import numpy as np
from figures import parser_of_tables, write_table

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402

force_problems: Any = importlib.import_module("force_problems")
STATUSES = (jg.Status.OPTIMAL, jg.Status.INFEASIBLE, jg.Status.STALLED)
PROOFS = (jg.Status.PROVED_EXACTLY, jg.Status.PROVED_TO_ROUNDING, jg.Status.REFUSED)
COLUMNS = [f"{status.name} {how}" for status in STATUSES for how in ("exactly", "to rounding", "refused")]


def measure(name: str, limits: bool, criterion: str, count: int, seed: int) -> tuple[np.ndarray, float]:
    """Counts (3, 9), by status and proof: general position, special, rank not full; seconds a proof."""
    grasp, _, wrench, cap, torque = force_problems.problems(name, limits, count, seed)
    make, parameter = force_problems.CRITERIA[criterion]
    asked = {"criterion": make(parameter), "max_normal": cap, "torque_limits": torque}
    answer = jax.block_until_ready(jg.optimize_forces(grasp, wrench, **asked))
    started = time.perf_counter()
    proof = jg.prove(grasp, answer, wrench=wrench, **asked).status
    seconds = (time.perf_counter() - started) / count
    values = np.linalg.svd(np.asarray(jg.contacts.folded_grasp_map(grasp)), compute_uv=False)
    m = 3 if grasp.dimension == 2 else 6
    full = values[:, m - 1] > 1e-9 * values[:, 0] if values.shape[1] >= m else np.zeros(count, bool)
    status, general = np.asarray(answer.status), force_problems.in_general_position(name, count, seed)
    return np.array(
        [
            [((status == s) & (proof == p) & here).sum() for s in STATUSES for p in PROOFS]
            for here in (full & general, full & ~general, ~full)
        ]
    ), seconds


def main() -> None:
    """Measure, print, write."""
    parser = parser_of_tables(__doc__)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--models", nargs="+", default=list(force_problems.MODELS))
    options = parser.parse_args()
    lines = [
        "| problem | position | us a proof | " + " | ".join(COLUMNS) + " |",
        "| --- | --- |" + " ---: |" * 10,
    ]
    figures: dict[str, Any] = {}
    for name in options.models:
        for limits in (False, True):
            for criterion in force_problems.CRITERIA:
                runs = [
                    measure(name, limits, criterion, options.count, seed) for seed in range(options.seeds)
                ]
                total, seconds = (
                    np.sum([run[0] for run in runs], axis=0),
                    float(np.median([run[1] for run in runs])),
                )
                title = f"{name}, {criterion}{', limits' if limits else ''}"
                for row, rank in zip(total, ("general", "special", "not full"), strict=True):
                    text = " | ".join(str(x) for x in row)
                    lines.append(f"| {title} | {rank} | {1e6 * seconds:.0f} | {text} |")
                    print(lines[-1], flush=True)
                figures[title] = {"counts": total.tolist(), "columns": COLUMNS, "seconds": seconds}
    write_table(options, "\n".join(lines), problems=figures)


if __name__ == "__main__":
    main()
