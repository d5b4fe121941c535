"""Where results go: names for files that the user did not name, and whether they can be written."""

from __future__ import annotations

from pathlib import Path

from ..core import UserError, claimed
from ..objects import OBJECTS

__all__ = ["default_output", "derived_output", "not_the_source", "writable"]


def default_output(source: str, ending: str) -> Path:
    """``NAME.ENDING`` in this folder: the built-in object's name, or that of the file without its suffix."""
    name = Path(source).name.removesuffix(".gz")
    return Path(f"{name if source in OBJECTS else Path(name).stem}.{ending}")


def derived_output(source: str, ending: str) -> Path:
    """``NAME.ENDING`` in this folder: the source's name up to its first point."""
    return Path(f"{Path(source).name.split('.')[0]}.{ending}")


def not_the_source(output: Path, source: str) -> None:
    """UserError where the output is the source."""
    if output.resolve() == Path(source).resolve():
        raise UserError(f"{output} is the source; name another file with -o")


def writable(output: Path, option: str = "-o") -> None:
    """Whether a file can be put there now: UserError naming the ``option`` that says another place."""
    with claimed(output, option):
        pass
