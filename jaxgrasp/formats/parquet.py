"""Our own format: Parquet, one row a grasp. Everything that reads or writes verdicts uses these columns.

With k contacts and n force components each (1 frictionless, 3 hard, 4 soft); ``real`` is double or float,
the dtype of the run; ``real[k][3]`` is fixed_size_list<fixed_size_list<real>[3]>[k]:

    grasp_id        int64           row number of the candidate; gaps where a filter removed candidates
    position        real[k][3]      contact points, m, mesh frame
    normal          real[k][3]      inward normals, mesh frame
    friction        real[k]         mu
    torsion         real[k]         gamma in m; 0 for hard and frictionless contacts
    active          bool[k]         False marks padding: that contact does not exist
    status          int8            jaxgrasp.Status: 1 RESISTANT, 2 NOT_RESISTANT, 3 MARGINAL,
                                    4 UNDECIDED, 5 INVALID
    margin, gap     real            the true margin lies in [margin, margin + gap]; -inf and 0 where no
                                    internal force has a normal component; NaN where INVALID
    rank            int8            of the folded grasp map; null where INVALID
    internal_force  list<real>      k n numbers: contact after contact, (f_x, f_y, f_n, tau_n) as far as
                                    they exist, mean normal force 1; null where margin is -inf or NaN
    escape_twist    list<real>      6 numbers: (velocity of the centre of mass; angular velocity), mesh
                                    axes, unit norm; null where there is none
    iterations      int32           of the solver

(Forces and twists are lists of variable size: few readers take nulls among fixed-size ones. More columns may
follow, which readers of grasps pass over: ``jaxgrasp place`` writes two, see ``placing``.)

The file's metadata holds one key, ``jaxgrasp``, with JSON: ``schema_version``; ``object`` (name, sha256);
``unit``; ``centre_of_mass`` (m, mesh frame); ``model`` (kind, friction, torsion); ``fingers``; ``dtype``;
``seed``; ``command``; ``versions``; and what else the run wants to be known by. No time, no path but the
one typed: the same run gives the same bytes.

A file of contacts needs ``position`` and ``normal`` only; lists of variable size and flat lists of 3 k
numbers will do.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from ..core import UserError

__all__ = [
    "SCHEMA_VERSION",
    "ContactFile",
    "Contacts",
    "Verdicts",
    "read_metadata",
    "read_row",
    "schema",
    "table",
    "write",
]

SCHEMA_VERSION = 1
KEY = b"jaxgrasp"
REQUIRED = ("position", "normal")
# Columns with few distinct values; dictionaries on the others would cost time for nothing.
REPETITIVE = ["normal.list.element.list.element", "friction.list.element", "torsion.list.element"]
REPETITIVE += ["status", "rank", "iterations"]
OPTIONS: dict[str, Any] = {
    "compression": "snappy",  # zstd would save 5 % of the size and take half as long again
    "use_dictionary": REPETITIVE,
    "write_statistics": ["grasp_id", "status", "margin"],
}
VERDICT_COLUMNS = ("status", "margin", "gap", "rank", "internal_force", "escape_twist", "iterations")


@dataclass
class Contacts:
    """grasp_id (n,), position and normal (n, k, 3), friction, torsion and active (n, k) or None."""

    grasp_id: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    friction: np.ndarray | None = None
    torsion: np.ndarray | None = None
    active: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.grasp_id)


@dataclass
class Verdicts:
    """The answers' columns as numpy arrays of one length."""

    status: np.ndarray
    margin: np.ndarray
    gap: np.ndarray
    rank: np.ndarray
    internal_force: np.ndarray
    escape_twist: np.ndarray
    iterations: np.ndarray


def schema(fingers: int, dtype: str, metadata: dict[str, Any] | None = None) -> pa.Schema:
    """The columns above for k = ``fingers``, dtype float64 or float32."""
    real = {"float64": pa.float64(), "float32": pa.float32()}[dtype]
    per_contact = pa.list_(real, fingers)
    vectors = pa.list_(pa.list_(real, 3), fingers)
    columns = [
        ("grasp_id", pa.int64()),
        ("position", vectors),
        ("normal", vectors),
        ("friction", per_contact),
        ("torsion", per_contact),
        ("active", pa.list_(pa.bool_(), fingers)),
        ("status", pa.int8()),
        ("margin", real),
        ("gap", real),
        ("rank", pa.int8()),
        ("internal_force", pa.list_(real)),
        ("escape_twist", pa.list_(real)),
        ("iterations", pa.int32()),
    ]
    return pa.schema(columns, {KEY: dump(metadata)} if metadata is not None else None)


def dump(metadata: dict[str, Any]) -> bytes:
    """JSON with sorted keys: equal metadata are equal bytes."""
    return json.dumps({"schema_version": SCHEMA_VERSION, **metadata}, sort_keys=True).encode()


def _fixed(values: np.ndarray, kind: pa.DataType) -> pa.Array:
    """``values`` (n, ...) as nested fixed-size lists."""
    sizes, leaf = [], kind
    while pa.types.is_fixed_size_list(leaf):
        sizes.append(leaf.list_size)
        leaf = leaf.value_type
    array = pa.array(np.ascontiguousarray(values).reshape(-1), leaf)
    for size in reversed(sizes):
        array = pa.FixedSizeListArray.from_arrays(array, size)
    return array


def _nullable(values: np.ndarray, kind: pa.DataType, missing: Any) -> pa.Array:
    """``values`` (n, size) as lists, null in the rows where ``missing``."""
    ends = np.concatenate([[0], np.cumsum(np.where(missing, 0, values.shape[1]))]).astype(np.int32)
    kept = pa.array(np.ascontiguousarray(values[~missing]).reshape(-1), kind.value_type)
    return pa.ListArray.from_arrays(pa.array(ends), kept, mask=pa.array(missing))


def table(contacts: Contacts, verdicts: Verdicts, kind: pa.Schema) -> pa.Table:
    """One Arrow table of these rows with the columns of ``kind``, nulls where the documentation says so."""
    invalid = np.isnan(verdicts.margin)
    no_force = ~np.isfinite(verdicts.margin)
    twist = verdicts.escape_twist
    no_twist = ~np.isfinite(twist).all(axis=1) | ~twist.any(axis=1)
    rank = np.where(invalid, 0, verdicts.rank).astype(np.int8)
    columns = {
        "grasp_id": pa.array(contacts.grasp_id, pa.int64()),
        "rank": pa.array(rank, pa.int8(), mask=invalid),
        "internal_force": _nullable(verdicts.internal_force, kind.field("internal_force").type, no_force),
        "escape_twist": _nullable(twist, kind.field("escape_twist").type, no_twist),
    }
    for name in ("position", "normal", "friction", "torsion", "active"):
        columns[name] = _fixed(getattr(contacts, name), kind.field(name).type)
    for name in ("status", "margin", "gap", "iterations"):
        columns[name] = pa.array(getattr(verdicts, name)).cast(kind.field(name).type)
    return pa.Table.from_arrays([columns[name] for name in kind.names], schema=kind)


def write(path: Path, rows: Iterable[pa.Table], kind: pa.Schema, folder: Path | None = None) -> None:
    """Write ``rows``, a row group each, and rename: the file appears whole or not at all.

    The unfinished file lies in ``folder``, which must be on the same disk; by default beside ``path``.
    """
    beside = (folder or path.parent) / f".{path.name}.{os.getpid()}.tmp"
    try:
        with pq.ParquetWriter(beside, kind, **OPTIONS) as writer:
            for part in rows:
                writer.write_table(part, row_group_size=max(1, len(part)))
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def _open(path: Path) -> pq.ParquetFile:
    if not path.exists():
        raise UserError(f"{path}: no such file")
    try:
        return pq.ParquetFile(path)
    except (pa.ArrowException, OSError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"{path} cannot be read as Parquet: {reason}") from error


def _require(path: Path, file: pq.ParquetFile, names: tuple[str, ...]) -> None:
    missing = [name for name in names if name not in file.schema_arrow.names]
    if missing:
        raise UserError(
            f"{path} lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; it has: "
            f"{', '.join(file.schema_arrow.names)}"
        )


def _metadata(path: Path, file: pq.ParquetFile) -> dict[str, Any]:
    raw = (file.schema_arrow.metadata or {}).get(KEY)
    if raw is None:
        return {}
    try:
        found = json.loads(raw)
        version = found["schema_version"]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: the metadata under the key 'jaxgrasp' is damaged") from error
    if version != SCHEMA_VERSION:
        raise UserError(
            f"{path} has schema version {version}, this jaxgrasp reads {SCHEMA_VERSION}; update jaxgrasp"
        )
    return found


def read_metadata(path: Path) -> dict[str, Any]:
    """What the run said about itself; empty for a file that jaxgrasp did not write."""
    with _open(path) as file:
        return _metadata(path, file)


def _dense(array: pa.Array, name: str) -> np.ndarray:
    """Nested lists of one size as an array; nulls become NaN (False for booleans)."""
    kind = array.type
    if not (pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)):
        if pa.types.is_boolean(kind):
            return np.asarray(pc.fill_null(array, False).to_numpy(zero_copy_only=False), bool)
        if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
            raise UserError(f"the column {name} must hold numbers, not {kind}")
        if pa.types.is_integer(kind) and not array.null_count:
            return array.to_numpy(zero_copy_only=False)
        wide = kind if pa.types.is_float32(kind) else pa.float64()
        return pc.fill_null(array.cast(wide), float("nan")).to_numpy(zero_copy_only=False)
    valid = np.asarray(array.is_valid().to_numpy(zero_copy_only=False), bool)
    if pa.types.is_fixed_size_list(kind):
        size = kind.list_size
    else:
        sizes = np.unique(
            pc.call_function("list_value_length", [array]).drop_null().to_numpy(zero_copy_only=False)
        )
        if len(sizes) > 1:
            raise UserError(
                f"the column {name} holds lists of different lengths, {sizes.min()} to {sizes.max()}; pad to "
                "one length and mark the padding False in the column active"
            )
        size = int(sizes[0]) if len(sizes) else 0
    inner = _dense(array.flatten(), name)
    inner = inner.reshape(int(valid.sum()), size, *inner.shape[1:])
    if valid.all():
        return inner
    fill = np.full(
        (len(array), *inner.shape[1:]), False if inner.dtype == bool else np.nan, np.result_type(inner, bool)
    )
    fill[valid] = inner
    return fill


@dataclass
class ContactFile:
    """A Parquet file of contacts as input: its size, its contacts a grasp, and what it says about itself."""

    path: Path
    rows: int = field(init=False)
    fingers: int = field(init=False)
    columns: list[str] = field(init=False)
    metadata: dict[str, Any] = field(init=False)

    def __post_init__(self):
        with _open(self.path) as file:
            _require(self.path, file, REQUIRED)
            self.metadata = _metadata(self.path, file)
            optional = ("grasp_id", "friction", "torsion", "active")
            self.columns = [*REQUIRED, *(name for name in optional if name in file.schema_arrow.names)]
            self.rows = file.metadata.num_rows
            if self.rows < 1:
                raise UserError(f"{self.path} holds no rows")
            first = next(file.iter_batches(1, columns=list(REQUIRED)))
        self.fingers = self._vectors(first, "position").shape[1]
        if self.fingers < 1:
            raise UserError(f"{self.path}: the column position holds no contacts in its first row")

    def _vectors(self, batch: pa.RecordBatch, name: str) -> np.ndarray:
        values = _dense(batch.column(name), name)
        if values.ndim == 2 and values.shape[1] % 3 == 0:
            values = values.reshape(len(values), -1, 3)
        if values.ndim != 3 or values.shape[2] != 3:
            raise UserError(
                f"{self.path}: the column {name} must hold k x 3 numbers a row, got {values.shape[1:]}"
            )
        return values

    def chunks(self, size: int) -> Iterator[Contacts]:
        """The rows in order, ``size`` at a time."""
        start = 0
        with _open(self.path) as file:
            for batch in file.iter_batches(size, columns=self.columns):
                yield self._contacts(batch, start)
                start += len(batch)

    def _contacts(self, batch: pa.RecordBatch, start: int) -> Contacts:
        shape = (len(batch), self.fingers)
        parts: dict[str, np.ndarray] = {name: self._vectors(batch, name) for name in REQUIRED}
        for name in ("friction", "torsion", "active"):
            if name in self.columns:
                values = _dense(batch.column(name), name)
                parts[name] = np.broadcast_to(values[:, None], shape) if values.ndim == 1 else values
        for name, values in parts.items():
            if values.shape[:2] != shape:
                raise UserError(
                    f"{self.path}: {name} has {values.shape[1]} contacts a row, position {shape[1]}"
                )
        if "active" in parts and parts["active"].dtype != bool:
            raise UserError(f"{self.path}: the column active must be boolean")
        if "grasp_id" in self.columns:
            grasp_id = _dense(batch.column("grasp_id"), "grasp_id")
            if grasp_id.dtype.kind not in "iu":
                raise UserError(f"{self.path}: the column grasp_id must hold whole numbers without nulls")
            grasp_id = grasp_id.astype(np.int64)
        else:
            grasp_id = np.arange(start, start + len(batch))
        return Contacts(grasp_id, **parts)


def read_row(path: Path, row: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Row ``row`` (from 0) of a file of verdicts, lists as arrays, nulls as None; and the metadata."""
    with _open(path) as file:
        _require(path, file, (*REQUIRED, "friction", "torsion", "active", *VERDICT_COLUMNS))
        metadata = _metadata(path, file)
        total = file.metadata.num_rows
        if not 0 <= row < total:
            raise UserError(f"{path} has rows 0 to {total - 1}, there is no row {row}")
        group = 0
        while row >= file.metadata.row_group(group).num_rows:
            row -= file.metadata.row_group(group).num_rows
            group += 1
        found = file.read_row_group(group).slice(row, 1).combine_chunks()
    values: dict[str, Any] = {}
    for name in found.column_names:
        item = found.column(name)[0]
        if not item.is_valid:
            values[name] = None
        elif pa.types.is_nested(item.type):
            values[name] = np.asarray(item.as_py())
        else:
            values[name] = item.as_py()
    return values, metadata
