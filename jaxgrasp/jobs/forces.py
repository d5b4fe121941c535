"""Forces for many grasps against one load, in chunks: memory does not grow with their number.

A chunk is read, solved, proved again and becomes a row group of the Parquet file, which appears under its name when it
is whole. There is nothing to resume: a million grasps take less time than compiling.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa

from ..backend import precision
from ..certificates import check
from ..contacts import Component, Grasp
from ..core import Status, UserError, contact_frame, normalize
from ..forces import OptimalForces, closeness, optimize_forces
from ..formats import Contacts, Forces, as_row, force_schema, force_table, write
from .load import LoadRun
from .summary import Summary

__all__ = ["ForceSummary", "balance_many", "balance_one"]

FINEST, LARGEST, STEP = 1e-9, 1e15, 1e-3  # costs are told apart to STEP relative, near 0 to FINEST STEP
HALF = int(np.arcsinh(LARGEST / FINEST) / STEP) + 1
BINS = 2 * HALF + 1


@dataclass
class ForceSummary(Summary):
    """Counts by status, and the costs of the optimal grasps, in a size that does not depend on how many they are.

    Costs c go into bins of ``asinh(c / FINEST)`` of width STEP, so a quantile is right to 0.05 %. ``proved``: optimal
    and infeasible answers that the checker accepted.
    """

    histogram: np.ndarray = field(default_factory=lambda: np.zeros(BINS, np.int64))
    proved: int = 0

    @classmethod
    def of_costs(cls, status: np.ndarray, cost: np.ndarray, proved: np.ndarray) -> ForceSummary:
        """The summary of these rows."""
        values, numbers = np.unique(status, return_counts=True)
        counts = {Status(int(v)): int(n) for v, n in zip(values, numbers, strict=True)}
        known = cost[(status == Status.OPTIMAL.value) & np.isfinite(cost)]
        place = np.rint(np.arcsinh(np.clip(known, -LARGEST, LARGEST) / FINEST) / STEP).astype(np.int64)
        histogram = np.bincount(place + HALF, minlength=BINS)
        return cls(counts=counts, histogram=histogram, solved=len(status), proved=int(proved.sum()))

    def add(self, other: Summary) -> None:
        """Take the rows of ``other`` in as well."""
        super().add(other)
        if isinstance(other, ForceSummary):
            self.proved += other.proved

    def quantile(self, q: float) -> float:
        """The cost that a share q of the optimal grasps lie at or below; NaN if there are none."""
        number = int(self.histogram.sum())
        if not number:
            return float("nan")
        rank = min(max(q * number, 1), number)
        place = int(np.searchsorted(np.cumsum(self.histogram), rank, side="left"))
        return float(FINEST * np.sinh((place - HALF) * STEP))


def _padded(contacts: Contacts, rows: int) -> Contacts:
    """With lanes of inactive contacts up to ``rows``, so that every chunk has one shape; they end at once."""
    parts = []
    for name in Contacts.__dataclass_fields__:
        value = getattr(contacts, name)
        full = np.zeros((rows, *value.shape[1:]), value.dtype if value.dtype == bool else np.float64)
        full[: len(contacts)] = value
        parts.append(full)
    return Contacts(*parts)


def _grasp(run: LoadRun, contacts: Contacts) -> Grasp:
    model = run.model.with_coefficients(jnp.asarray(contacts.friction), jnp.asarray(contacts.torsion))
    return Grasp(contacts.position - run.centre_of_mass, contacts.normal, model, contacts.active)


def _in_mesh_axes(grasp: Grasp, force: jax.Array) -> np.ndarray:
    """``f_x t_1 + f_y t_2 + f_n n`` (N, k, d) of forces (N, k n); 0 where there is no contact."""
    components = grasp.model.components(grasp.dimension)
    parts = np.asarray(force).reshape(-1, grasp.contacts, len(components))
    normal = normalize(grasp.normal)
    tangents = contact_frame(normal)
    axes = {Component.TANGENT_1: tangents[0], Component.TANGENT_2: tangents[-1], Component.NORMAL: normal}
    vectors = sum(
        parts[..., j, None] * np.asarray(axes[c]) for j, c in enumerate(components) if c is not Component.SPIN
    )
    return np.where(np.asarray(grasp.active)[..., None], vectors, 0.0)


@dataclass(frozen=True)
class _Solved:
    forces: Forces
    proved: np.ndarray  # (N,) optimal or infeasible, and the checker agrees
    seconds: float  # in the solver


def _solve(run: LoadRun, contacts: Contacts) -> _Solved:
    count = len(contacts)
    grasp = _grasp(run, _padded(contacts, run.chunk))
    started = time.perf_counter()
    found: OptimalForces = jax.block_until_ready(
        optimize_forces(
            grasp,
            jnp.asarray(run.load.wrench),
            criterion=run.criterion,
            max_normal=run.max_normal,
            tolerance=run.tolerance,
        )
    )
    seconds = time.perf_counter() - started
    values: dict[str, Any] = {
        name: np.asarray(getattr(found, {"bound": "lower"}.get(name, name)))[:count]
        for name in Forces.__dataclass_fields__
        if name != "contact_force"
    }
    values["contact_force"] = _in_mesh_axes(grasp, found.force)[:count]
    claims = np.isin(values["status"], (Status.OPTIMAL.value, Status.INFEASIBLE.value))
    proved = check(
        grasp,
        found,
        wrench=run.load.wrench,
        criterion=run.criterion,
        max_normal=run.max_normal,
        tolerance=closeness(run.tolerance),
    )
    proved = claims & proved[:count]
    return _Solved(Forces(**values), proved, seconds)


def _nothing(run: LoadRun) -> Contacts:
    """No grasps, in the right shapes: compiles everything, solves nothing."""
    k, d = run.fingers, run.dimension
    shapes: list[tuple[int, ...]] = [(0,), (0, k, d), (0, k, d), (0, k), (0, k)]
    return Contacts(*(np.zeros(shape) for shape in shapes), active=np.zeros((0, k), bool))


def balance_one(run: LoadRun) -> tuple[dict[str, Any], bool]:
    """The one grasp of ``run`` as a row of the file, written too where ``run.output`` is named; is it proved?"""
    kind = force_schema(run.fingers, run.dimension, run.metadata)
    with precision("float64"):
        rows, contacts = next(iter(run.chunks()))
        solved = _solve(run, contacts)
    found = force_table(rows, contacts, solved.forces, kind)
    if run.output is not None:
        _write(run, [found], kind)
    return as_row(found), bool(solved.proved[0])


def balance_many(run: LoadRun, progress: Callable[[ForceSummary], None] | None = None) -> ForceSummary:
    """The forces of all grasps of ``run``, written to ``run.output``; the counts, quantiles and times of it.

    progress  called with the running summary before the first chunk and after every chunk

    Raises UserError where the output cannot be written. However it ends, no half-written file is left.
    """
    assert run.output is not None
    tell = progress or (lambda _: None)
    total = ForceSummary(run.rows)
    kind = force_schema(run.fingers, run.dimension, run.metadata)
    with precision("float64"):
        tell(total)
        started = time.perf_counter()
        _solve(run, _nothing(run))
        total.compile_seconds = time.perf_counter() - started
        started = time.perf_counter()
        # Closed before 64-bit arrays are switched off again: its threads still work on them.
        with closing(_tables(run, kind, total, started, tell)) as tables:
            _write(run, tables, kind)
        total.seconds = time.perf_counter() - started
    return total


def _write(run: LoadRun, rows: Iterable[pa.Table], kind: pa.Schema) -> None:
    assert run.output is not None
    try:
        write(run.output, rows, kind)
    except OSError as error:
        raise UserError(f"cannot write {run.output}: {error.strerror or error}") from error


def _tables(
    run: LoadRun, kind: pa.Schema, total: ForceSummary, started: float, tell: Callable[[ForceSummary], None]
) -> Generator[pa.Table]:
    """The chunks' tables in order, ``run.threads`` chunks worked on at a time; adds them to ``total``."""
    pending: deque[Future[tuple[pa.Table, ForceSummary]]] = deque()

    def work(rows: np.ndarray, contacts: Contacts) -> tuple[pa.Table, ForceSummary]:
        solved = _solve(run, contacts)
        summary = ForceSummary.of_costs(solved.forces.status, solved.forces.cost, solved.proved)
        summary.solve_seconds = solved.seconds / run.threads
        return force_table(rows, contacts, solved.forces, kind), summary

    def finished() -> pa.Table:
        found, summary = pending.popleft().result()
        total.add(summary)
        total.seconds = time.perf_counter() - started
        tell(total)
        return found

    with ThreadPoolExecutor(run.threads) as pool:
        try:
            for rows, contacts in run.chunks():
                pending.append(pool.submit(work, rows, contacts))
                if len(pending) > run.threads:
                    yield finished()
            while pending:
                yield finished()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
