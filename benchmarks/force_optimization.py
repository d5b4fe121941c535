"""Force optimisation on one core: this solver beside Moreau (batched) and Clarabel, on the same problems.

    python benchmarks/force_optimization.py [--json FILE] [--problems 4096] [--repeats 5] [--contacts 2 3 4 8]
                                            [--criteria gentlest robust ..]

One process pinned to one core, single-threaded. Hard fingers on a sphere with tilted normals, mu in [0.3, 0.8]; loads
are random for k > 2 (a third of them cannot be balanced) and balanced by construction for k = 2. Everyone works to
1e-8. Moreau gets the primal and, where it exists, the smaller dual form, matrices built beforehand, and the faster
counts; ours starts from positions and normals and ends with bounds and twists. ``gradient`` is the derivative of the
sum of the costs, ``force gradient``
that of a random combination of all optimal forces, with respect to positions, normals, mu and
loads; for Moreau it is ``backward`` with respect to its matrices and vectors. Times are medians over repeats that take
turns; compile and construction times stand apart. No test asserts a time.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from figures import write_figures
from wrench_resistance import hardware, random_grasps  # also pins the process and sets it to one thread

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxgrasp as jg

TOLERANCE = 1e-8
CRITERIA = {
    "gentlest": jg.Gentlest(),
    "robust": jg.Robust(),
    "smallest sum": jg.SmallestSum(),
    "sum of squares": jg.SumOfSquares(),
    "least norm": jg.LeastNorm(),
}


class Problems:
    """The same grasps and loads for everyone; A (N, 6, k, 3) folded, normal component first."""

    def __init__(self, count: int, k: int, seed: int):
        position, normal, friction = random_grasps(count, k, seed)
        rng = np.random.default_rng(seed + 1)
        self.count, self.k = count, k
        self.grasp = jg.Grasp(position, normal, jg.HardFinger(friction))
        A = np.array(jg.contacts.folded_grasp_map(self.grasp)).reshape(count, 6, k, 3)[..., [2, 0, 1]]
        self.A, self.friction = np.ascontiguousarray(A), friction
        self.wrench = rng.normal(size=(count, 6))
        if k == 2:
            s = rng.normal(size=(count, k, 3))
            s[..., 0] = 1.5 * np.linalg.norm(s[..., 1:], axis=-1) + 0.1
            self.wrench = -np.einsum("lmkn,lkn->lm", A, s)


def forms(problems: Problems, criterion: str) -> dict[str, dict]:
    """Conic programs ``min x'Px/2 + q'x, Ax + s = b, s in K`` as dense arrays: primal, and a smaller dual.

    cones: (zero, nonnegative, second-order sizes). The dual's optimal value is the negative cost.
    """
    n, k, A, w = problems.count, problems.k, problems.A, problems.wrench
    flat = A.reshape(n, 6, 3 * k)
    out: dict[str, dict] = {}
    if criterion == "robust":
        return _robust_form(problems)
    level = criterion == "gentlest"
    size = 3 * k + level
    rows = np.zeros((n, 6 + level * k + 3 * k, size))
    rows[:, :6, : 3 * k] = flat
    if level:
        for i in range(k):
            rows[:, 6 + i, 3 * i], rows[:, 6 + i, -1] = 1.0, -1.0
    rows[:, 6 + level * k :, : 3 * k] = -np.eye(3 * k)
    right = np.zeros((n, rows.shape[1]))
    right[:, :6] = -w
    q, P = np.zeros((n, size)), np.zeros((n, size))
    if level:
        q[:, -1] = 1.0
    elif criterion == "smallest sum":
        q[:, ::3] = 1.0
    else:
        P[:, ::3] = 2.0
        if criterion == "least norm":
            P[:, 1::3] = P[:, 2::3] = 2 * problems.friction**2
    out["primal"] = {"P": P, "q": q, "A": rows, "b": right, "cones": (6, level * k, [3] * k), "sign": 1.0}
    if criterion == "least norm":
        return out
    extra = 0 if criterion == "smallest sum" else k
    dual = np.zeros((n, (extra > 0 and level) + level * k + 3 * k, 6 + extra))
    b = np.zeros((n, dual.shape[1]))
    first = level + level * k
    dual[:, first:, :6] = -np.swapaxes(flat, 1, 2)
    if extra:
        for i in range(k):
            dual[:, first + 3 * i, 6 + i] = -1.0
    else:
        b[:, first::3] = 1.0
    if level:
        dual[:, 0, 6:] = 1.0
        b[:, 0] = 1.0
        for i in range(k):
            dual[:, 1 + i, 6 + i] = -1.0
    q, P = np.zeros((n, 6 + extra)), np.zeros((n, 6 + extra))
    q[:, :6] = -w
    if criterion == "sum of squares":
        P[:, 6:] = 0.5
    out["dual"] = {"P": P, "q": q, "A": dual, "b": b, "cones": (int(level), level * k, [3] * k), "sign": -1.0}
    return out


def _robust_form(problems: Problems) -> dict[str, dict]:
    """Variables (s, xi, g, logs): ``|(s_t, g)| <= s_0``, log det = 2 log g, log s_0 by exponential cones."""
    n, k = problems.count, problems.k
    size = 3 * k + 1 + k + 2 * k
    g, log_g, log_s = 3 * k + 1, 4 * k + 1, 5 * k + 1
    rows = np.zeros((n, 6 + k + 4 * k + 6 * k, size))
    right = np.zeros((n, rows.shape[1]))
    rows[:, :6, : 3 * k] = problems.A.reshape(n, 6, 3 * k)
    right[:, :6] = -problems.wrench
    for i in range(k):
        rows[:, 6 + i, 3 * i], rows[:, 6 + i, 3 * k] = 1.0, -1.0
        for j in range(3):
            rows[:, 6 + k + 4 * i + j, 3 * i + j] = -1.0
        rows[:, 6 + k + 4 * i + 3, g + i] = -1.0
        for row, variable, value in (
            (6 + 5 * k + 3 * i, log_g + i, g + i),
            (6 + 8 * k + 3 * i, log_s + i, 3 * i),
        ):
            rows[:, row, variable], rows[:, row + 2, value] = -1.0, -1.0
            right[:, row + 1] = 1.0
    q, P = np.zeros((n, size)), np.zeros((n, size))
    q[:, 3 * k] = 1.0
    q[:, log_g : log_g + k] = -2.0
    q[:, log_s : log_s + k] = -1.0
    constant = -3 * np.log(problems.friction).sum(-1)
    cones = (6, k, [4] * k, 2 * k)
    return {
        "primal": {"P": P, "q": q, "A": rows, "b": right, "cones": cones, "sign": 1.0, "constant": constant}
    }


class Ours:
    """jaxgrasp, from positions and normals to forces with bounds."""

    def __init__(self, problems: Problems, criterion: str, mode: str):
        self.name, self.problems, self.mode = f"jaxgrasp {mode}", problems, mode
        self.count, self.criterion = problems.count, CRITERIA[criterion]
        self.asked = {"wrench": problems.wrench, "criterion": self.criterion}
        grasp = problems.grasp
        self.data = (
            grasp.position,
            grasp.normal,
            grasp.model.friction_coefficient,
            jnp.asarray(problems.wrench),
        )
        weights = jnp.asarray(np.random.default_rng(7).normal(size=(problems.count, 3 * problems.k)))

        def solve(data):
            position, normal, friction, wrench = data
            return jg.optimize_forces(
                jg.Grasp(position, normal, jg.HardFinger(friction)),
                wrench,
                criterion=self.criterion,
                tolerance=TOLERANCE,
            )

        def total(data):
            out = solve(data)
            if mode == "forward + force gradient":
                return jnp.sum(weights * out.force)
            return jnp.sum(jnp.where(out.status == jg.Status.OPTIMAL, out.cost, 0.0))

        self.call = solve if mode == "forward" else jax.jit(jax.value_and_grad(total))
        start = time.perf_counter()
        self.run()
        self.preparation = time.perf_counter() - start

    def run(self) -> None:
        self.result = jax.block_until_ready(self.call(self.data))

    def costs(self) -> np.ndarray:
        out: Any = self.result
        return np.where(np.asarray(out.status) == jg.Status.OPTIMAL, np.asarray(out.cost), np.nan)

    def report(self, reference: np.ndarray, scale: np.ndarray) -> dict:
        if self.mode != "forward":
            return {
                "finite": bool(all(np.isfinite(np.asarray(g)).all() for g in jax.tree.leaves(self.result)))
            }
        out: Any = self.result
        status = np.asarray(out.status)
        optimal = status == jg.Status.OPTIMAL
        return {
            "iterations": float(np.asarray(out.iterations).mean()),
            "optimal": int(optimal.sum()),
            "infeasible": int((status == jg.Status.INFEASIBLE).sum()),
            "unsolved": int((status == jg.Status.STALLED).sum()),
            "largest_gap": float(np.max(np.asarray(out.gap)[optimal] / scale[optimal], initial=0.0)),
            "certified": float(
                np.mean(
                    jg.check(self.problems.grasp, out, wrench=self.problems.wrench, criterion=self.criterion)
                )
            ),
        }


class Moreau:
    """Moreau's compiled batch solver on one form."""

    def __init__(self, problems: Problems, form: str, program: dict, backward: bool):
        moreau: Any = importlib.import_module("moreau")
        self.name = f"moreau {form}{' + backward' if backward else ''}"
        self.count, self.program, self.backward = problems.count, program, backward
        rows, size = program["A"].shape[1:]
        pattern = (program["A"] != 0).any(0)
        counts = pattern.sum(1)
        curved = (program["P"] != 0).any(0)
        zero, nonneg, sizes, *exponential = program["cones"]
        cones = moreau.Cones(
            num_zero_cones=zero, num_nonneg_cones=nonneg, so_cone_dims=sizes,
            num_exp_cones=exponential[0] if exponential else 0,
        )  # fmt: skip
        settings = moreau.Settings(solver="ipm", device="cpu", batch_size=self.count, enable_grad=backward)
        start = time.perf_counter()
        self.solver = moreau.CompiledSolver(
            n=size,
            m=rows,
            P_row_offsets=np.concatenate([[0], np.cumsum(curved)]),
            P_col_indices=np.flatnonzero(curved),
            A_row_offsets=np.concatenate([[0], np.cumsum(counts)]),
            A_col_indices=np.concatenate([np.flatnonzero(p) for p in pattern]),
            cones=cones,
            settings=settings,
        )
        self.P = np.ascontiguousarray(program["P"][:, curved])
        self.A = np.ascontiguousarray(program["A"][:, pattern])
        self.solver.setup(self.P, self.A)
        self.run()
        self.preparation = time.perf_counter() - start

    def run(self) -> None:
        self.solver.setup(self.P, self.A)
        self.solution = self.solver.solve(self.program["q"], self.program["b"])
        if self.backward:
            self.gradient = self.solver.backward(np.ones_like(np.asarray(self.solution.x)))

    def solved(self) -> np.ndarray:
        return np.array(["Solved" in str(s) and "Infeasible" not in str(s) for s in self.solver.info.status])

    def costs(self) -> np.ndarray:
        value = self.program["sign"] * np.asarray(self.solver.info.obj_val) + self.program.get(
            "constant", 0.0
        )
        return np.where(self.solved(), value, np.nan)

    def report(self, reference: np.ndarray, scale: np.ndarray) -> dict:
        names = [str(s) for s in self.solver.info.status]
        proven = np.array(["Infeasible" in s for s in names])
        return {
            "iterations": float(np.mean(self.solver.info.iterations)),
            "optimal": int(self.solved().sum()),
            "infeasible": int(proven.sum()),
            "unsolved": int(self.count - self.solved().sum() - proven.sum()),
        }


class Clarabel:
    """Clarabel, one problem after another, on a subset; matrices built beforehand."""

    name = "clarabel"

    def __init__(self, problems: Problems, program: dict, count: int):
        clarabel: Any = importlib.import_module("clarabel")
        csc: Any = importlib.import_module("scipy.sparse").csc_matrix
        self.clarabel, self.program, self.count = clarabel, program, min(count, problems.count)
        zero, nonneg, sizes, *exponential = program["cones"]
        self.cones = [clarabel.ZeroConeT(zero)] if zero else []
        self.cones += [clarabel.NonnegativeConeT(nonneg)] if nonneg else []
        self.cones += [clarabel.SecondOrderConeT(s) for s in sizes]
        self.cones += [clarabel.ExponentialConeT()] * (exponential[0] if exponential else 0)
        self.settings = clarabel.DefaultSettings()
        self.settings.verbose, self.settings.max_threads = False, 1
        start = time.perf_counter()
        self.A = [csc(a) for a in program["A"][: self.count]]
        self.P = [csc(np.diag(p)) for p in program["P"][: self.count]]
        self.preparation = time.perf_counter() - start

    def run(self) -> None:
        solver, p = self.clarabel.DefaultSolver, self.program
        self.solutions = [
            solver(self.P[i], p["q"][i], self.A[i], p["b"][i], self.cones, self.settings).solve()
            for i in range(self.count)
        ]

    def costs(self) -> np.ndarray:
        constant = np.broadcast_to(self.program.get("constant", 0.0), len(self.program["q"]))
        return np.array(
            [
                self.program["sign"] * s.obj_val + constant[i] if str(s.status) == "Solved" else np.nan
                for i, s in enumerate(self.solutions)
            ]
        )

    def report(self, reference: np.ndarray, scale: np.ndarray) -> dict:
        names = [str(s.status) for s in self.solutions]
        proven = sum("Infeasible" in s for s in names)
        optimal = sum(s == "Solved" for s in names)
        return {
            "iterations": float(np.mean([s.iterations for s in self.solutions])),
            "optimal": optimal,
            "infeasible": proven,
            "unsolved": self.count - optimal - proven,
        }


def measure(k: int, criterion: str, count: int, repeats: int, seed: int) -> dict[str, dict]:
    """All solvers on the same problems; the repeats take turns."""
    problems = Problems(count, k, seed)
    programs = forms(problems, criterion)
    runners: list = [Ours(problems, criterion, "forward")]
    runners += [
        Ours(problems, criterion, mode) for mode in ("forward + gradient", "forward + force gradient")
    ]
    for form, program in programs.items():
        for backward in (False, True):
            runners.append(_try(lambda f=form, p=program, b=backward: Moreau(problems, f, p, b)))
    runners.append(_try(lambda: Clarabel(problems, programs["primal"], 512)))
    runners = [r for r in runners if r is not None]
    times: dict[str, list[float]] = {r.name: [] for r in runners}
    for _ in range(repeats):
        for runner in runners:
            start = time.perf_counter()
            runner.run()
            times[runner.name].append((time.perf_counter() - start) / runner.count * 1e6)
    ours = runners[0]
    reference = ours.costs()
    scale = np.maximum(np.abs(reference), 1.0)
    out = {}
    for r in runners:
        entry = {
            "microseconds": float(np.median(times[r.name])),
            "spread": [float(min(times[r.name])), float(max(times[r.name]))],
            "problems": r.count,
            "preparation_seconds": r.preparation,
            **r.report(reference, scale),
        }
        if r is not ours and hasattr(r, "costs") and getattr(r, "mode", "forward") == "forward":
            other = r.costs()
            difference = np.abs(other - reference[: len(other)]) / scale[: len(other)]
            entry["median_difference"] = float(np.nanmedian(difference))
            entry["largest_difference"] = float(np.nanmax(difference))
        out[r.name] = entry
    return out


def _try(factory):
    try:
        return factory()
    except ImportError as error:
        print(f"  left out: {error.name} is not installed (pip install 'jaxgrasp[baselines]')")
    except Exception as error:
        print(f"  left out: {type(error).__name__}: {error}")
    return None


def show(k: int, criterion: str, rows: dict[str, dict]) -> None:
    """One table a criterion and k; the ratio is Moreau's best time for the same thing over the row's."""
    forward = [r["microseconds"] for n, r in rows.items() if n.startswith("moreau") and "backward" not in n]
    backward = [r["microseconds"] for n, r in rows.items() if n.startswith("moreau") and "backward" in n]
    print(f"\nk = {k}, {criterion}")
    print(
        f"{'':34s} {'us':>8s} {'ratio':>6s} {'iter':>5s} {'setup s':>8s} {'optimal':>8s} {'infeas.':>8s} {'open':>5s} "
        f"{'difference (median, max)':>25s}"
    )
    for name, row in rows.items():
        base = backward if "gradient" in name or "backward" in name else forward
        ratio = f"{min(base) / row['microseconds']:6.1f}" if base else "     -"
        line = f"{name:34s} {row['microseconds']:8.2f} {ratio} {row.get('iterations', 0):5.1f} "
        line += f"{row['preparation_seconds']:8.1f}"
        if "optimal" in row:
            line += f" {row['optimal']:8d} {row['infeasible']:8d} {row['unsolved']:5d}"
        if "largest_difference" in row:
            line += f"    {row['median_difference']:9.1e} {row['largest_difference']:9.1e}"
        if row.get("certified", 1.0) < 1:
            line += f"  certified {row['certified']:.4%}"
        print(line, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--problems", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--contacts", type=int, nargs="+", default=[2, 3, 4, 8])
    parser.add_argument("--criteria", nargs="+", default=list(CRITERIA), choices=list(CRITERIA))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    machine = hardware()
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    results: dict[str, dict] = {}
    for k in options.contacts:
        for criterion in options.criteria:
            rows = measure(k, criterion, options.problems, options.repeats, options.seed)
            results.setdefault(str(k), {})[criterion] = rows
            show(k, criterion, rows)
    write_figures(options, machine, k=results)


if __name__ == "__main__":
    main()
