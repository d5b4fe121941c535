"""``jaxgrasp place``: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ..core import Status
from .terminal import ProgressBar, say

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


def place(
    source: Annotated[str, typer.Argument(metavar="OBJECT", help="Mesh file or built-in object.")],
    fingers: Annotated[int, typer.Option("--fingers", "-k", help="Contacts a grasp, K.")] = 3,
    model: Annotated[str, typer.Option(help="hard, soft or frictionless.")] = "hard",
    friction: Annotated[
        float | None, typer.Option(help="Coulomb coefficient mu >= 0 (default: 0.5).")
    ] = None,
    torsion: Annotated[
        float | None, typer.Option(help="gamma >= 0 in m of a soft finger (default: 0.01).")
    ] = None,
    objective: Annotated[
        str,
        typer.Option(help="What is maximised: margin, epsilon or epsilon-linf."),
    ] = "margin",
    starts: Annotated[int, typer.Option(help="Grasps to begin with.")] = 256,
    candidates: Annotated[int, typer.Option(help="Random grasps that each of them is the best of.")] = 2048,
    steps: Annotated[int, typer.Option(help="Gradient steps of each climb at most.")] = 150,
    apart: Annotated[
        float | None, typer.Option(metavar="M", help="Least distance of any two contacts, m.")
    ] = None,
    edge_clearance: Annotated[
        float | None, typer.Option(metavar="M", help="Least distance of contacts from sharp edges, m.")
    ] = None,
    jaw_width: Annotated[
        float | None, typer.Option(metavar="M", help="Largest distance of the first two contacts, m.")
    ] = None,
    best: Annotated[int, typer.Option(help="Distinct grasps to write at most.")] = 16,
    seed: Annotated[int, typer.Option(help="The same seed gives the same file.")] = 0,
    unit: Annotated[
        str, typer.Option(help="Unit of the mesh file's numbers: m, cm, mm or in. Never guessed.")
    ] = "m",
    resolution: Annotated[
        int, typer.Option(help="Nodes of the distance grid along the longest side; thin walls need more.")
    ] = 96,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Parquet file (default: OBJECT.placed.parquet).")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Draw the best grasp to this file (png, svg, pdf).")
    ] = None,
) -> None:
    from ..backend import remember_compilations, usable_backend
    from ..jobs import PlaceRequest, draw_best, prepare_place
    from ..jobs import place as start

    usable_backend(say)
    remember_compilations()
    run = prepare_place(
        PlaceRequest(
            source, output, unit, fingers, model, friction, torsion, objective, starts, steps, candidates, apart,
            edge_clearance, jaw_width, best, seed, resolution, picture,
        )
    )  # fmt: skip
    for warning in run.warnings:
        say(f"warning: {warning}")
    try:
        with ProgressBar(Console(stderr=True), starts, Status.RESISTANT, "reading") as bar:
            placed = start(run, bar.stage)
    except KeyboardInterrupt:
        say(f"stopped; {run.output} was not written")
        raise
    for warning in placed.warnings:
        say(f"warning: {warning}")
    draw_best(run)
    _print_summary(Console(), run, placed)


def _print_summary(console: Console, run, placed) -> None:
    found, starts, name = placed.placement, run.request.starts, Path(run.body.name).name

    def line(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True, markup=False)

    table = Table(title=f"{name}: the best of {placed.rows} grasps")
    measures = dict.fromkeys((run.request.objective, "margin"))  # the margin is not told twice
    for head in ("row", *measures, "margin before"):
        table.add_column(head, justify="right")
    for row, i in enumerate(placed.kept[:SHOWN]):
        values = (found.value[i], float(found.verdict.margin[i]))[: len(measures)]
        before = found.before[found.start[i]]
        table.add_row(str(row), *(f"{x:.4g}" for x in (*values, before)))
    console.print(table)
    held = int(found.resistant.sum())
    line(f"{held:,} of {starts:,} starts ended wrench resistant ({100 * held / starts:.1f} %)")
    line(f"median margin {_median(found.before):.3f} before, {_median(found.after):.3f} after")
    line(f"proved again in float64 without the solver: {placed.proved:,} of {placed.rows:,}")
    line(f"{placed.seconds:.1f} s with compiling")
    line(f"written to {run.output}")
    if run.request.picture is not None:
        line(f"picture: {run.request.picture}")


def _median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")
