"""``jaxgrasp place``: parse, call, print."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from .. import jobs
from ..backend import remember_compilations, usable_backend
from ..core import Status
from ..jobs import Placed, PlacePlan, PlaceRequest, draw_best, plan_place
from .options import options
from .terminal import ProgressBar, line, say

__all__ = ["PLACE_HELP", "place"]

SHOWN = 5  # of the best grasps

PLACE_HELP = """Find good grasps of one object: random contacts are moved by gradients to where they hold best.

OBJECT is a mesh file (anything trimesh reads, also .gz) or a built-in object (see [bold]jaxgrasp objects[/bold]). The
best distinct grasps go to a Parquet file that [bold]explain[/bold], [bold]forces[/bold] and [bold]check[/bold] read,
best first, each with a proof. Fingers are points; whether a hand reaches them is not asked.

Examples:

  jaxgrasp place mug

  jaxgrasp place part.stl --unit mm --friction 0.4 --apart 0.015 --edge-clearance 0.003 -o part.parquet

  jaxgrasp place mug --model soft --fingers 2 --jaw-width 0.09 --picture best.png

  jaxgrasp place mug --fingers 4 --objective epsilon --starts 512
"""


PLACE_OPTIONS = {
    "source": typer.Argument(metavar="OBJECT", help="Mesh file or built-in object."),
    "fingers": typer.Option("--fingers", "-k", help="Contacts a grasp, K."),
    "model": typer.Option(help="hard, soft or frictionless."),
    "friction": typer.Option(help="Coulomb coefficient mu >= 0 (default: 0.5)."),
    "torsion": typer.Option(help="gamma >= 0 in m of a soft finger (default: 0.01)."),
    "objective": typer.Option(help="What is maximised: margin, epsilon or epsilon-linf."),
    "starts": typer.Option(help="Grasps to begin with."),
    "candidates": typer.Option(help="Random grasps that each of them is the best of."),
    "steps": typer.Option(help="Gradient steps of each climb at most."),
    "apart": typer.Option(metavar="M", help="Least distance of any two contacts, m."),
    "edge_clearance": typer.Option(metavar="M", help="Least distance of contacts from sharp edges, m."),
    "jaw_width": typer.Option(metavar="M", help="Largest distance of the first two contacts, m."),
    "best": typer.Option(help="Distinct grasps to write at most."),
    "seed": typer.Option(help="The same seed gives the same file."),
    "unit": typer.Option(help="Unit of the mesh file's numbers: m, cm, mm or in. Never guessed."),
    "resolution": typer.Option(
        help="Nodes of the distance grid along the longest side; thin walls need more."
    ),
    "output": typer.Option("--output", "-o", help="Parquet file (default: OBJECT.placed.parquet)."),
    "picture": typer.Option(help="Draw the best grasp to this file (png, svg, pdf)."),
}


@options(PlaceRequest, PLACE_OPTIONS)
def place(request: PlaceRequest) -> None:
    usable_backend(say)
    remember_compilations()
    plan = plan_place(request)
    for warning in plan.body.warnings:
        say(f"warning: {warning}")
    try:
        with ProgressBar(Console(stderr=True), request.starts, Status.RESISTANT, "reading") as bar:
            placed = jobs.place(plan, bar.stage)
    except KeyboardInterrupt:
        say(f"stopped; {plan.output} was not written")
        raise
    for warning in placed.warnings:
        say(f"warning: {warning}")
    draw_best(plan)
    _print_summary(plan, placed)


def _print_summary(plan: PlacePlan, placed: Placed) -> None:
    found, starts, name = placed.placement, plan.request.starts, Path(plan.body.name).name
    table = Table(title=f"{name}: the best of {placed.rows} grasps")
    measures = dict.fromkeys((plan.request.objective, "margin"))  # the margin is not told twice
    for head in ("row", *measures, "margin before"):
        table.add_column(head, justify="right")
    for row, i in enumerate(placed.kept[:SHOWN]):
        values = (found.value[i], float(found.verdict.margin[i]))[: len(measures)]
        before = found.before[found.start[i]]
        table.add_row(str(row), *(f"{x:.4g}" for x in (*values, before)))
    Console().print(table)
    held = int(found.resistant.sum())
    line(f"{held:,} of {starts:,} starts ended wrench resistant ({100 * held / starts:.1f} %)")
    line(f"median margin {_median(found.before):.3f} before, {_median(found.after):.3f} after")
    line(f"proved again in float64 without the solver: {placed.proved:,} of {placed.rows:,}")
    line(f"{placed.seconds:.1f} s with compiling")
    line(f"written to {plan.output}")
    if plan.request.picture is not None:
        line(f"picture: {plan.request.picture}")


def _median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")
