"""The command line: parse, call, print. ``jaxgrasp screen``, ``explain``, ``objects`` (others: ``cli_*``)."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from ..core import UserError
from .check import CHECK_HELP, check
from .forces import FORCES_HELP, explain_forces, forces
from .place import PLACE_HELP, place
from .terminal import ProgressBar, counts, numbers, quantiles, say, speed

__all__ = ["app", "main"]

app = typer.Typer(
    name="jaxgrasp",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Does this grasp hold? Wrench resistance (force closure) of many grasps at once, with proofs.",
)

SCREEN_HELP = """Screen many candidate grasps of one object and write a verdict for each.

OBJECT is a mesh file (anything trimesh reads, also .gz), a built-in object (see [bold]jaxgrasp
objects[/bold]) or a Parquet file of contacts with the columns position and normal.

Examples:

  jaxgrasp screen mug

  jaxgrasp screen part.stl --unit mm --fingers 3 --friction 0.4 --samples 1000000 -o part.parquet

  jaxgrasp screen mug --model soft --fingers 2 --torsion 0.005

  jaxgrasp screen contacts.parquet --com 0,0,0.05 --friction 0.6
"""

EXPLAIN_HELP = """Say one grasp's verdict in words: the forces that hold the object, or the way it escapes.

ROW counts from 0.

Examples:

  jaxgrasp explain mug.grasps.parquet 17

  jaxgrasp explain mug.grasps.parquet 17 --picture grasp.png

  jaxgrasp explain forces.parquet 17
"""


def _version(wanted: bool) -> None:
    if wanted:
        from ..core import __version__

        print(f"jaxgrasp {__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@app.command(help=SCREEN_HELP)
def screen(
    source: Annotated[
        str, typer.Argument(metavar="OBJECT", help="Mesh file, built-in object, or Parquet file.")
    ],
    fingers: Annotated[
        int | None, typer.Option("--fingers", "-k", help="Contacts a grasp, K (default: 4).")
    ] = None,
    model: Annotated[str | None, typer.Option(help="hard, soft or frictionless (default: hard).")] = None,
    friction: Annotated[
        float | None, typer.Option(help="Coulomb coefficient mu >= 0 (default: 0.5).")
    ] = None,
    torsion: Annotated[
        float | None,
        typer.Option(
            help="gamma >= 0 in m of a soft finger: its torque is at most gamma f_n (default: 0.01)."
        ),
    ] = None,
    samples: Annotated[
        int | None, typer.Option("--samples", "-n", help="Candidates (default: 100000).")
    ] = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same file.")] = 0,
    unit: Annotated[
        str, typer.Option(help="Unit of the mesh file's numbers: m, cm, mm or in. Never guessed.")
    ] = "m",
    com: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Centre of mass in m, mesh frame (default: the mesh's)."),
    ] = None,
    dtype: Annotated[
        str, typer.Option(help="float64, or float32: faster, less certain near margin 0.")
    ] = "float64",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Parquet file (default: OBJECT.grasps.parquet).")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with an unfinished run of the same options.")
    ] = False,
    verdict_only: Annotated[
        bool, typer.Option("--verdict-only", help="Stop at the first proof; the margin is then only a bound.")
    ] = False,
    tolerance: Annotated[float, typer.Option(help="Largest gap of a margin.")] = 1e-8,
    sampler: Annotated[
        str, typer.Option(help="surface, antipodal, or auto: antipodal for two soft fingers, else surface.")
    ] = "auto",
    filter: Annotated[
        bool,
        typer.Option("--filter", help="Leave hopeless candidates out before solving; says how many and why."),
    ] = False,
    chunk: Annotated[int, typer.Option(help="Grasps solved together; memory grows with it.")] = 65536,
    threads: Annotated[
        int | None, typer.Option(help="Chunks worked on at a time (default: 2, or 1 on one core).")
    ] = None,
) -> None:
    from ..backend import precision, remember_compilations, usable_backend
    from ..core import Status
    from ..jobs import Request, prepare_screen
    from ..jobs import screen as start

    centre = numbers(com, "--com", (3,), "three numbers x,y,z in m without spaces, such as 0,0,0.05")
    if threads is not None and threads < 1:
        raise UserError(f"--threads must be at least 1, got {threads}")
    usable_backend(say)
    remember_compilations()
    request = Request(
        source, output, fingers, model, friction, torsion, samples, seed, unit, centre, dtype, tolerance,
        verdict_only, sampler, filter, chunk, threads or min(2, os.cpu_count() or 1),
    )  # fmt: skip
    with precision(dtype):
        run = prepare_screen(request)
        for warning in run.warnings:
            say(f"warning: {warning}")
        console = Console(stderr=True)
        try:
            with ProgressBar(console, run.candidates, Status.RESISTANT, "sampling") as bar:
                summary = start(run, resume, bar.show)
        except KeyboardInterrupt:
            again = "" if resume else " and --resume"
            say(f"stopped; the finished part is in {run.output}.parts: go on with the same command{again}")
            raise
    _print_summary(summary, run)


def _print_summary(summary, run) -> None:
    console = Console()
    about = run.metadata.get("contacts") or run.metadata["object"]
    name = Path(about["name"]).name
    console.print(counts(summary, f"{name}: {summary.rows:,} grasps", "verdict"))
    console.print(quantiles(summary, "margin (a lower bound)" if run.verdict_only else "margin", ".3f"))
    if summary.solved:
        console.print(speed(summary), highlight=False, soft_wrap=True)
    if summary.resumed:
        console.print(f"{summary.resumed:,} candidates were already done", highlight=False)
    console.print(f"written to {run.output}", highlight=False, soft_wrap=True)


app.command(help=FORCES_HELP)(forces)
app.command(help=CHECK_HELP)(check)
app.command(help=PLACE_HELP)(place)


@app.command(help=EXPLAIN_HELP)
def explain(
    file: Annotated[Path, typer.Argument(help="A file that jaxgrasp screen or jaxgrasp forces wrote.")],
    row: Annotated[int, typer.Argument(help="Which row, counted from 0.")],
    picture: Annotated[Path | None, typer.Option(help="Draw the grasp to this file (png, svg, pdf).")] = None,
    object: Annotated[
        str | None, typer.Option("--object", help="The mesh to draw, if it is not where the run found it.")
    ] = None,
) -> None:
    from ..backend import usable_backend
    from ..formats import read_metadata, read_row
    from ..report import Verdict, draw, reprove_verdict
    from ..report import explain as words

    usable_backend(say)
    if "load" in read_metadata(file):
        if picture is not None or object is not None:
            raise UserError(
                f"{file} holds forces against a load; --picture draws verdicts that jaxgrasp screen wrote"
            )
        explain_forces(file, row)
        return
    values, metadata = read_row(file, row)
    verdict = Verdict.from_row(values, metadata)
    print(f"Row {row} of {file} (grasp {values['grasp_id']}, {verdict.model} contacts):")
    print(words(verdict))
    print(reprove_verdict(verdict, metadata))
    if picture is not None:
        draw(verdict, picture, _mesh(object, metadata))
        print(f"Picture: {picture}")


def _mesh(source: str | None, metadata: dict):
    """The mesh of the run, or None with a line why not."""
    from ..objects import load_mesh

    known = metadata.get("object") or {}
    name = source or known.get("name")
    if name is None:
        say("the file does not name its object: drawing the contacts only (--object names a mesh)")
        return None
    try:
        body = load_mesh(name, unit=metadata.get("unit", "m"))
    except UserError as error:
        if source is not None:
            raise
        say(f"{error}: drawing the contacts only (--object names the mesh)")
        return None
    if known.get("sha256") not in (None, body.sha256):
        say(f"warning: {name} is not the file these grasps were made on")
    return body.mesh


@app.command(help="List the built-in objects: name, size, volume, faces.")
def objects() -> None:
    from ..objects import OBJECTS, make_object

    table = Table()
    for name, side in (
        ("name", "left"),
        ("size (cm)", "right"),
        ("volume (cm3)", "right"),
        ("faces", "right"),
        ("what", "left"),
    ):
        table.add_column(name, justify=side)  # pyright: ignore[reportArgumentType]
    for name, function in OBJECTS.items():
        mesh = make_object(name)
        size = " x ".join(f"{100 * e:.1f}" for e in mesh.extents)
        table.add_row(
            name,
            size,
            f"{1e6 * mesh.volume:.0f}",
            f"{len(mesh.faces):,}",
            (function.__doc__ or "").splitlines()[0],
        )
    Console().print(table)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line. Exit code: 0; 2 for a user's error (one line on stderr); 130 if interrupted."""
    try:
        code = app(args=arguments, standalone_mode=False)
    except UserError as error:
        say(str(error))
        return 2
    except (KeyboardInterrupt, typer.Abort):
        return 130
    except typer.Exit as stop:
        return stop.exit_code
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output has gone
        return 141
    except Exception as error:
        # typer's own complaints (unknown option, not a number) know how to say what they mean
        message = getattr(error, "format_message", None)
        if message is None:
            raise
        say(f"{message()} (jaxgrasp --help shows what there is)")
        return 2
    return code if isinstance(code, int) else 0
