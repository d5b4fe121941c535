"""Quality measures on one core: the certified epsilon bracket beside Qhull's pyramids, and what each measure costs.

    python benchmarks/quality.py [--json FILE] [--grasps 500] [--contacts 3 4 5 8] [--edges 32] [--hulls N]

One process pinned to one core, single-threaded. Hard fingers on a sphere with tilted normals, mu in [0.3, 0.8]; those
that are wrench resistant count. The width is (upper - lower) / upper; every bracket is proved by the checker. Qhull
takes the hull of pyramids of ``--edges`` edges inside, and around, the friction cones of the first ``--hulls`` grasps
(L1; by default all of them up to four contacts, fifty beyond, where a hull takes up to a second): bounds of its
own, which the bracket must overlap. Times are medians of three; compile times stand apart.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

# isort: split
from figures import write_figures
from wrench_resistance import hardware, random_grasps  # also pins the process and sets it to one thread

# isort: split
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from scipy.spatial import ConvexHull

import jaxgrasp as jg
from jaxgrasp.quality.unit_wrench_space import effort_map, torque_lengths


def resistant_grasps(count: int, k: int, seed: int) -> jg.Grasp:
    """The first ``count`` resistant ones of random grasps."""
    position, normal, friction = random_grasps(60 * count if k == 3 else 8 * count, k, seed)
    grasp = jg.Grasp(position, normal, jg.HardFinger(friction))
    status = np.asarray(jg.wrench_resistance(grasp, verdict_only=True).status)
    return grasp[np.flatnonzero(status == jg.Status.RESISTANT)[:count]]


def timed(call: Callable[[], Any], repeats: int = 3) -> tuple[Any, float, float]:
    """The result, the first call's seconds less the median, and the median."""
    start = time.perf_counter()
    result = jax.block_until_ready(call())
    first = time.perf_counter() - start
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
    return result, max(first - float(np.median(seconds)), 0.0), float(np.median(seconds))


def pyramid(A: np.ndarray, edges: int, outer: bool) -> float:
    """Qhull's ball in the hull of pyramids inside or around the cones of A (k, 6, 3)."""
    angle = 2 * np.pi * np.arange(edges) / edges
    reach = 1 / np.cos(np.pi / edges) if outer else 1.0
    rim = np.cos(angle)[:, None, None] * A[:, :, 1] + np.sin(angle)[:, None, None] * A[:, :, 2]
    points = (A[:, :, 0] + reach * rim).reshape(-1, A.shape[1])
    return float(-ConvexHull(points).equations[:, -1].max())


def brackets(grasp: jg.Grasp, norm: str) -> dict[str, Any]:
    count = grasp.batch_shape[0]
    q, compiling, seconds = timed(lambda: jg.epsilon_quality(grasp, norm=norm))
    proof = jg.epsilon_quality(grasp, norm=norm, certificate=True)
    width = np.asarray(q.width)
    return {
        "measure": f"epsilon {norm}",
        "milliseconds": 1e3 * seconds / count,
        "compile_seconds": compiling,
        "median_width": float(np.median(width)),
        "share_within_1_percent": float(np.mean(width <= 0.01)),
        "largest_width": float(width.max()),
        "sharp": float(np.mean(np.asarray(q.smooth))),
        "proved": float(np.mean(jg.check(grasp, proof))),
        "median": float(np.median(np.asarray(q.upper))),
    }


def qhull(grasp: jg.Grasp, edges: int, hulls: int | None) -> dict[str, Any]:
    if hulls is None:
        hulls = grasp.batch_shape[0] if grasp.contacts <= 4 else 50
    A = np.asarray(effort_map(grasp, torque_lengths(grasp)))[:hulls]
    q = jg.epsilon_quality(grasp[:hulls])
    lower, upper = np.asarray(q.lower), np.asarray(q.upper)
    start = time.perf_counter()
    inner = np.array([pyramid(a, edges, False) for a in A])
    seconds = time.perf_counter() - start
    outer = np.array([pyramid(a, edges, True) for a in A])
    return {
        "measure": f"Qhull, {edges} edges inside",
        "hulls": len(A),
        "milliseconds": 1e3 * seconds / len(A),
        "median_width": float(np.median(1 - inner / outer)),
        "contradictions": int(np.sum((inner > upper * (1 + 1e-9)) | (lower > outer * (1 + 1e-9)))),
        "below_epsilon": float(np.median(1 - inner / upper)),
    }


def others(grasp: jg.Grasp) -> list[dict[str, Any]]:
    count = grasp.batch_shape[0]
    calls = {
        "margin": lambda: jg.wrench_resistance(grasp).margin,
        "critical friction": lambda: jg.critical_friction(grasp).factor,
        "guaranteed radius": lambda: jg.guaranteed_radius(grasp).radius,
        "isotropy": lambda: jg.quality.grasp_isotropy(grasp),
    }
    rows = []
    for name, call in calls.items():
        value, compiling, seconds = timed(call)
        row = {"measure": name, "milliseconds": 1e3 * seconds / count, "compile_seconds": compiling}
        rows.append(row | {"median": float(np.median(np.asarray(value)))})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--grasps", type=int, default=500)
    parser.add_argument("--contacts", type=int, nargs="+", default=[3, 4, 5, 8])
    parser.add_argument("--edges", type=int, default=32)
    parser.add_argument("--hulls", type=int)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    machine = hardware()
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    results = []
    for k in options.contacts:
        grasp = resistant_grasps(options.grasps, k, options.seed)
        print(f"\nk = {k}, {grasp.batch_shape[0]} resistant grasps")
        rows = [brackets(grasp, "L1"), brackets(grasp, "Linf")]
        rows += [qhull(grasp, options.edges, options.hulls), *others(grasp)]
        for row in rows:
            results.append({"contacts": k, "grasps": grasp.batch_shape[0], **row})
            figures = [f"{name} {value:.4g}" for name, value in row.items() if name != "measure"]
            print(f"  {row['measure']:24s} " + ", ".join(figures), flush=True)
    write_figures(options, machine, rows=results)


if __name__ == "__main__":
    main()
