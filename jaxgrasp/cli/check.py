"""``jaxgrasp check``: parse, call, print."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from .. import jobs
from ..backend import precision, remember_compilations, usable_backend
from ..core import Status, UserError
from ..formats import read_check_columns
from ..jobs import CheckPlan, CheckRequest, controllability_of, plan_check
from ..report import explain_controllability, status_words
from .options import Vector, options
from .terminal import ProgressBar, line, resumable, say

__all__ = ["CHECK_HELP", "check"]

CHECK_HELP = """Check grasps in motion: controllable? brought back by a controller after six pushes?

SOURCE is a file that [bold]jaxgrasp screen[/bold] wrote, a mesh file or a built-in object. Each push has half the
weight and lasts 50 ms. Wrench resistant grasps are held by computed torque, those that are only controllable by a
linear-quadratic regulator; contact forces always stay in their friction cones.

Examples:

  jaxgrasp check mug.grasps.parquet --mass 0.3 -o checked.parquet

  jaxgrasp check mug --mass 0.3 --fingers 3 --most 100

  jaxgrasp check mug.grasps.parquet --mass 0.3 --row 282 --most 300
"""


CHECK_OPTIONS = {
    "source": typer.Argument(metavar="SOURCE", help="Parquet file of grasps, mesh file, or built-in object."),
    "mass": typer.Option(metavar="KG", help="The object's mass; its inertia is the mesh's."),
    "gravity": Vector(
        typer.Option(metavar="X,Y,Z", help="Gravity in m/s^2, in the mesh's frame."),
        (3,),
        "three numbers x,y,z in m/s^2 without spaces, such as 0,0,-9.81",
    ),
    "most": typer.Option(help="Check at most this many grasps, the first ones."),
    "chunk": typer.Option(help="Grasps checked together; memory grows with it."),
    "resume": typer.Option("--resume", help="Go on with an unfinished run of the same options."),
    "row": typer.Option("--row", help="Say this row in words, too."),
    "fingers": typer.Option("--fingers", "-k", help="Of sampled grasps (default: 4)."),
    "model": typer.Option(help="hard, soft or frictionless (default: hard)."),
    "friction": typer.Option(help="Coulomb coefficient mu (default: 0.5)."),
    "torsion": typer.Option(help="gamma in m of a soft finger (default: 0.01)."),
    "seed": typer.Option(help="Of sampled grasps."),
    "unit": typer.Option(help="Unit of the mesh file's numbers: m, cm, mm or in."),
    "object": typer.Option("--object", help="The mesh, if it is not where the run found it."),
    "output": typer.Option("--output", "-o", help="Parquet file (default: SOURCE.check.parquet)."),
}


@options(CheckRequest, CHECK_OPTIONS)
def check(request: CheckRequest, resume: bool = False, row: int | None = None) -> None:
    usable_backend(say)
    remember_compilations()
    with precision("float64"):
        plan = plan_check(request)
        for warning in plan.warnings:
            say(f"warning: {warning}")
        if row is not None and not 0 <= row < plan.count:
            raise UserError(f"rows 0 to {plan.count - 1} are checked, there is no row {row}; see --most")
        with (
            resumable(plan.output, resume),
            ProgressBar(Console(stderr=True), plan.count, Status.RESISTANT, "reading") as bar,
        ):
            summary = jobs.check(plan, resume, bar.show)
        found = None if row is None else controllability_of(plan, row)
    _print_summary(plan, Path(request.source).name)
    if found is not None:
        words = explain_controllability(found, 0, plan.grasps.candidates.centre_of_mass)
        line(f"Row {row}: {words}")
    if summary.resumed:
        Console().print(f"{summary.resumed:,} grasps were already done", highlight=False)
    line(f"written to {plan.output}")


def _print_summary(plan: CheckPlan, name: str) -> None:
    console, columns = Console(), read_check_columns(plan.output)
    console.print(_counts(columns, f"{name}: {plan.count:,} grasps"))
    back = columns["recovered"]
    if back.any():
        console.print(_worst(columns, back))


# The answers of a check, best first.
CHECKED = (
    Status.RESISTANT,
    Status.CONTROLLABLE,
    Status.MARGINAL,
    Status.NOT_CONTROLLABLE,
    Status.NO_EQUILIBRIUM,
    Status.UNDECIDED,
    Status.INVALID,
)


def _counts(columns: dict[str, np.ndarray], title: str) -> Table:
    table = Table(title=title)
    table.add_column("controllability")
    for head in ("grasps", "share", "recovered"):
        table.add_column(head, justify="right")
    total = len(columns["verdict"])
    for verdict in CHECKED:
        here = columns["verdict"] == verdict.value
        if here.any():
            back = int(columns["recovered"][here].sum())
            known = verdict in (Status.RESISTANT, Status.CONTROLLABLE)
            table.add_row(
                status_words(verdict),
                f"{here.sum():,}",
                f"{100 * here.sum() / total:.2f} %",
                f"{back:,}" if known else "",
            )
    return table


def _worst(columns: dict[str, np.ndarray], back: np.ndarray) -> Table:
    table = Table(title="where recovered")
    for head in ("", "least", "median", "largest"):
        table.add_column(head, justify="right" if head else "left")
    for name, words in (
        ("settling_time", "settling time (s)"),
        ("peak_force", "largest normal force (N)"),
        ("cone_use", "friction used"),
    ):
        values = columns[name][back]
        table.add_row(words, *(f"{x:.3g}" for x in (values.min(), np.median(values), values.max())))
    return table
