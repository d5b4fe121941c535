"""Screening: candidates in, verdicts out, in chunks: memory does not grow with their number.

A chunk is sampled (or read), solved and written to a shard (``shards``), so a killed run goes on where it was; its rows
are those of an uninterrupted one, because a row depends on the seed and its number alone.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import closing

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..backend import precision
from ..contacts import Grasp, contact_model
from ..formats import Contacts, Verdicts, dump_metadata, verdict_schema, verdict_table
from ..objects import geometric_filter
from ..resistance import wrench_resistance
from .screen_request import Chunk, ScreenPlan
from .shards import Shards
from .summary import Summary
from .threads import in_order

__all__ = ["screen"]

Solver = Callable[[Contacts], tuple[Verdicts, float]]  # the verdicts, and seconds in the solver


def screen(
    plan: ScreenPlan, resume: bool = False, progress: Callable[[Summary], None] | None = None
) -> Summary:
    """Screen all candidates of ``plan`` and write ``plan.output``; the counts, quantiles and times of it.

    resume    go on with an unfinished run of the same options
    progress  called with the running summary after every chunk

    Raises UserError where the output cannot be written or belongs to another run. KeyboardInterrupt leaves
    the finished shards for ``resume``.
    """
    shards = Shards(plan.output, dump_metadata(plan.metadata))
    if resume and (finished := _finished(plan, shards)) is not None:
        return finished
    with shards.claimed(resume):
        with precision(plan.request.dtype):
            summary = _solve_chunks(plan, shards, progress or (lambda _: None))
        started = time.perf_counter()
        removed = {"removed": summary.removed} if plan.request.filter else {}
        shards.assemble(_schema(plan, {**plan.metadata, **removed}))
        summary.seconds += time.perf_counter() - started
    return summary


def _schema(plan: ScreenPlan, metadata: dict) -> pa.Schema:
    return verdict_schema(plan.candidates.fingers, plan.request.dtype, metadata)


@functools.lru_cache(maxsize=8)
def _compiled(rows: int, k: int, kind: str, dtype: str, tolerance: float, verdict_only: bool):
    """The solver for chunks of one shape."""
    real = np.dtype(dtype)

    def solve(position, normal, friction, torsion, active):
        grasp = Grasp(position, normal, contact_model(kind, friction, torsion), active)
        return wrench_resistance(grasp, tolerance=tolerance, verdict_only=verdict_only)

    vectors, scalars = ((rows, k, 3), real), ((rows, k), real)
    shapes = [vectors, vectors, scalars, scalars, ((rows, k), np.dtype(bool))]
    return jax.jit(solve).lower(*(jax.ShapeDtypeStruct(*s) for s in shapes)).compile()


def _lanes(rows: int) -> int:
    """Lanes to compile for: few different numbers, so that one process seldom compiles twice."""
    return max(256, 1 << (rows - 1).bit_length()) if rows <= 16384 else -(-rows // 16384) * 16384


def _solver(plan: ScreenPlan) -> Solver:
    """Compiled once for chunks of one size; padding is inactive lanes, which end at once."""
    asked, candidates = plan.request, plan.candidates
    lanes = _lanes(min(asked.chunk, candidates.count))
    compiled = _compiled(
        lanes, candidates.fingers, plan.contact.kind, asked.dtype, asked.tolerance, asked.verdict_only
    )

    def solve(contacts: Contacts) -> tuple[Verdicts, float]:
        full = contacts.padded(lanes)
        # What is stored is what is solved: round to the file's dtype first, then move to the centre of mass.
        position = (full.position.astype(np.float64) - candidates.centre_of_mass).astype(asked.dtype)
        position[len(contacts) :] = 0
        start = time.perf_counter()
        found = jax.block_until_ready(
            compiled(position, full.normal, full.friction, full.torsion, full.active)
        )
        seconds = time.perf_counter() - start
        return Verdicts.of(found, slice(None, len(contacts))), seconds

    return solve


def _solve_chunks(plan: ScreenPlan, shards: Shards, progress: Callable[[Summary], None]) -> Summary:
    total, kind = Summary(plan.candidates.count), _schema(plan, plan.metadata)
    started = time.perf_counter()

    def tasks() -> Iterator[Callable[[], Summary]]:
        solver: Solver | None = None
        for chunk in plan.chunks():
            known = _known(shards, chunk)
            if known is not None:
                total.add(known)
                total.resumed += chunk.stop - chunk.start
                progress(total)
                continue
            if solver is None:
                progress(total)
                before = time.perf_counter()
                solver = _solver(plan)
                total.compile_seconds = time.perf_counter() - before
            yield functools.partial(_solve_chunk, plan, solver, chunk, shards, kind)

    with closing(in_order(tasks(), plan.threads)) as parts:
        for part in parts:
            total.add(part)
            total.seconds = time.perf_counter() - started - total.compile_seconds
            progress(total)
    return total


def _solve_chunk(plan: ScreenPlan, solver: Solver, chunk: Chunk, shards: Shards, kind: pa.Schema) -> Summary:
    """Load, filter, solve and write one chunk."""
    contacts = _completed(plan, chunk.load())
    removed: dict[str, int] = {}
    offered = len(contacts)
    if plan.request.filter:
        assert contacts.friction is not None and contacts.active is not None
        reasons = geometric_filter(
            contacts.position, contacts.normal, friction=contacts.friction, active=contacts.active
        )
        removed = {reason: int(rows.sum()) for reason, rows in reasons.items()}
        contacts = contacts.taken(~np.any(list(reasons.values()), axis=0))
    verdicts, seconds = solver(contacts)
    about = {"start": chunk.stop - offered, "stop": chunk.stop, "removed": removed}
    shards.write(chunk.number, verdict_table(contacts, verdicts, kind), about)
    summary = Summary.of(verdicts.status, verdicts.margin, removed)
    summary.solve_seconds, summary.solved = seconds / plan.threads, len(contacts)
    return summary


def _completed(plan: ScreenPlan, contacts: Contacts) -> Contacts:
    """With coefficients and ``active``, in the dtype of the run."""
    real = np.dtype(plan.request.dtype)
    friction, torsion = (values.astype(real) for values in plan.contact.coefficients(contacts))
    active = np.ones(friction.shape, bool) if contacts.active is None else contacts.active
    vectors = contacts.position.astype(real), contacts.normal.astype(real)
    return Contacts(contacts.grasp_id, *vectors, friction, torsion, active)


def _known(shards: Shards, chunk: Chunk) -> Summary | None:
    """What a finished shard of this run holds."""
    found = shards.read(chunk.number, chunk.start, chunk.stop)
    if found is None or len(found[0]) + sum(found[1]["removed"].values()) != chunk.stop - chunk.start:
        return None
    rows, about = found
    return Summary.of(rows["status"].to_numpy(), rows["margin"].to_numpy(), about["removed"])


def _finished(plan: ScreenPlan, shards: Shards) -> Summary | None:
    """The summary of an output that this very run has already written."""
    metadata = shards.finished("removed")
    if metadata is None:
        return None
    summary = Summary(plan.candidates.count)
    try:
        with pq.ParquetFile(plan.output) as file:
            for batch in file.iter_batches(1 << 20, columns=["status", "margin"]):
                summary.add(
                    Summary.of(batch["status"].to_numpy(), batch["margin"].to_numpy(zero_copy_only=False))
                )
    except (OSError, pa.ArrowException, KeyError):
        return None
    summary.add(Summary(removed=metadata.get("removed", {})))
    summary.resumed = plan.candidates.count
    return summary
