"""Verdicts, brackets and costs against 70 decimal digits, on problems drawn towards the boundary between yes and no.

    python benchmarks/independent_truth.py [--json FILE] [--markdown FILE] [--count 100] [--forces 400]

``--count`` grasps for each contact model and 2, 4 and 8 contacts, with friction within 1e-3 to 1e-9 of the critical one
(frictionless grasps as they come), and as many of the kinds of ``tests/tables/grasps.py``. The margin t* is enclosed by
weak duality in 70 digits (``tests/tables/exact_margin.py``), which shares no code with jaxgrasp and trusts no solver.
A contradiction is a proved verdict of the other sign, or a proved end of a bracket on the wrong side.

Then ``--forces`` problems of ``tests/tables/force_problems.py`` for each contact model, with the gentlest forces and
with the smallest sum: loads inside the cones, on their edge, just beyond it. The cost is enclosed in 70 digits
(``tests/tables/exact_forces.py``). A contradiction is a bound above it or a cost below it, and a load called INFEASIBLE
that a grasp that holds every load, in 70 digits, can hold.
"""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from adversarial import MODELS, draw  # it sets the paths and the precision
from figures import parser_of_tables, write_table

import jaxgrasp as jg
from jaxgrasp import Status

exact_map: Any = importlib.import_module("mutated_kinds").exact_map
ExactForces: Any = importlib.import_module("exact_forces").ExactForces
force_problems: Any = importlib.import_module("force_problems")
WIDTHS = (2, 4, 8)
TIGHT = 1e-6  # of the cost: a wider enclosure settles nothing
NOTHING = float("inf")
SAID = {Status.PROVED_EXACTLY.value: "proved exactly", Status.PROVED_TO_ROUNDING.value: "to rounding"}
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


def proved_lanes(
    grasp: jg.Grasp, status, proof, open_: Status, out: Counter
) -> Iterator[tuple[int, Any, Any]]:
    """Lanes proved exactly whose rank is full: index, map in 70 digits, and a function that gives a force by contact.

    The others are counted only; ``open_`` is the status of an answer that decides nothing.
    """
    for i in range(len(status)):
        out[SAID.get(int(proof.status[i]), "refused")] += 1
        out["undecided by the solver"] += int(status[i]) == open_
        if int(proof.status[i]) != Status.PROVED_EXACTLY:
            continue
        exact, live = exact_map(grasp, i), np.asarray(grasp.active[i])
        if exact.full_rank:
            yield i, exact, lambda force, i=i, live=live: force[i].reshape(len(live), -1)[live]
        else:
            out["no full rank in 70 digits"] += 1


def measure(model, width: int, kind: str, count: int, chunk: int) -> Counter:
    """One table row's worth of lanes."""
    grasp = model.grasp(*draw(kind, model, width, count, chunk))
    answer = jg.wrench_resistance(grasp)
    proof, out = jg.prove(grasp, answer), Counter(lanes=count)
    answer: Any = jax.tree.map(np.asarray, answer)
    for i, exact, by_contact in proved_lanes(grasp, answer.status, proof, Status.UNDECIDED, out):
        settled, wrong = contradicts(exact, answer[i], by_contact(answer.internal_force))
        out["settled in 70 digits"] += settled
        out["contradictions"] += wrong
    return out


def measure_forces(name: str, criterion: str, count: int) -> Counter:
    """The same of optimal forces."""
    grasp, _, wrench, _, _ = force_problems.problems(name, False, count, seed=5)
    make, parameter = force_problems.CRITERIA[criterion]
    asked = {"wrench": wrench, "criterion": make(parameter)}
    forces = jg.optimize_forces(grasp, **asked)
    proof, out = jg.prove(grasp, forces, **asked), Counter(lanes=count)
    answer, held = (jax.tree.map(np.asarray, x) for x in (forces, jg.wrench_resistance(grasp)))
    for i, exact, by_contact in proved_lanes(grasp, answer.status, proof, Status.STALLED, out):
        truth, internal = ExactForces(exact, wrench[i], criterion), by_contact(held.internal_force)
        if int(answer.status[i]) == Status.INFEASIBLE:
            out["settled in 70 digits"] += truth.below(answer.escape_twist[i]) > 10**6
            out["contradictions"] += exact.lower(internal) > 0
            continue
        high, low = truth.above(by_contact(answer.force), internal), truth.below(answer.load_twist[i])
        out["settled in 70 digits"] += high < NOTHING and float(high - low) <= TIGHT * abs(float(high))
        out["contradictions"] += bool(float(proof.lower[i]) > high or float(proof.upper[i]) < low)
    return out


def main() -> None:
    parser = parser_of_tables(__doc__)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--forces", type=int, default=400)
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
    for name in ("soft", "hard", "planar hard"):
        for criterion in ("gentlest", "smallest sum"):
            found = measure_forces(name, criterion, options.forces)
            rows[f"{criterion}, {name}"] = {column: found[column] for column in COLUMNS}
            print(rows[f"{criterion}, {name}"], flush=True)
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
