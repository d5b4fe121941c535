"""Damages answers of every kind, field by field, and counts which the checker refuses.

    python benchmarks/mutations.py [--json FILE] [--markdown FILE] [--false 2000] [--lanes 40]

Every change of ``tests/tables/damaged_answers.py`` is made to every field of every kind of answer, on new random
grasps, until ``--false`` damaged answers a field are false by clearly more than rounding. What is false is decided
without the checker (``tests/tables/mutated_kinds.py``). A false answer that is accepted is a hole; what is not clearly
false is counted as still true or undecided.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "tables"))

import jax
import numpy as np
from figures import parser_of_tables, write_table

jax.config.update("jax_enable_x64", True)

damaged: Any = importlib.import_module("damaged_answers")
kinds_of: Any = importlib.import_module("mutated_kinds")
tables: Any = importlib.import_module("force_problems")
CRITERIA, problems, random_grasps = tables.CRITERIA, tables.problems, kinds_of.random_grasps
COLUMNS = ("tried", "false", "refused of the false", "still true or undecided", "of these refused")


def kinds(seed: int, lanes: int) -> Iterator[tuple[str, Any]]:
    """Names of the rows, and the answers to be damaged."""
    rng = np.random.default_rng(seed)
    for model, k in (("soft", 5), ("hard", 3), ("planar", 4), ("frictionless", 8)):
        yield "WrenchResistance", kinds_of.resistance_kind(model, random_grasps(rng, lanes, model, k))
    for criterion, (_, parameter) in CRITERIA.items():
        for limited in (False, True):
            grasp, _, wrench, cap, limit = problems(
                "soft" if limited else "planar hard", limited, lanes, seed
            )
            name = criterion + (", limits" if limited else "")
            yield (
                f"OptimalForces, {name}",
                kinds_of.force_kind(name, grasp, wrench, criterion, parameter, cap, limit),
            )
    for norm in ("L1", "Linf"):
        yield (
            f"EpsilonQuality, {norm}",
            kinds_of.epsilon_kind("planar", random_grasps(rng, min(lanes, 40), "planar", 4), norm),
        )


def main() -> None:
    """Attack, print, write."""
    parser = parser_of_tables(__doc__)
    parser.add_argument("--false", type=int, default=2000)
    parser.add_argument("--lanes", type=int, default=40)
    parser.add_argument("--seconds", type=float, default=540.0, help="no new round of grasps after this long")
    options = parser.parse_args()
    start, seed, rng = time.perf_counter(), 0, np.random.default_rng(1)
    rows: dict[tuple[str, str, str], Counter] = {}
    holes: list[str] = []
    genuine: dict[str, Counter] = {}
    done: Counter = Counter()
    while seed == 0 or (time.perf_counter() - start < options.seconds and min(done.values()) < options.false):
        for row, kind in kinds(seed, options.lanes):
            if seed and min(n for (r, _), n in done.items() if r == row) >= options.false:
                continue
            accepted, status = kind.check(kind.answer), np.asarray(kind.answer.status)
            tally = genuine.setdefault(row, Counter())
            tally.update(lanes=len(status), refused=int((~accepted).sum()))
            tally.update(f"refused with status {s}" for s in status[~accepted])
            for field in (*kind.fields, *(("problem",) if kind.others else ())):
                if done[row, field] >= options.false:
                    continue
                counts, found = (
                    damaged.attack_problem(kind) if field == "problem" else damaged.attack(kind, field, rng)
                )
                if not seed and field != "problem":
                    counts["malformed"], more = damaged.attack_shapes(kind, field)
                    found += more
                for name, count in counts.items():
                    rows.setdefault((row, field, name), Counter()).update(count)
                    done[row, field] += count["false"]
                holes += found
                print("\n".join(found[:5]), end="\n" if found else "", flush=True)
            print(f"{time.perf_counter() - start:6.0f} s  {row}  {len(holes)} holes", flush=True)
        seed += 1
    lines = [
        f"| kind | field | change | {' | '.join(COLUMNS)} |",
        "| --- " * 3 + "| ---: " * len(COLUMNS) + "|",
    ]
    by_field: dict[tuple[str, str], Counter] = {}
    for (row, field, name), count in rows.items():
        by_field.setdefault((row, field), Counter()).update(count)
        lines.append(f"| {row} | {field} | {name} | {' | '.join(str(count[c]) for c in COLUMNS)} |")
    short = [f"| kind | field | {' | '.join(COLUMNS)} |", "| --- " * 2 + "| ---: " * len(COLUMNS) + "|"]
    short += [f"| {r} | {f} | {' | '.join(str(c[x]) for x in COLUMNS)} |" for (r, f), c in by_field.items()]
    untouched = [f"- {row}: {dict(count)}" for row, count in genuine.items()]
    text = "\n".join(
        ["# Damaged answers", "", "`python benchmarks/mutations.py`", "", *short, "", "Genuine answers:", "",
         *untouched, "", f"False answers accepted: {len(holes)}", "", *(f"- {h}" for h in holes[:200]), "", *lines]
    )  # fmt: skip
    print("\n".join(short + untouched + holes[:50]))
    table = [{"kind": r, "field": f, "change": n, **c} for (r, f, n), c in rows.items()]
    write_table(options, text, rows=table, genuine=genuine, holes=holes)


if __name__ == "__main__":
    main()
