"""``jaxgrasp check``: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ..core import Status
from .terminal import ProgressBar, numbers, say

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


def check(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="Parquet file of grasps, mesh file, or built-in object.")
    ],
    mass: Annotated[float, typer.Option(metavar="KG", help="The object's mass; its inertia is the mesh's.")],
    gravity: Annotated[
        str, typer.Option(metavar="X,Y,Z", help="Gravity in m/s^2, in the mesh's frame.")
    ] = "0,0,-9.81",
    most: Annotated[int, typer.Option(help="Check at most this many grasps, the first ones.")] = 256,
    chunk: Annotated[int, typer.Option(help="Grasps checked together; memory grows with it.")] = 256,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with an unfinished run of the same options.")
    ] = False,
    row: Annotated[int | None, typer.Option("--row", help="Say this row in words, too.")] = None,
    fingers: Annotated[
        int | None, typer.Option("--fingers", "-k", help="Of sampled grasps (default: 4).")
    ] = None,
    model: Annotated[str | None, typer.Option(help="hard, soft or frictionless (default: hard).")] = None,
    friction: Annotated[float | None, typer.Option(help="Coulomb coefficient mu (default: 0.5).")] = None,
    torsion: Annotated[
        float | None, typer.Option(help="gamma in m of a soft finger (default: 0.01).")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of sampled grasps.")] = 0,
    unit: Annotated[str, typer.Option(help="Unit of the mesh file's numbers: m, cm, mm or in.")] = "m",
    object: Annotated[
        str | None, typer.Option("--object", help="The mesh, if it is not where the run found it.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Parquet file (default: SOURCE.check.parquet).")
    ] = None,
) -> None:
    from ..backend import precision, remember_compilations, usable_backend
    from ..core import UserError
    from ..jobs import CheckRequest, Request, checked_columns, controllability_of, prepare_check
    from ..jobs import check as start
    from ..report import explain_controllability

    down = numbers(
        gravity, "--gravity", (3,), "three numbers x,y,z in m/s^2 without spaces, such as 0,0,-9.81"
    )
    assert down is not None
    usable_backend(say)
    remember_compilations()
    grasps = Request(
        source, None, fingers, model, friction, torsion, seed=seed, unit=unit, chunk=min(chunk, most)
    )
    with precision("float64"):
        run = prepare_check(CheckRequest(grasps, mass, (down[0], down[1], down[2]), object, most, output))
        for warning in run.warnings:
            say(f"warning: {warning}")
        if row is not None and not 0 <= row < run.count:
            raise UserError(f"rows 0 to {run.count - 1} are checked, there is no row {row}; see --most")
        try:
            with ProgressBar(Console(stderr=True), run.count, Status.RESISTANT, "reading") as bar:
                summary = start(run, resume, bar.show)
        except KeyboardInterrupt:
            again = "" if resume else " and --resume"
            say(f"stopped; the finished part is in {run.output}.parts: go on with the same command{again}")
            raise
        found = None if row is None else controllability_of(run, row)
    console, columns = Console(), checked_columns(run.output)
    console.print(_counts(columns, f"{Path(source).name}: {run.count:,} grasps"))
    back = columns["recovered"]
    if back.any():
        console.print(_worst(columns, back))
    if found is not None:
        words = explain_controllability(found, 0, run.run.centre_of_mass)
        console.print(f"Row {row}: {words}", highlight=False, soft_wrap=True, markup=False)
    if summary.resumed:
        console.print(f"{summary.resumed:,} grasps were already done", highlight=False)
    console.print(f"written to {run.output}", highlight=False, soft_wrap=True, markup=False)


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
            words = verdict.name.replace("_", " ").lower()
            table.add_row(
                words, f"{here.sum():,}", f"{100 * here.sum() / total:.2f} %", f"{back:,}" if known else ""
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
