"""Problems that others publish, solved: status, bracket and published value, as a table and as JSON.

    python benchmarks/conformance.py [--out benchmarks/results/conformance] [--names truss1 hinf1 ..] [--data FOLDER]

SDPLIB's small semidefinite programs and second-order cone problems through ``lmi.sdp_minimize``, Siconos' local contact
problems through ``lmi.lmi_minimize``, its stacked boxes through ``wrench_resistance`` and ``optimize_forces``.
``FOLDER`` holds ``sdplib/*.dat-s`` and ``siconos/*``; the cone problems need no file. Siconos publishes problems, not
values: these are Clarabel's.

"holds": the bracket contains the published value to the digits published, and x and Z are what they are said to be, in
whole numbers; for UNBOUNDED and INFEASIBLE, the ray or the multipliers prove it for every x. Of the boxes, each of many
problems counts: no bracket and no verdict contradicts the value, and ``check`` accepts every answer.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from scipy.linalg import block_diag

import jaxgrasp as jg
from jaxgrasp import Status

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "tables"))
from clarabel_oracle import clarabel_margin  # noqa: E402 # pyright: ignore
from contact_problems import DENSE, clarabel_sums, loads, local_problem  # noqa: E402 # pyright: ignore
from exact_matrix import at, excludes_all, is_ray, is_semidefinite  # noqa: E402 # pyright: ignore
from published import DIGITS, SDPLIB, cone_problems, read_bodies, read_sdpa  # noqa: E402 # pyright: ignore

NOTE = """Brackets `lower <= value <= upper` of this library beside the value published. SDPLIB: README of version 1.2,
to its digits. socp: the tests of cvxpy. Below them Siconos, which publishes problems and no values: these are
Clarabel's. Every x of SDPLIB is checked in whole numbers to be feasible, every Z to be semidefinite, the rays of infd1
and infd2 and the multipliers of infp1 and infp2 to prove what they are given for. STALLED: the point is feasible and
its cost true; no bound, or none that closes the gap, was found, mostly because no Z > 0 is a dual point of that
problem. The last two rows are 31 resting bodies and 992 loads on them: the largest lower and upper end (of loads that
are OPTIMAL), each held against Clarabel, all accepted by `check`. Times include compiling."""
BOXES = "Box_Stacks-i0122-82-5"
HEAD = "| problem | variables | order | status | lower | upper | published | holds | s |\n" + "|---" * 9 + "|"


def timed(function, *arguments):
    begin = time.perf_counter()
    out = jax.block_until_ready(function(*arguments))
    return out, round(time.perf_counter() - begin, 1)


def row(
    name: str,
    variables: int,
    order: int,
    status: str,
    bracket,
    value: float,
    holds: bool | np.bool_,
    seconds: float,
):
    lower, upper = (float(end) for end in bracket)
    return {
        "problem": name, "variables": variables, "order": order, "status": status, "lower": lower, "upper": upper,
        "published": value, "holds": bool(holds), "seconds": seconds,
    }  # fmt: skip


def solve(name: str, u, constant, matrices, value: float, room: float) -> dict:
    """One semidefinite program."""
    out, seconds = timed(jg.lmi.sdp_minimize, u, constant, matrices)
    status, lower, upper = Status(int(out.status)), float(out.lower), float(out.upper)
    if np.isposinf(value):
        proved = excludes_all(constant, matrices, np.asarray(out.Z))
        holds = status == Status.INFEASIBLE and np.isposinf(lower) and proved
    else:
        holds = is_semidefinite(at(np.asarray(out.x), constant, matrices))
        if np.isneginf(value):
            holds &= status == Status.UNBOUNDED and is_ray(u, matrices, np.asarray(out.ray))
        else:
            holds &= lower <= value + room and upper >= value - room
            holds &= np.isneginf(lower) or is_semidefinite(np.asarray(out.Z))
    return row(name, len(u), len(constant), status.name, (lower, upper), value, holds, seconds)


def contact(name: str, path: Path) -> dict:
    """One local contact problem."""
    problem, value = local_problem(path)
    out, seconds = timed(jg.lmi.lmi_minimize, problem)
    room = 1e-7 * max(1.0, abs(value))
    holds = float(out.lower) - room <= value <= float(out.upper) + room
    order = len(problem.constant)
    bracket = out.lower, out.upper
    return row(name, len(problem.cost), order, Status(int(out.status)).name, bracket, value, holds, seconds)


def counted(status: np.ndarray) -> str:
    return ", ".join(f"{n} {Status(s).name}" for s, n in sorted(Counter(status.ravel().tolist()).items()))


def boxes(path: Path) -> Iterator[dict]:
    """31 resting bodies and 992 loads on them: the largest ends of their brackets, and the largest value."""
    bodies = read_bodies(path)
    grasp = jg.Grasp(bodies.position, bodies.normal, jg.HardFinger(bodies.friction), bodies.active)
    k = bodies.active.shape[1]
    out, seconds = timed(jg.wrench_resistance, grasp)
    parts = zip(bodies.position, bodies.normal, bodies.active, strict=True)
    margins = np.array(
        [clarabel_margin(p, n, bodies.friction, 0.0, a, ["f_x", "f_y", "f_n"])[0] for p, n, a in parts]
    )
    lower, upper = np.asarray(out.lower), np.asarray(out.upper)
    with np.errstate(invalid="ignore"):
        agree = np.where(np.isneginf(margins), upper < -1e9, (lower <= margins) & (margins <= upper))
    holds = agree.all() and np.all(jg.check(grasp, out))
    bracket = lower.max(), upper.max()
    name, status = f"{path.stem}: margins", counted(np.asarray(out.status))
    yield row(name, 3 * k, 6, status, bracket, margins.max(), holds, seconds)

    G = np.asarray(jg.grasp_map(grasp))
    wrench, criterion = loads(bodies, G), jg.SmallestSum()
    out, seconds = timed(lambda: jg.optimize_forces(grasp, wrench, criterion=criterion))
    value, status = clarabel_sums(bodies, G, wrench), np.asarray(out.status)
    lower, upper = np.asarray(out.lower), np.asarray(out.cost)
    room = 1e-6 * np.maximum(1e-2, np.where(np.isfinite(value), np.abs(value), 1.0))
    inside = np.isnan(value) | (lower - room <= value) & ((value <= upper + room) | np.isposinf(upper))
    proved = np.asarray(jg.check(grasp, out, wrench=wrench, criterion=criterion))
    holds = inside.all() and np.all(np.isposinf(value[status == Status.INFEASIBLE])) and proved.all()
    optimal = status == Status.OPTIMAL
    bracket = lower[optimal].max(), upper[optimal].max()
    name = f"{path.stem}: loads"
    yield row(name, 3 * k, 6, counted(status), bracket, value[optimal].max(), holds, seconds)


def rows(names: list[str], data: Path) -> Iterator[dict]:
    for name, problem in cone_problems().items():
        if name in names:
            blocks = [jg.lmi.second_order_cone_lmi(*map(np.asarray, cone)) for cone in problem.cones]
            constant = block_diag(*(np.asarray(block[0]) for block in blocks))
            matrices = [block_diag(*(np.asarray(b[1])[i] for b in blocks)) for i in range(len(problem.cost))]
            yield solve(name, problem.cost, constant, np.array(matrices), problem.value, 2e-6)
    for name, value in SDPLIB.items():
        if name in names:
            u, constant, matrices = read_sdpa(data / "sdplib" / f"{name}.dat-s")
            yield solve(name, u, constant, matrices, value, DIGITS.get(name, 0.0))
    for name in DENSE:
        if name in names:
            yield contact(name, data / "siconos" / f"{name}.dat")
    if BOXES in names:
        yield from boxes(data / "siconos" / f"{BOXES}.hdf5")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "conformance")
    parser.add_argument("--names", nargs="+", default=[*cone_problems(), *SDPLIB, *DENSE, BOXES])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data" / "conformance")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    lines, found = [HEAD], []
    print(HEAD)
    for line in rows(options.names, options.data):
        found.append(line)
        lines.append(
            f"| {line['problem']} | {line['variables']} | {line['order']} | {line['status']} | {line['lower']:.10g} | "
            f"{line['upper']:.10g} | {line['published']:.8g} | {'yes' if line['holds'] else 'NO'} | {line['seconds']} |"
        )
        print(lines[-1], flush=True)
        against = f"Contradictions: {sum(not line['holds'] for line in found)} of {len(found)} rows."
        table = "\n".join(["# Problems that others publish", "", NOTE, "", against, "", *lines])
        options.out.with_suffix(".md").write_text(table + "\n")
        options.out.with_suffix(".json").write_text(json.dumps(found, indent=1))
    print(against)


if __name__ == "__main__":
    main()
