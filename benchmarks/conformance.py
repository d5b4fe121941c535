"""Problems that others publish, solved: status, bracket and published value, as a table and as JSON.

    python benchmarks/conformance.py [--out benchmarks/results/conformance] [--names truss1 hinf1 ..] [--data FOLDER]

SDPLIB's small semidefinite programs and second-order cone problems through ``lmi.sdp_minimize``. ``FOLDER`` holds
``sdplib/*.dat-s``; the cone problems need no file. "holds": the bracket contains the published value to the digits
published; for UNBOUNDED and INFEASIBLE, the ray or the multipliers prove it for every x.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import jax
import numpy as np
from scipy.linalg import block_diag

import jaxgrasp as jg
from jaxgrasp import Status

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "tables"))
from published import DIGITS, SDPLIB, cone_problems, read_sdpa  # noqa: E402 # pyright: ignore

HEAD = "| problem | variables | order | status | lower | upper | published | holds | s |\n" + "|---" * 9 + "|"


def solve(name: str, u, constant, matrices, value: float, room: float) -> dict:
    """One row of the table."""
    begin = time.perf_counter()
    out = jax.block_until_ready(jg.lmi.sdp_minimize(u, constant, matrices))
    seconds = time.perf_counter() - begin
    status, lower, upper = Status(int(out.status)), float(out.lower), float(out.upper)
    if np.isposinf(value):
        holds = status == Status.INFEASIBLE and np.isposinf(lower)
    elif np.isneginf(value):
        holds = status == Status.UNBOUNDED
    else:
        holds = lower <= value + room and upper >= value - room
    return {
        "problem": name, "variables": len(u), "order": len(constant), "status": status.name, "lower": lower,
        "upper": upper, "published": value, "holds": bool(holds), "seconds": round(seconds, 1),
    }  # fmt: skip


def rows(names: list[str], data: Path):
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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "conformance")
    parser.add_argument("--names", nargs="+", default=[*cone_problems(), *SDPLIB])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data" / "conformance")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    lines, found = ["# Problems that others publish", "", HEAD], []
    print(HEAD)
    for row in rows(options.names, options.data):
        found.append(row)
        lines.append(
            f"| {row['problem']} | {row['variables']} | {row['order']} | {row['status']} | {row['lower']:.10g} | "
            f"{row['upper']:.10g} | {row['published']:.8g} | {'yes' if row['holds'] else 'NO'} | {row['seconds']} |"
        )
        print(lines[-1], flush=True)
        options.out.with_suffix(".md").write_text("\n".join(lines) + "\n")
        options.out.with_suffix(".json").write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
