"""Verdicts and brackets against 70 decimal digits, on grasps drawn towards the boundary between yes and no.

    python benchmarks/independent_truth.py [--json FILE] [--markdown FILE] [--count 100]

``--count`` grasps for each contact model and 2, 4 and 8 contacts, with friction within 1e-3 to 1e-9 of the critical one
(frictionless grasps as they come), and as many of the kinds of ``tests/tables/grasps.py``. The margin t* is enclosed by
weak duality in 70 digits (``tests/tables/exact_margin.py``), which shares no code with jaxgrasp and trusts no solver.
A contradiction is a proved verdict of the other sign, or a proved end of a bracket on the wrong side.
"""

from __future__ import annotations

import importlib
from collections import Counter
from typing import Any

import jax
import numpy as np
from adversarial import MODELS, draw  # it sets the paths and the precision
from figures import parser_of_tables, write_table

import jaxgrasp as jg
from jaxgrasp import Status

ExactMap: Any = importlib.import_module("exact_margin").ExactMap
WIDTHS = (2, 4, 8)
KINDS = ("near critical", "near critical", "box", "tilted")
COLUMNS = (
    "lanes", "proved exactly", "to rounding", "refused", "undecided by the solver", "no full rank in 70 digits",
    "settled in 70 digits", "contradictions",
)  # fmt: skip


def contradicts(grasp: Any, answer, force) -> tuple[bool, bool]:
    """Whether 70 digits settle the lane, and whether they contradict what it says."""
    low, high = grasp.lower(force), grasp.upper(answer.bound_twist)
    status, wrong = int(answer.status), False
    wrong |= status == Status.RESISTANT and high <= 0
    wrong |= status == Status.NOT_RESISTANT and low > 0
    wrong |= float(answer.lower) > high or float(answer.upper) < low
    settled = (status == Status.RESISTANT and low > 0) or (
        status == Status.NOT_RESISTANT and (high <= 0 or grasp.escape_depth(answer.escape_twist) >= 0)
    )
    return settled, bool(wrong)


def measure(model, width: int, kind: str, count: int, chunk: int) -> Counter:
    """One table row's worth of lanes."""
    grasp = model.grasp(*draw(kind, model, width, count, chunk))
    answer = jg.wrench_resistance(grasp)
    proof, out = jg.prove(grasp, answer), Counter(lanes=count)
    names = [c.value for c in grasp.model.components(grasp.dimension)]
    answer: Any = jax.tree.map(np.asarray, answer)
    mu, gamma = np.asarray(grasp.model.friction_coefficient), np.asarray(grasp.model.torsion_coefficient)
    for i in range(count):
        how = Status(int(proof.status[i]))
        out[{23: "proved exactly", 24: "to rounding"}.get(int(how), "refused")] += 1
        out["undecided by the solver"] += int(answer.status[i]) == Status.UNDECIDED
        live = np.asarray(grasp.active[i])
        if int(how) != Status.PROVED_EXACTLY:
            continue
        exact = ExactMap(
            np.asarray(grasp.position[i])[live],
            np.asarray(grasp.normal[i])[live],
            mu[i][live],
            gamma[i][live],
            names,
        )
        if not exact.full_rank:
            out["no full rank in 70 digits"] += 1
            continue
        force = answer.internal_force[i].reshape(len(live), -1)[live]
        settled, wrong = contradicts(exact, answer[i], force)
        out["settled in 70 digits"] += settled
        out["contradictions"] += wrong
    return out


def main() -> None:
    parser = parser_of_tables(__doc__)
    parser.add_argument("--count", type=int, default=100)
    options = parser.parse_args()
    rows = {}
    for model in MODELS:
        for width in WIDTHS:
            found = Counter()
            for chunk, kind in enumerate(KINDS):
                found += measure(model, width, kind, options.count, chunk)
            rows[f"{model.name}, {model.dimension}d, {width} contacts"] = {
                name: found[name] for name in COLUMNS
            }
            print(rows[f"{model.name}, {model.dimension}d, {width} contacts"], flush=True)
    total = {name: sum(row[name] for row in rows.values()) for name in COLUMNS}
    lines = [f"| grasps | {' | '.join(COLUMNS)} |", "|---" * (len(COLUMNS) + 1) + "|"]
    lines += [
        f"| {row} | {' | '.join(str(x) for x in found.values())} |"
        for row, found in (rows | {"all": total}).items()
    ]
    text = "\n".join(lines)
    print(text + "\n")
    write_table(options, text, rows=rows | {"all": total})


if __name__ == "__main__":
    main()
