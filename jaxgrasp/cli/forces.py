"""``jaxgrasp forces``: parse, call, print."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from ..core import Status
from .terminal import ProgressBar, counts, numbers, quantiles, say, speed

__all__ = ["FORCES_HELP", "explain_forces", "forces"]

FORCES_HELP = """Find the least contact forces with which grasps hold a load, or say why they cannot.

SOURCE is a file that [bold]jaxgrasp screen[/bold] wrote, or one grasp that jaxgrasp.save_grasp wrote. One grasp is
answered in words; many go to a Parquet file, a row each, with a bound or a motion that proves every answer.

Examples:

  jaxgrasp forces mug.grasps.parquet --mass 0.3 --gravity 0,0,-1 -o forces.parquet

  jaxgrasp forces mug.grasps.parquet --row 282 --mass 0.3 --criterion robust --weight 0.1

  jaxgrasp forces mug.grasps.parquet --status resistant --wrench 0,0,-3,0,0.02,0 --max-normal 20

  jaxgrasp forces lane.npz --wrench 0,0,-3,0,0,0 --criterion least-norm
"""


def forces(
    source: Annotated[
        str,
        typer.Argument(metavar="SOURCE", help="Parquet file of screened grasps, or an .npz of save_grasp."),
    ],
    mass: Annotated[
        float | None, typer.Option(metavar="KG", help="The object's mass: its weight is the load.")
    ] = None,
    gravity: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z", help="Where down is, in the mesh's frame; any length (default: 0,0,-1)."
        ),
    ] = None,
    g: Annotated[float | None, typer.Option("--g", help="Gravity in m/s^2 (default: 9.81).")] = None,
    wrench: Annotated[
        str | None,
        typer.Option(
            metavar="FX,FY,FZ,TX,TY,TZ",
            help="Instead of a mass: force in N and torque in N m about the centre of mass, mesh axes.",
        ),
    ] = None,
    criterion: Annotated[
        str, typer.Option(help="gentlest, robust, smallest-sum, sum-of-squares or least-norm.")
    ] = "gentlest",
    weight: Annotated[
        float | None,
        typer.Option(help="N, of robust: how much a distance from slipping is worth (default: 1)."),
    ] = None,
    length: Annotated[
        float | None, typer.Option(help="m, of least-norm: what a soft finger's torque is divided by.")
    ] = None,
    max_normal: Annotated[
        float | None,
        typer.Option("--max-normal", help="Largest normal force of a contact, N (default: none)."),
    ] = None,
    row: Annotated[int | None, typer.Option("--row", help="One grasp only: its row, from 0.")] = None,
    status: Annotated[
        str | None,
        typer.Option(
            help="Only rows with this verdict: resistant, not-resistant, marginal .. (default: all)."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Parquet file (default: SOURCE.forces.parquet; one grasp: none)."
        ),
    ] = None,
    tolerance: Annotated[float, typer.Option(help="Largest gap of a cost, relative.")] = 1e-8,
    chunk: Annotated[int, typer.Option(help="Grasps solved together; memory grows with it.")] = 65536,
    threads: Annotated[
        int | None, typer.Option(help="Chunks worked on at a time (default: 2, or 1 on one core).")
    ] = None,
) -> None:
    from ..backend import precision, remember_compilations, usable_backend
    from ..jobs import LoadRequest, balance_many, balance_one, prepare_load
    from ..report import load_words

    down = numbers(gravity, "--gravity", (2, 3), "a direction x,y,z without spaces, such as 0,0,-1")
    pull = numbers(
        wrench, "--wrench", (3, 6), "six numbers fx,fy,fz,tx,ty,tz without spaces (fx,fy,t in the plane)"
    )
    usable_backend(say)
    remember_compilations()
    workers = min(2, os.cpu_count() or 1) if threads is None else threads
    request = LoadRequest(
        source, output, row, status, mass, down, g, pull, criterion, weight, length, max_normal, tolerance, chunk,
        workers,
    )  # fmt: skip
    with precision("float64"):
        run = prepare_load(request)
        console = Console()
        if run.load.assumed:
            axis = "z" if run.dimension == 3 else "y"
            say(f"down is taken to be -{axis} of the mesh's frame; --gravity says otherwise")
        if run.row is not None:
            values, proved = balance_one(run)
            _print_one(f"Row {run.row} of {source}", values, run.metadata, proved)
            if run.output is not None:
                _line(console, f"written to {run.output}")
            return
        _line(console, load_words(run.load.metadata))
        try:
            with ProgressBar(Console(stderr=True), run.rows, Status.OPTIMAL, "reading") as bar:
                summary = balance_many(run, bar.show)
        except KeyboardInterrupt:
            say(f"stopped; {run.output} was not written")
            raise
    _print_many(console, summary, run)


def _line(console: Console, text: str) -> None:
    console.print(text, highlight=False, soft_wrap=True, markup=False)


def _print_many(console: Console, summary, run) -> None:
    about, name = run.metadata["criterion"], Path(run.metadata["contacts"]["name"]).name
    console.print(counts(summary, f"{name}: {summary.rows:,} grasps", "answer"))
    if summary.counts.get(Status.OPTIMAL):
        console.print(quantiles(summary, f"cost in {about['unit']} ({about['name']}), where optimal", ".4g"))
    claims = sum(summary.counts.get(status, 0) for status in (Status.OPTIMAL, Status.INFEASIBLE))
    _line(console, f"proved again in float64 without the solver: {summary.proved:,} of {claims:,}")
    _line(console, speed(summary))
    _line(console, f"written to {run.output}")


def _print_one(title: str, values: dict, metadata: dict, proved: bool) -> None:
    from ..report import ForceAnswer, contact_rows, cost_words, infeasible_words, load_words

    answer = ForceAnswer.from_row(values, metadata)
    console = Console()
    _line(console, f"{title} (grasp {answer.grasp_id}, {answer.model} contacts):")
    _line(console, load_words(answer.load))
    _line(console, answer.status.sentence)
    heads, rows = contact_rows(answer)
    if rows:
        table = Table(box=box.SIMPLE_HEAD)
        for head in heads:
            table.add_column(head, justify="right", no_wrap=True)
        for words in rows:
            table.add_row(*words)
        console.print(table)
    if answer.status in (Status.OPTIMAL, Status.STALLED):
        _line(console, cost_words(answer))
    for line in infeasible_words(answer) if answer.escape_twist is not None else ():
        _line(console, line)
    if answer.status in (Status.OPTIMAL, Status.INFEASIBLE):
        words = "the proof holds." if proved else "the stored evidence does NOT prove it."
        _line(console, f"Checked again in float64: {words}")


def explain_forces(file: Path, row: int) -> None:
    """Say row ``row`` of a file of forces in words, and check its proof again from the file alone."""
    from ..formats import read_force_row
    from ..report import ForceAnswer, reprove_forces

    values, metadata = read_force_row(file, row)
    proved = reprove_forces(ForceAnswer.from_row(values, metadata))
    _print_one(f"Row {row} of {file}", values, metadata, proved)
