"""What every command does to a terminal: lines on stderr, a progress bar, tables of counts and quantiles."""

from __future__ import annotations

import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from ..core import Status
from ..jobs import Summary
from ..report import status_words

__all__ = ["ProgressBar", "counts", "line", "quantiles", "resumable", "say", "speed"]

QUANTILES = (
    ("min", 0.0),
    ("5 %", 0.05),
    ("25 %", 0.25),
    ("median", 0.5),
    ("75 %", 0.75),
    ("95 %", 0.95),
    ("max", 1.0),
)


def say(text: str) -> None:
    """One line on stderr."""
    print(f"jaxgrasp: {' '.join(str(text).split())}", file=sys.stderr)


def line(text: str) -> None:
    """One line on stdout, as it is."""
    Console().print(text, highlight=False, soft_wrap=True, markup=False)


@contextmanager
def resumable(output: Path, resumed: bool) -> Generator[None]:
    """Ctrl-C in the middle of a run of shards: one line says how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        again = "" if resumed else " and --resume"
        say(f"stopped; the finished part is in {output}.parts: go on with the same command{again}")
        raise


class ProgressBar:
    """Progress on a terminal: done, rate, share with the status ``goal``, time left."""

    def __init__(self, console: Console, total: int, goal: Status, first: str):
        self.goal = goal
        self.progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[told]}"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self.task = self.progress.add_task(first, total=total, told="")

    def __enter__(self) -> ProgressBar:
        self.progress.start()
        return self

    def __exit__(self, *_) -> None:
        self.progress.stop()

    def show(self, summary: Summary) -> None:
        if not summary.solved:
            self.progress.update(self.task, description="compiling", completed=summary.done)
            return
        rate = (summary.done - summary.resumed) / max(summary.seconds, 1e-9)
        share = 100 * summary.share(self.goal)
        told = f"{rate:,.0f} grasps/s, {share:.1f} % {self.goal.name.lower()}"
        stage = "writing" if summary.done >= summary.candidates else "solving"
        self.progress.update(self.task, description=stage, completed=summary.done, told=told)

    def stage(self, doing: str, done: int, told: str) -> None:
        """What is being done, how much of it is, and a word about that."""
        self.progress.update(self.task, description=doing, completed=done, told=told)


def counts(summary: Summary, title: str, head: str) -> Table:
    """Grasps by status, and those a filter left out."""
    table = Table(title=title)
    table.add_column(head)
    table.add_column("grasps", justify="right")
    table.add_column("share", justify="right")
    for status in Status:
        if summary.counts.get(status):
            table.add_row(
                status_words(status), f"{summary.counts[status]:,}", f"{100 * summary.share(status):.2f} %"
            )
    for reason, number in summary.removed.items():
        table.add_row(f"left out by --filter: {reason}", f"{number:,}", "")
    return table


def quantiles(summary: Summary, title: str, spec: str) -> Table:
    """The summary's quantiles in one row, each formatted by ``spec``."""
    table = Table(title=title)
    for words, _ in QUANTILES:
        table.add_column(words, justify="right")
    table.add_row(*(format(summary.quantile(q), spec) for _, q in QUANTILES))
    return table


def speed(summary: Summary) -> str:
    """Rates and times of what was solved now."""
    solver = summary.solved / max(summary.solve_seconds, 1e-9)
    overall = (summary.done - summary.resumed) / max(summary.seconds, 1e-9)
    return (
        f"{overall:,.0f} grasps/s overall, {solver:,.0f} in the solver; {summary.seconds:.1f} s"
        f" after {summary.compile_seconds:.1f} s of compiling"
    )
