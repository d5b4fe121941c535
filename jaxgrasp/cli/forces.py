"""``jaxgrasp forces``: parse, call, print."""

from __future__ import annotations

from pathlib import Path

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from ..backend import precision, remember_compilations, usable_backend
from ..core import Status
from ..formats import read_force_row
from ..jobs import ForcesPlan, ForcesRequest, ForceSummary, forces_of_file, forces_of_row, plan_forces
from ..report import ForceAnswer, contact_rows, cost_words, infeasible_words, load_words, reprove_forces
from .options import Vector, options
from .terminal import ProgressBar, counts, line, quantiles, say, speed

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


FORCES_OPTIONS = {
    "source": typer.Argument(
        metavar="SOURCE", help="Parquet file of screened grasps, or an .npz of save_grasp."
    ),
    "mass": typer.Option(metavar="KG", help="The object's mass: its weight is the load."),
    "gravity": Vector(
        typer.Option(
            metavar="X,Y,Z", help="Where down is, in the mesh's frame; any length (default: 0,0,-1)."
        ),
        (2, 3),
        "a direction x,y,z without spaces, such as 0,0,-1",
    ),
    "g": typer.Option("--g", help="Gravity in m/s^2 (default: 9.81)."),
    "wrench": Vector(
        typer.Option(
            metavar="FX,FY,FZ,TX,TY,TZ",
            help="Instead of a mass: force in N and torque in N m about the centre of mass, mesh axes.",
        ),
        (3, 6),
        "six numbers fx,fy,fz,tx,ty,tz without spaces (fx,fy,t in the plane)",
    ),
    "criterion": typer.Option(help="gentlest, robust, smallest-sum, sum-of-squares or least-norm."),
    "weight": typer.Option(help="N, of robust: how much a distance from slipping is worth (default: 1)."),
    "length": typer.Option(help="m, of least-norm: what a soft finger's torque is divided by."),
    "max_normal": typer.Option("--max-normal", help="Largest normal force of a contact, N (default: none)."),
    "row": typer.Option("--row", help="One grasp only: its row, from 0."),
    "status": typer.Option(
        help="Only rows with this verdict: resistant, not-resistant, marginal .. (default: all)."
    ),
    "output": typer.Option(
        "--output", "-o", help="Parquet file (default: SOURCE.forces.parquet; one grasp: none)."
    ),
    "tolerance": typer.Option(help="Largest gap of a cost, relative."),
    "chunk": typer.Option(help="Grasps solved together; memory grows with it."),
    "threads": typer.Option(help="Chunks worked on at a time (default: 2, or 1 on one core)."),
}


@options(ForcesRequest, FORCES_OPTIONS)
def forces(request: ForcesRequest) -> None:
    usable_backend(say)
    remember_compilations()
    with precision("float64"):
        plan = plan_forces(request)
        if plan.load.assumed:
            axis = "z" if plan.source.dimension == 3 else "y"
            say(f"down is taken to be -{axis} of the mesh's frame; --gravity says otherwise")
        if plan.selection.row is not None:
            _say_one(plan)
        else:
            _solve_all(plan)


def _say_one(plan: ForcesPlan) -> None:
    values, proved = forces_of_row(plan)
    _print_one(f"Row {plan.selection.row} of {plan.request.source}", values, plan.metadata, proved)
    if plan.output is not None:
        line(f"written to {plan.output}")


def _solve_all(plan: ForcesPlan) -> None:
    line(load_words(plan.load.metadata))
    try:
        with ProgressBar(Console(stderr=True), plan.selection.count, Status.OPTIMAL, "reading") as bar:
            summary = forces_of_file(plan, bar.show)
    except KeyboardInterrupt:
        say(f"stopped; {plan.output} was not written")
        raise
    _print_many(summary, plan)


def _print_many(summary: ForceSummary, plan: ForcesPlan) -> None:
    console = Console()
    about, name = plan.metadata["criterion"], Path(plan.metadata["contacts"]["name"]).name
    console.print(counts(summary, f"{name}: {summary.rows:,} grasps", "answer"))
    if summary.counts.get(Status.OPTIMAL):
        console.print(quantiles(summary, f"cost in {about['unit']} ({about['name']}), where optimal", ".4g"))
    claims = sum(summary.counts.get(status, 0) for status in (Status.OPTIMAL, Status.INFEASIBLE))
    line(f"proved again in float64 without the solver: {summary.proved:,} of {claims:,}")
    line(speed(summary))
    line(f"written to {plan.output}")


def _print_one(title: str, values: dict, metadata: dict, proved: bool) -> None:
    answer = ForceAnswer.from_row(values, metadata)
    line(f"{title} (grasp {answer.grasp_id}, {answer.model} contacts):")
    line(load_words(answer.load))
    line(answer.status.sentence)
    heads, rows = contact_rows(answer)
    if rows:
        table = Table(box=box.SIMPLE_HEAD)
        for head in heads:
            table.add_column(head, justify="right", no_wrap=True)
        for words in rows:
            table.add_row(*words)
        Console().print(table)
    if answer.status in (Status.OPTIMAL, Status.STALLED):
        line(cost_words(answer))
    for words in infeasible_words(answer) if answer.escape_twist is not None else ():
        line(words)
    if answer.status in (Status.OPTIMAL, Status.INFEASIBLE):
        words = "the proof holds." if proved else "the stored evidence does NOT prove it."
        line(f"Checked again in float64: {words}")


def explain_forces(file: Path, row: int) -> None:
    """Say row ``row`` of a file of forces in words, and check its proof again from the file alone."""
    values, metadata = read_force_row(file, row)
    proved = reprove_forces(ForceAnswer.from_row(values, metadata))
    _print_one(f"Row {row} of {file}", values, metadata, proved)
