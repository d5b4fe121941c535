"""Wrench resistance on one core: this solver beside Moreau (batched) and Clarabel, on the same grasps.

    python benchmarks/wrench_resistance.py [--json FILE] [--grasps 8192] [--repeats 7] [--contacts 2 3 4 8]

One process pinned to one core, single-threaded. Every solver gets the same random grasps (hard fingers on a sphere
with tilted normals, mu in [0.3, 0.8]) and works to 1e-8. The baselines solve the dual form of the margin problem,
six unknowns and k second-order cones of size 3, which is the form that suits them best; their matrices are built
beforehand, ours are built from positions and normals inside the measured time. Times are medians over repeats that
take turns; compile and construction times stand apart. No test asserts a time.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
os.environ.setdefault("JAX_PLATFORMS", "cpu")
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import importlib  # noqa: E402
import importlib.metadata  # noqa: E402
from typing import Any  # noqa: E402

import jax  # noqa: E402
import numpy as np  # noqa: E402
from figures import write_figures  # noqa: E402

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402

TOLERANCE = 1e-8


def random_grasps(count: int, k: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contacts on the unit sphere; inward normals tilted by about ten degrees; one mu a grasp."""
    rng = np.random.default_rng(seed)
    position = rng.normal(size=(count, k, 3))
    position /= np.linalg.norm(position, axis=-1, keepdims=True)
    normal = -position + 0.15 * rng.normal(size=position.shape)
    friction = rng.uniform(0.3, 0.8, size=(count, 1)) * np.ones((count, k))
    return position, normal, friction


def dual_program(grasp: jg.Grasp) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``min a.y`` subject to ``c - M y`` in the cones: a (N, 6), M (N, 3 k, 6), c (3 k); t* = 1 + a.y."""
    n, k = grasp.position.shape[:2]
    A = np.array(jg.contacts.folded_grasp_map(grasp)).reshape(n, 6, k, 3)
    blocks = np.moveaxis(A[..., [2, 0, 1]], 1, -1)  # (N, k, 3, 6), normal row first
    a = blocks[:, :, 0].sum(1)
    blocks[:, :, 0] -= a[:, None] / k
    c = np.zeros((k, 3))
    c[:, 0] = 1 / k
    return a, np.ascontiguousarray(blocks.reshape(n, 3 * k, 6)), c.ravel()


class Ours:
    """jaxgrasp, from positions and normals to verdicts with certificates."""

    def __init__(self, name: str, grasp: jg.Grasp, **options):
        self.name, self.grasp, self.options = name, grasp, options
        self.count = grasp.position.shape[0]
        start = time.perf_counter()
        self.result = jg.wrench_resistance(grasp, tolerance=TOLERANCE, **options)
        self.preparation = time.perf_counter() - start

    def run(self) -> None:
        self.result = jax.block_until_ready(
            jg.wrench_resistance(self.grasp, tolerance=TOLERANCE, **self.options)
        )

    def report(self, reference: np.ndarray) -> dict:
        res = self.result
        status, iterations = np.asarray(res.status), np.asarray(res.iterations)
        yes, no = status == jg.Status.RESISTANT, status == jg.Status.NOT_RESISTANT
        deficient = np.asarray(res.rank) < 6
        wrong = (yes & (reference < -1e-7)) | (no & ~deficient & (reference > 1e-7))
        entry = {
            "iterations": float(iterations.mean()),
            "marginal": int((status == jg.Status.MARGINAL).sum()),
            "undecided": int((status == jg.Status.UNDECIDED).sum()),
            "contradictions": int(wrong.sum()),
            "certified": float(jg.check(self.grasp, res).mean()),
        }
        if not self.options:
            entry["largest_difference"] = _difference(np.asarray(res.margin), reference)
            size = np.maximum(1, np.abs(np.where(np.isfinite(reference), reference, 0)))
            entry["largest_gap"] = float(np.max(np.asarray(res.gap) / size))
        return entry


class Moreau:
    """Moreau's compiled batch solver."""

    name = "moreau (batched)"

    def __init__(self, program, k: int):
        moreau: Any = importlib.import_module("moreau")

        self.a, matrix, c = program
        self.count = len(self.a)
        rows = 3 * k
        settings = moreau.Settings(solver="ipm", device="cpu", batch_size=self.count)
        start = time.perf_counter()
        self.solver = moreau.CompiledSolver(
            n=6,
            m=rows,
            P_row_offsets=[0] * 7,
            P_col_indices=[],
            A_row_offsets=np.arange(0, rows * 6 + 1, 6),
            A_col_indices=np.tile(np.arange(6), rows),
            cones=moreau.Cones(so_cone_dims=[3] * k),
            settings=settings,
        )
        self.empty, self.values = np.zeros((self.count, 0)), matrix.reshape(self.count, -1)
        self.rhs = np.tile(c, (self.count, 1))
        self.solver.setup(self.empty, self.values)
        self.preparation = time.perf_counter() - start

    def run(self) -> None:
        self.solution = self.solver.solve(self.a, self.rhs)

    def margins(self) -> np.ndarray:
        return 1 + np.sum(self.a * np.asarray(self.solution.x), -1)

    def report(self, reference: np.ndarray) -> dict:
        solved = np.array(["Solved" in str(s) for s in self.solver.info.status])
        return {
            "iterations": float(np.mean(self.solver.info.iterations)),
            "undecided": int((~solved).sum()),
            "largest_difference": _difference(self.margins()[solved], reference[solved]),
        }


class Clarabel:
    """Clarabel, one problem after another, on a subset; set-up and solve, matrices built beforehand."""

    name = "clarabel"

    def __init__(self, program, k: int, count: int):
        clarabel: Any = importlib.import_module("clarabel")
        csc_matrix: Any = importlib.import_module("scipy.sparse").csc_matrix

        self.clarabel = clarabel
        self.a, matrix, self.c = program
        self.count = min(count, len(self.a))
        self.cones = [clarabel.SecondOrderConeT(3)] * k
        self.settings = clarabel.DefaultSettings()
        self.settings.verbose = False
        self.settings.max_threads = 1
        start = time.perf_counter()
        self.zero = csc_matrix((6, 6))
        self.matrices = [csc_matrix(matrix[i]) for i in range(self.count)]
        self.preparation = time.perf_counter() - start

    def run(self) -> None:
        solver = self.clarabel.DefaultSolver
        self.solutions = [
            solver(self.zero, self.a[i], self.matrices[i], self.c, self.cones, self.settings).solve()
            for i in range(self.count)
        ]

    def report(self, reference: np.ndarray) -> dict:
        solved = np.array([str(s.status) == "Solved" for s in self.solutions])
        margins = np.array([1 + self.a[i] @ np.array(s.x) for i, s in enumerate(self.solutions)])
        return {
            "iterations": float(np.mean([s.iterations for s in self.solutions])),
            "undecided": int((~solved).sum()),
            "largest_difference": _difference(margins[solved], reference[: self.count][solved]),
        }


def _difference(margins: np.ndarray, reference: np.ndarray) -> float:
    finite = np.isfinite(reference) & np.isfinite(margins)  # t* = -inf where no internal force presses
    margins, reference = margins[finite], reference[finite]
    return float(np.max(np.abs(margins - reference) / np.maximum(1, np.abs(reference)), initial=0.0))


def measure(k: int, count: int, repeats: int, seed: int) -> dict[str, dict]:
    """All solvers on the same grasps with k contacts; the repeats take turns."""
    position, normal, friction = random_grasps(count, k, seed)
    grasp = jg.Grasp(position, normal, jg.HardFinger(friction))
    low = [x.astype(np.float32) for x in (position, normal, friction)]
    single = jg.Grasp(low[0], low[1], jg.HardFinger(low[2]))
    program = dual_program(grasp)
    runners: list = [
        Ours("jaxgrasp float64, gap 1e-8", grasp),
        Ours("jaxgrasp float64, verdict only", grasp, verdict_only=True),
        Ours("jaxgrasp float32", single),
        Ours("jaxgrasp float32, verdict only", single, verdict_only=True),
    ]
    for factory in (lambda: Moreau(program, k), lambda: Clarabel(program, k, 1024)):
        try:
            runners.append(factory())
        except ImportError as error:
            print(f"  left out: {error.name} is not installed (pip install 'jaxgrasp[baselines]')")
    times: dict[str, list[float]] = {r.name: [] for r in runners}
    for _ in range(repeats):
        for runner in runners:
            start = time.perf_counter()
            runner.run()
            times[runner.name].append((time.perf_counter() - start) / runner.count * 1e6)
    reference = np.asarray(runners[0].result.margin) + 0.5 * np.asarray(runners[0].result.gap)
    return {
        r.name: {
            "microseconds": float(np.median(times[r.name])),
            "spread": [float(min(times[r.name])), float(max(times[r.name]))],
            "grasps": r.count,
            "preparation_seconds": r.preparation,
            **r.report(reference),
        }
        for r in runners
    }


def hardware() -> dict[str, str]:
    """What the figures were measured on."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":")[1].strip()
            for line in info.read_text().splitlines()
            if line.startswith("model name")
        ]
        cpu = names[0] if names else cpu
    versions = {}
    for package in ("jax", "jaxlib", "numpy", "moreau", "clarabel"):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return {"cpu": cpu, "cores used": "1", "python": platform.python_version(), **versions}


def show(k: int, rows: dict[str, dict]) -> None:
    """One table a number of contacts; the ratio is Moreau's time over the row's."""
    base = rows.get(Moreau.name, {}).get("microseconds")
    print(f"\nk = {k}")
    print(
        f"{'':32s} {'us/grasp':>9s} {'ratio':>7s} {'iter':>5s} {'compile s':>9s} "
        f"{'t* = 0':>6s} {'open':>5s} {'difference':>11s}"
    )
    for name, row in rows.items():
        ratio = f"{base / row['microseconds']:7.1f}" if base else "      -"
        difference = f"{row['largest_difference']:11.1e}" if "largest_difference" in row else "          -"
        line = f"{name:32s} {row['microseconds']:9.2f} {ratio} {row['iterations']:5.1f}"
        marginal = f"{row['marginal']:6d}" if "marginal" in row else "     -"
        line += f" {row['preparation_seconds']:9.2f} {marginal} {row['undecided']:5d} {difference}"
        if row.get("contradictions"):
            line += f"  {row['contradictions']} CONTRADICTIONS"
        if row.get("certified", 1.0) < 1:
            line += f"  certified {row['certified']:.4%}"
        print(line)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--grasps", type=int, default=8192)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--contacts", type=int, nargs="+", default=[2, 3, 4, 8])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    machine = hardware()
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    results = {}
    for k in options.contacts:
        results[k] = measure(k, options.grasps, options.repeats, options.seed)
        show(k, results[k])
    write_figures(options, machine, k=results)


if __name__ == "__main__":
    main()
