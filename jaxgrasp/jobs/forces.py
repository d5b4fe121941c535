"""Forces for many grasps against one load, in chunks: memory does not grow with their number.

A chunk is read, solved, proved again and becomes a row group of the Parquet file, which appears under its name when it
is whole. There is nothing to resume: a million grasps take less time than compiling.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from ..backend import precision
from ..certificates import check
from ..contacts import Grasp, contact_model, force_vectors
from ..core import Status, UserError, claimed
from ..forces import OptimalForces, closeness, optimize_forces
from ..formats import Contacts, Forces, as_row, force_schema, force_table, write
from .forces_request import ForcesPlan
from .summary import ForceSummary
from .threads import in_order

__all__ = ["forces_of_file", "forces_of_row"]


def _grasp(plan: ForcesPlan, contacts: Contacts) -> Grasp:
    """In float64, at the centre of mass, padded to the chunk."""
    full = contacts.padded(plan.chunk)
    values = (full.position, full.normal, full.friction, full.torsion)
    position, normal, friction, torsion = (np.asarray(value, np.float64) for value in values)
    model = contact_model(plan.source.kind, friction, torsion)
    return Grasp(position - plan.source.centre_of_mass, normal, model, full.active)


def _in_mesh_axes(grasp: Grasp, force: jax.Array) -> np.ndarray:
    """``f_x t_1 + f_y t_2 + f_n n`` (N, k, d) of forces (N, k n); 0 where there is no contact."""
    vectors = np.asarray(force_vectors(grasp, force))[..., : grasp.dimension]
    return np.where(np.asarray(grasp.active)[..., None], vectors, 0.0)


@dataclass(frozen=True)
class _Solved:
    forces: Forces
    proved: np.ndarray  # (N,) optimal or infeasible, and the checker agrees
    seconds: float  # in the solver


def _solve(plan: ForcesPlan, contacts: Contacts) -> _Solved:
    count, request = len(contacts), plan.request
    grasp = _grasp(plan, contacts)
    started = time.perf_counter()
    found: OptimalForces = jax.block_until_ready(
        optimize_forces(
            grasp,
            plan.load.wrench,
            criterion=plan.criterion,
            max_normal=request.max_normal,
            tolerance=request.tolerance,
        )
    )
    seconds = time.perf_counter() - started
    forces = Forces.of(found, _in_mesh_axes(grasp, found.force), count)
    claims = np.isin(forces.status, (Status.OPTIMAL.value, Status.INFEASIBLE.value))
    proved = check(
        grasp,
        found,
        wrench=plan.load.wrench,
        criterion=plan.criterion,
        max_normal=request.max_normal,
        tolerance=closeness(request.tolerance),
    )
    return _Solved(forces, claims & proved[:count], seconds)


def _nothing(plan: ForcesPlan) -> Contacts:
    """No grasps, in the right shapes: compiles everything, solves nothing."""
    k, d = plan.source.fingers, plan.source.dimension
    shapes: list[tuple[int, ...]] = [(0,), (0, k, d), (0, k, d), (0, k), (0, k)]
    return Contacts(*(np.zeros(shape) for shape in shapes), active=np.zeros((0, k), bool))


def _schema(plan: ForcesPlan) -> pa.Schema:
    return force_schema(plan.source.fingers, plan.source.dimension, plan.metadata)


def forces_of_row(plan: ForcesPlan) -> tuple[dict[str, Any], bool]:
    """The one grasp of ``plan`` as a row of the file, written too where ``plan.output`` is named; is it proved?"""
    kind = _schema(plan)
    with precision("float64"):
        rows, contacts = next(iter(plan.chunks()))
        solved = _solve(plan, contacts)
    found = force_table(rows, contacts, solved.forces, kind)
    if plan.output is not None:
        _write(plan, [found], kind)
    return as_row(found), bool(solved.proved[0])


def forces_of_file(plan: ForcesPlan, progress: Callable[[ForceSummary], None] | None = None) -> ForceSummary:
    """The forces of all grasps of ``plan``, written to ``plan.output``; the counts, quantiles and times of it.

    progress  called with the running summary before the first chunk and after every chunk

    Raises UserError where the output cannot be written. However it ends, no half-written file is left.
    """
    tell = progress or (lambda _: None)
    total = ForceSummary(plan.selection.count)
    kind = _schema(plan)
    with precision("float64"):
        tell(total)
        started = time.perf_counter()
        _solve(plan, _nothing(plan))
        total.compile_seconds = time.perf_counter() - started
        started = time.perf_counter()

        def told(part: ForceSummary) -> None:
            total.add(part)
            total.seconds = time.perf_counter() - started
            tell(total)

        # Closed before 64-bit arrays are switched off again: its threads still work on them.
        with closing(_tables(plan, kind, told)) as tables:
            _write(plan, tables, kind)
        total.seconds = time.perf_counter() - started
    return total


def _write(plan: ForcesPlan, rows: Iterable[pa.Table], kind: pa.Schema) -> None:
    assert plan.output is not None
    try:
        with claimed(plan.output):
            write(plan.output, rows, kind)
    except OSError as error:
        raise UserError(f"cannot write {plan.output}: {error.strerror or error}") from error


def _tables(plan: ForcesPlan, kind: pa.Schema, tell: Callable[[ForceSummary], None]) -> Generator[pa.Table]:
    """The chunks' tables in order, ``plan.threads`` chunks worked on at a time; ``tell`` hears of each."""

    def work(rows: np.ndarray, contacts: Contacts) -> tuple[pa.Table, ForceSummary]:
        solved = _solve(plan, contacts)
        summary = ForceSummary.of_costs(solved.forces.status, solved.forces.cost, solved.proved)
        summary.solve_seconds = solved.seconds / plan.threads
        return force_table(rows, contacts, solved.forces, kind), summary

    tasks = (functools.partial(work, rows, contacts) for rows, contacts in plan.chunks())
    with closing(in_order(tasks, plan.threads)) as results:
        for found, summary in results:
            tell(summary)
            yield found
