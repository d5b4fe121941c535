"""``jaxgrasp prove``: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from .. import jobs
from ..backend import usable_backend
from ..core import Status
from ..jobs import ProofSummary
from ..report import status_words
from .terminal import ProgressBar, line, say

__all__ = ["PROVE_HELP", "prove"]

PROVE_HELP = """Prove the verdicts of a file, and write proofs that others can check.

FILE is what [bold]jaxgrasp screen[/bold] or [bold]jaxgrasp place[/bold] wrote. Each row's evidence is tested without
the solver; a line of JSON is written for each verdict that holds. tools/check_proofs.py of the source code checks such
lines with Python's standard library alone, in exact arithmetic.

Exit code 1 if a row was refused.

Examples:

  jaxgrasp prove mug.grasps.parquet -o proofs.jsonl

  python tools/check_proofs.py proofs.jsonl
"""


def prove(
    file: Annotated[Path, typer.Argument(help="A file of verdicts with their evidence.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Proofs, a line each (default: FILE.proofs.jsonl).")
    ] = None,
) -> int:
    usable_backend(say)
    with ProgressBar(Console(stderr=True), 1, Status.PROVED_EXACTLY, "proving") as bar:

        def show(summary: ProofSummary) -> None:
            bar.progress.update(bar.task, total=summary.rows)
            rate = summary.done / max(summary.seconds, 1e-9)
            bar.stage("proving", summary.done, f"{rate:,.0f} rows/s")

        summary = jobs.prove_verdicts(file, output, show)
    _print(file, summary)
    return 1 if summary.counts.get(Status.REFUSED) else 0


def _print(file: Path, summary: ProofSummary) -> None:
    table = Table(title=f"{file.name}: {summary.rows:,} rows")
    table.add_column("proof")
    table.add_column("rows", justify="right")
    table.add_column("share", justify="right")
    for word in (Status.PROVED_EXACTLY, Status.PROVED_TO_ROUNDING, Status.REFUSED):
        count = summary.counts.get(word, 0)
        if count:
            table.add_row(status_words(word), f"{count:,}", f"{100 * count / max(summary.rows, 1):.2f} %")
    Console().print(table)
    if summary.silent:
        line(f"{summary.silent:,} rows say nothing that could be written down (undecided, or invalid)")
    if summary.refused:
        line(
            f"refused: row {', '.join(map(str, summary.refused))}{', ..' if len(summary.refused) == 10 else ''}"
        )
    line(f"{1e3 * summary.seconds / max(summary.rows, 1):.1f} ms a row; written to {summary.output}")
