"""``jaxgrasp screen``: parse, call, print."""

from __future__ import annotations

from pathlib import Path

import typer
from rich.console import Console

from .. import jobs
from ..backend import precision, remember_compilations, usable_backend
from ..core import Status
from ..jobs import ScreenPlan, ScreenRequest, Summary, plan_screen
from .options import Vector, options
from .terminal import ProgressBar, counts, quantiles, resumable, say, speed

__all__ = ["SCREEN_HELP", "screen"]

SCREEN_HELP = """Screen many candidate grasps of one object and write a verdict for each.

OBJECT is a mesh file (anything trimesh reads, also .gz), a built-in object (see [bold]jaxgrasp
objects[/bold]) or a Parquet file of contacts with the columns position and normal.

Examples:

  jaxgrasp screen mug

  jaxgrasp screen part.stl --unit mm --fingers 3 --friction 0.4 --samples 1000000 -o part.parquet

  jaxgrasp screen mug --model soft --fingers 2 --torsion 0.005

  jaxgrasp screen contacts.parquet --com 0,0,0.05 --friction 0.6
"""

SCREEN_OPTIONS = {
    "source": typer.Argument(metavar="OBJECT", help="Mesh file, built-in object, or Parquet file."),
    "fingers": typer.Option("--fingers", "-k", help="Contacts a grasp, K (default: 4)."),
    "model": typer.Option(help="hard, soft or frictionless (default: hard)."),
    "friction": typer.Option(help="Coulomb coefficient mu >= 0 (default: 0.5)."),
    "torsion": typer.Option(
        help="gamma >= 0 in m of a soft finger: its torque is at most gamma f_n (default: 0.01)."
    ),
    "samples": typer.Option("--samples", "-n", help="Candidates (default: 100000)."),
    "seed": typer.Option(help="The same seed gives the same file."),
    "unit": typer.Option(help="Unit of the mesh file's numbers: m, cm, mm or in. Never guessed."),
    "com": Vector(
        typer.Option(metavar="X,Y,Z", help="Centre of mass in m, mesh frame (default: the mesh's)."),
        (3,),
        "three numbers x,y,z in m without spaces, such as 0,0,0.05",
    ),
    "dtype": typer.Option(help="float64, or float32: faster, less certain near margin 0."),
    "output": typer.Option("--output", "-o", help="Parquet file (default: OBJECT.grasps.parquet)."),
    "resume": typer.Option("--resume", help="Go on with an unfinished run of the same options."),
    "verdict_only": typer.Option(
        "--verdict-only", help="Stop at the first proof; the margin is then only a bound."
    ),
    "tolerance": typer.Option(help="Largest gap of a margin."),
    "sampler": typer.Option(
        help="surface, antipodal, or auto: antipodal for two soft fingers, else surface."
    ),
    "filter": typer.Option(
        "--filter", help="Leave hopeless candidates out before solving; says how many and why."
    ),
    "chunk": typer.Option(help="Grasps solved together; memory grows with it."),
    "threads": typer.Option(help="Chunks worked on at a time (default: 2, or 1 on one core)."),
}


@options(ScreenRequest, SCREEN_OPTIONS)
def screen(request: ScreenRequest, resume: bool = False) -> None:
    usable_backend(say)
    remember_compilations()
    with precision(request.dtype):
        plan = plan_screen(request)
        for warning in plan.candidates.warnings:
            say(f"warning: {warning}")
        with (
            resumable(plan.output, resume),
            ProgressBar(Console(stderr=True), plan.candidates.count, Status.RESISTANT, "sampling") as bar,
        ):
            summary = jobs.screen(plan, resume, bar.show)
    _print_summary(summary, plan)


def _print_summary(summary: Summary, plan: ScreenPlan) -> None:
    console = Console()
    about = plan.metadata.get("contacts") or plan.metadata["object"]
    name = Path(about["name"]).name
    console.print(counts(summary, f"{name}: {summary.rows:,} grasps", "verdict"))
    console.print(
        quantiles(summary, "margin (a lower bound)" if plan.request.verdict_only else "margin", ".3f")
    )
    if summary.solved:
        console.print(speed(summary), highlight=False, soft_wrap=True)
    if summary.resumed:
        console.print(f"{summary.resumed:,} candidates were already done", highlight=False)
    console.print(f"written to {plan.output}", highlight=False, soft_wrap=True)
