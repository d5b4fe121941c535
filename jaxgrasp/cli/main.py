"""The command line: parse, call, print. ``jaxgrasp explain`` and ``objects``; the others have a file each."""

from __future__ import annotations

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
from .prove import PROVE_HELP, prove
from .screen import SCREEN_HELP, screen
from .terminal import say

__all__ = ["app", "main"]

app = typer.Typer(
    name="jaxgrasp",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Does this grasp hold? Wrench resistance (force closure) of many grasps at once, with proofs.",
)

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


app.command(help=SCREEN_HELP)(screen)
app.command(help=FORCES_HELP)(forces)
app.command(help=CHECK_HELP)(check)
app.command(help=PLACE_HELP)(place)
app.command(help=PROVE_HELP)(prove)


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
    from ..jobs import writable
    from ..report import Verdict, draw, reprove_verdict
    from ..report import explain as words

    usable_backend(say)
    if picture is not None:
        writable(picture, "--picture")
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
