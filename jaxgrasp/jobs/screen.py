"""Screening: candidates in, verdicts out, in chunks: memory does not grow with their number.

A chunk is sampled (or read), solved and written to a shard (``shards``), so a killed run goes on where it was; its rows
are those of an uninterrupted one, because a row depends on the seed and its number alone.
"""

from __future__ import annotations

import functools
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..backend import precision
from ..contacts import MODELS, Grasp
from ..formats import Contacts, Verdicts, dump, schema, table
from ..objects import geometric_filter
from ..resistance import wrench_resistance
from .request import Run
from .shards import Shards
from .summary import Summary

__all__ = ["screen"]


def screen(run: Run, resume: bool = False, progress: Callable[[Summary], None] | None = None) -> Summary:
    """Screen all candidates of ``run`` and write ``run.output``; the counts, quantiles and times of it.

    resume    go on with an unfinished run of the same options
    progress  called with the running summary after every chunk

    Raises UserError where the output cannot be written or belongs to another run. KeyboardInterrupt leaves
    the finished shards for ``resume``.
    """
    shards = Shards(run.output, dump(run.metadata))
    if resume and (finished := _finished(run, shards)) is not None:
        return finished
    with shards.claimed(resume):
        with precision(run.dtype):
            summary = _chunks(run, shards, progress or (lambda _: None))
        started = time.perf_counter()
        removed = {"removed": summary.removed} if run.filter else {}
        shards.assemble(schema(run.fingers, run.dtype, {**run.metadata, **removed}))
        summary.seconds += time.perf_counter() - started
    return summary


@functools.lru_cache(maxsize=8)
def _compiled(rows: int, k: int, kind: str, dtype: str, tolerance: float, verdict_only: bool):
    """The solver for chunks of one shape, and those shapes."""
    real, model = np.dtype(dtype), MODELS[kind]()

    def solve(position, normal, friction, torsion, active):
        grasp = Grasp(position, normal, model.with_coefficients(friction, torsion), active)
        return wrench_resistance(grasp, tolerance=tolerance, verdict_only=verdict_only)

    vectors, scalars = ((rows, k, 3), real), ((rows, k), real)
    shapes = [vectors, vectors, scalars, scalars, ((rows, k), np.dtype(bool))]
    return jax.jit(solve).lower(*(jax.ShapeDtypeStruct(*s) for s in shapes)).compile(), shapes


def _lanes(rows: int) -> int:
    """Lanes to compile for: few different numbers, so that one process seldom compiles twice."""
    return max(256, 1 << (rows - 1).bit_length()) if rows <= 16384 else -(-rows // 16384) * 16384


def _solver(run: Run) -> Callable[[Contacts], tuple[Verdicts, float]]:
    """Compiled once for chunks of one size; padding is inactive lanes, which end at once."""
    compiled, shapes = _compiled(
        _lanes(min(run.chunk, run.candidates)),
        run.fingers,
        run.kind,
        run.dtype,
        run.tolerance,
        run.verdict_only,
    )

    def call(contacts: Contacts) -> tuple[Verdicts, float]:
        # What is stored is what is solved: round to the file's dtype first, then move to the centre of mass.
        position = (contacts.position.astype(np.float64) - run.centre_of_mass).astype(run.dtype)
        values = (position, contacts.normal, contacts.friction, contacts.torsion, contacts.active)
        padded = []
        for value, (shape, kind) in zip(values, shapes, strict=True):
            full = np.zeros(shape, kind)
            full[: len(contacts)] = value
            padded.append(full)
        start = time.perf_counter()
        found = jax.block_until_ready(compiled(*padded))
        seconds = time.perf_counter() - start
        names = Verdicts.__dataclass_fields__
        return Verdicts(
            **{name: np.asarray(getattr(found, name))[: len(contacts)] for name in names}
        ), seconds

    return call


def _chunks(run: Run, shards: Shards, progress: Callable[[Summary], None]) -> Summary:
    total = Summary(run.candidates)
    kind = schema(run.fingers, run.dtype, run.metadata)
    started = time.perf_counter()
    solver: Callable[[Contacts], tuple[Verdicts, float]] | None = None
    pending: deque[Future[Summary]] = deque()

    def work(number: int, load: Callable[[], Contacts], stop: int) -> Summary:
        contacts = load()
        assert solver is not None
        return _one(run, solver, contacts, shards, number, kind, stop)

    def collect() -> None:
        total.add(pending.popleft().result())
        total.seconds = time.perf_counter() - started - total.compile_seconds
        progress(total)

    with ThreadPoolExecutor(run.threads) as pool:
        try:
            for number, (start, stop, load) in enumerate(run.chunks()):
                known = _known(shards, number, start, stop)
                if known is not None:
                    total.add(known)
                    total.resumed += stop - start
                    progress(total)
                    continue
                if solver is None:
                    progress(total)
                    before = time.perf_counter()
                    solver = _solver(run)
                    total.compile_seconds = time.perf_counter() - before
                pending.append(pool.submit(work, number, load, stop))
                if len(pending) > run.threads:
                    collect()
            while pending:
                collect()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return total


def _one(
    run: Run, solver, contacts: Contacts, shards: Shards, number: int, kind: pa.Schema, stop: int
) -> Summary:
    """Filter, solve and write one chunk."""
    real = np.dtype(run.dtype)
    shape = contacts.position.shape[:2]
    friction, torsion = (values.astype(real) for values in run.coefficients(contacts))
    active = np.ones(shape, bool) if contacts.active is None else contacts.active
    contacts = Contacts(
        contacts.grasp_id,
        contacts.position.astype(real),
        contacts.normal.astype(real),
        friction,
        torsion,
        active,
    )
    removed: dict[str, int] = {}
    offered = len(contacts)
    if run.filter:
        reasons = geometric_filter(contacts.position, contacts.normal, friction=friction, active=active)
        removed = {reason: int(rows.sum()) for reason, rows in reasons.items()}
        kept = ~np.any(list(reasons.values()), axis=0)
        contacts = Contacts(*(getattr(contacts, name)[kept] for name in Contacts.__dataclass_fields__))
    verdicts, seconds = solver(contacts)
    about = {"start": stop - offered, "stop": stop, "removed": removed}
    shards.write(number, table(contacts, verdicts, kind), about)
    summary = Summary.of(verdicts.status, verdicts.margin, removed)
    summary.solve_seconds, summary.solved = seconds / run.threads, len(contacts)
    return summary


def _known(shards: Shards, number: int, start: int, stop: int) -> Summary | None:
    """What a finished shard of this run holds."""
    found = shards.read(number, start, stop)
    if found is None or len(found[0]) + sum(found[1]["removed"].values()) != stop - start:
        return None
    rows, about = found
    return Summary.of(rows["status"].to_numpy(), rows["margin"].to_numpy(), about["removed"])


def _finished(run: Run, shards: Shards) -> Summary | None:
    """The summary of an output that this very run has already written."""
    metadata = shards.finished("removed")
    if metadata is None:
        return None
    summary = Summary(run.candidates)
    try:
        with pq.ParquetFile(run.output) as file:
            for batch in file.iter_batches(1 << 20, columns=["status", "margin"]):
                summary.add(
                    Summary.of(batch["status"].to_numpy(), batch["margin"].to_numpy(zero_copy_only=False))
                )
    except (OSError, pa.ArrowException, KeyError):
        return None
    summary.add(Summary(removed=metadata.get("removed", {})))
    summary.resumed = run.candidates
    return summary
