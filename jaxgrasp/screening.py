"""Screening: candidates in, verdicts out, in chunks: memory does not grow with their number.

A chunk is sampled (or read), solved and written to a shard, ``OUTPUT.parts/00000000.arrow`` and so on, each
written beside and renamed. When all are there they become the row groups of one Parquet file, in order,
which is renamed to OUTPUT. (Shards are Arrow files with the Parquet file's columns: a quarter of the time
to write and read.) Shards say which run they belong to, so a killed run goes on where it was; its rows are
those of an uninterrupted one, because a row depends on the seed and its number alone.
"""

from __future__ import annotations

import functools
import json
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from .backend import precision
from .candidates import geometric_filter
from .errors import UserError
from .formats.parquet import Contacts, Verdicts, dump, schema, table, write
from .grasp import Grasp
from .resistance import wrench_resistance
from .run import MODELS, Run
from .summary import Summary

__all__ = ["screen"]

SHARD_KEY = b"jaxgrasp.shard"


def screen(run: Run, resume: bool = False, progress: Callable[[Summary], None] | None = None) -> Summary:
    """Screen all candidates of ``run`` and write ``run.output``; the counts, quantiles and times of it.

    resume    go on with an unfinished run of the same options
    progress  called with the running summary after every chunk

    Raises UserError where the output cannot be written or belongs to another run. KeyboardInterrupt leaves
    the finished shards for ``resume``.
    """
    parts = run.output.with_name(run.output.name + ".parts")
    fingerprint = dump(run.metadata)
    if resume and not parts.exists() and (finished := _finished(run, fingerprint)) is not None:
        return finished
    _claim(run.output, parts, fingerprint, resume)
    try:
        with precision(run.dtype):
            summary = _chunks(run, parts, fingerprint, progress or (lambda _: None))
        started = time.perf_counter()
        _assemble(run, parts, summary)
        summary.seconds += time.perf_counter() - started
    except OSError as error:
        raise UserError(f"cannot write to {parts}: {error.strerror or error}") from error
    finally:
        if parts.exists() and not any(parts.glob("[0-9]*.arrow")):
            shutil.rmtree(parts, ignore_errors=True)  # nothing worth resuming
    return summary


def _claim(output: Path, parts: Path, fingerprint: bytes, resume: bool) -> None:
    """Make sure, before any work, that the output can be written and that the shards there are ours."""
    if output.is_dir():
        raise UserError(f"{output} is a directory; name a file with -o")
    identity = parts / "run.json"
    if parts.exists() and not parts.is_dir():
        raise UserError(f"{parts} is in the way: the shards go there; move it")
    if identity.exists():
        if not resume:
            raise UserError(f"{parts} holds an unfinished run: go on with --resume, or delete that directory")
        if identity.read_bytes() != fingerprint:
            raise UserError(
                f"{parts} belongs to another run: {_difference(identity.read_bytes(), fingerprint)}"
            )
    try:
        parts.mkdir(exist_ok=True)
        for leftover in parts.glob(".*.tmp"):
            leftover.unlink()
        beside = parts / f".run.{os.getpid()}.tmp"
        beside.write_bytes(fingerprint)
        os.replace(beside, identity)
        if output.exists() and not os.access(output, os.W_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        raise UserError(
            f"{output} cannot be written: {error.strerror or error}; name another file with -o"
        ) from error


def _difference(there: bytes, here: bytes) -> str:
    try:
        old, new = json.loads(there), json.loads(here)
        for name in sorted(set(old) | set(new) - {"command"}):
            if name != "command" and old.get(name) != new.get(name):
                return f"{name} was {json.dumps(old.get(name))}, is now {json.dumps(new.get(name))}"
    except (ValueError, AttributeError):
        pass
    return "its options differ"


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


def _chunks(run: Run, parts: Path, fingerprint: bytes, progress: Callable[[Summary], None]) -> Summary:
    total = Summary(run.candidates)
    kind = schema(run.fingers, run.dtype, run.metadata)
    started = time.perf_counter()
    solver: Callable[[Contacts], tuple[Verdicts, float]] | None = None
    pending: deque[Future[Summary]] = deque()

    def work(path: Path, load: Callable[[], Contacts], stop: int) -> Summary:
        contacts = load()
        assert solver is not None
        return _one(run, solver, contacts, path, kind, stop)

    def collect() -> None:
        total.add(pending.popleft().result())
        total.seconds = time.perf_counter() - started - total.compile_seconds
        progress(total)

    with ThreadPoolExecutor(run.threads) as pool:
        try:
            for number, (start, stop, load) in enumerate(run.chunks()):
                path = parts / f"{number:08d}.arrow"
                known = _shard(path, fingerprint, start, stop)
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
                pending.append(pool.submit(work, path, load, stop))
                if len(pending) > run.threads:
                    collect()
            while pending:
                collect()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return total


def _one(run: Run, solver, contacts: Contacts, path: Path, kind: pa.Schema, stop: int) -> Summary:
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
        reasons = geometric_filter(contacts.position, contacts.normal, friction, active)
        removed = {reason: int(rows.sum()) for reason, rows in reasons.items()}
        kept = ~np.any(list(reasons.values()), axis=0)
        contacts = Contacts(*(getattr(contacts, name)[kept] for name in Contacts.__dataclass_fields__))
    verdicts, seconds = solver(contacts)
    shard = {"start": stop - offered, "stop": stop, "removed": removed}
    rows = table(contacts, verdicts, kind)
    marked = kind.with_metadata({**kind.metadata, SHARD_KEY: json.dumps(shard, sort_keys=True).encode()})
    _write_shard(path, rows.cast(marked))
    summary = Summary.of(verdicts.status, verdicts.margin, removed)
    summary.solve_seconds, summary.solved = seconds / run.threads, len(contacts)
    return summary


def _write_shard(path: Path, rows: pa.Table) -> None:
    beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        options = pa.ipc.IpcWriteOptions(compression="lz4")
        with (
            pa.OSFile(str(beside), "wb") as sink,
            pa.ipc.new_file(sink, rows.schema, options=options) as writer,
        ):
            writer.write_table(rows)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def _read_shard(path: Path) -> pa.Table:
    with pa.OSFile(str(path), "rb") as source:
        return pa.ipc.open_file(source).read_all()


def _shard(path: Path, fingerprint: bytes, start: int, stop: int) -> Summary | None:
    """What a finished shard of this run holds; None where it is missing, damaged or another's."""
    try:
        found = _read_shard(path)
        metadata = found.schema.metadata or {}
        shard = json.loads(metadata.get(SHARD_KEY, b"{}"))
        if metadata.get(b"jaxgrasp") != fingerprint or (shard["start"], shard["stop"]) != (start, stop):
            return None
        if len(found) + sum(shard["removed"].values()) != stop - start:
            return None
    except (OSError, pa.ArrowException, ValueError, KeyError):
        return None
    return Summary.of(found["status"].to_numpy(), found["margin"].to_numpy(), shard["removed"])


def _shards(parts: Path) -> Iterator[pa.Table]:
    for path in sorted(parts.glob("[0-9]*.arrow")):
        rows = _read_shard(path)
        if len(rows):
            yield rows


def _assemble(run: Run, parts: Path, summary: Summary) -> None:
    metadata: dict[str, Any] = {**run.metadata, **({"removed": summary.removed} if run.filter else {})}
    kind = schema(run.fingers, run.dtype, metadata)
    write(
        run.output,
        (rows.replace_schema_metadata(kind.metadata) for rows in _shards(parts)),
        kind,
        folder=parts,
    )
    shutil.rmtree(parts)


def _finished(run: Run, fingerprint: bytes) -> Summary | None:
    """The summary of an output that this very run has already written."""
    try:
        with pq.ParquetFile(run.output) as file:
            metadata = json.loads((file.schema_arrow.metadata or {})[b"jaxgrasp"])
            removed = metadata.pop("removed", {})
            if dump(metadata) != fingerprint:
                return None
            summary = Summary(run.candidates)
            for batch in file.iter_batches(1 << 20, columns=["status", "margin"]):
                summary.add(
                    Summary.of(batch["status"].to_numpy(), batch["margin"].to_numpy(zero_copy_only=False))
                )
    except (OSError, pa.ArrowException, ValueError, KeyError):
        return None
    summary.add(Summary(removed=removed))
    summary.resumed = run.candidates
    return summary
