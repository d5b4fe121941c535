"""Forces against one load as Parquet, one row a grasp; and the files of grasps they are computed from.

With k contacts, n force components each (1 frictionless, 3 hard, 4 soft; 1 and 2 in the plane), d = 3 coordinates and
m = 6 (d = 2 and m = 3 in the plane):

    row             int64             row of the source, from 0; gaps where rows were not asked for
    grasp_id        int64             the source's
    position        double[k][d]      contact points, m, mesh frame
    normal          double[k][d]      inward normals, mesh frame
    friction        double[k]         mu
    torsion         double[k]         gamma in m; 0 for hard and frictionless contacts
    active          bool[k]           False marks padding: that contact does not exist
    status          int8              jaxgrasp.Status: 5 INVALID, 6 OPTIMAL, 7 INFEASIBLE, 8 STALLED
    cost, bound     double            the criterion at these forces, and a proven lower bound of every admissible
                                      force's cost; infinite where INFEASIBLE, NaN where INVALID
    force           list<double>      k n numbers: contact after contact, (f_x, f_y, f_n, tau_n) as far as they exist, N
                                      and N m; null where INFEASIBLE or INVALID
    contact_force   list<double[d]>   what each contact does to the object, N, mesh axes; null as above
    escape_twist    list<double>      m numbers: the motion that proves INFEASIBLE (velocity of the centre of mass;
                                      angular velocity), mesh axes, unit norm; null elsewhere
    load_twist      list<double>      m numbers: derivative of the cost with respect to the load; it proves the bound;
                                      null where INFEASIBLE or INVALID
    iterations      int32             of the solver

The metadata (key ``jaxgrasp``, JSON) are those of ``formats.parquet``, and ``load`` (``wrench``: force in N and torque
in N m about the centre of mass, mesh axes; ``mass``, ``gravity`` and ``g`` where it is a weight), ``criterion`` (name,
weight, length, unit of the cost), ``max_normal`` (N, or null), ``dimension`` and ``contacts`` (the source).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from ..core import Status, UserError
from .parquet import ContactFile, Contacts, dump, read_metadata

__all__ = ["COLUMNS", "Forces", "GraspFile", "read_force_row", "force_schema", "force_table"]

KEY = b"jaxgrasp"
COLUMNS = (
    "row", "grasp_id", "position", "normal", "friction", "torsion", "active", "status", "cost", "bound", "force",
    "contact_force", "escape_twist", "load_twist", "iterations",
)  # fmt: skip
VALUES = ("status", "cost", "bound", "iterations")


@dataclass
class Forces:
    """The answers' columns as numpy arrays of one length: twists (N, m), forces (N, k n) and (N, k, d)."""

    status: np.ndarray
    cost: np.ndarray
    bound: np.ndarray
    force: np.ndarray
    contact_force: np.ndarray
    escape_twist: np.ndarray
    load_twist: np.ndarray
    iterations: np.ndarray


def force_schema(fingers: int, dimension: int, metadata: dict[str, Any]) -> pa.Schema:
    """The columns above for k = ``fingers``."""
    real, vector = pa.float64(), pa.list_(pa.float64(), dimension)
    per_contact, vectors = pa.list_(real, fingers), pa.list_(vector, fingers)
    kinds = (
        pa.int64(), pa.int64(), vectors, vectors, per_contact, per_contact, pa.list_(pa.bool_(), fingers),
        pa.int8(), real, real, pa.list_(real), pa.list_(vector), pa.list_(real), pa.list_(real), pa.int32(),
    )  # fmt: skip
    return pa.schema(list(zip(COLUMNS, kinds, strict=True)), {KEY: dump(metadata)})


def _lists(values: np.ndarray, kind: pa.DataType, missing: np.ndarray | None = None) -> pa.Array:
    """``values`` (N, size) or (N, size, d) as lists of the type ``kind``, null in the rows where ``missing``."""
    kept = values if missing is None else values[~missing]
    inner = pa.array(np.ascontiguousarray(kept).reshape(-1))
    for size in reversed(values.shape[2:]):
        inner = pa.FixedSizeListArray.from_arrays(inner, size)
    if missing is None:
        return pa.FixedSizeListArray.from_arrays(inner, values.shape[1])
    ends = np.concatenate([[0], np.cumsum(np.where(missing, 0, values.shape[1]))]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(ends), inner.cast(kind.value_type), mask=pa.array(missing))


def force_table(rows: np.ndarray, contacts: Contacts, forces: Forces, kind: pa.Schema) -> pa.Table:
    """One Arrow table of these rows with the columns of ``kind``, nulls where the documentation says so."""
    infeasible = forces.status == Status.INFEASIBLE.value
    unknown = infeasible | (forces.status == Status.INVALID.value)
    missing = {"escape_twist": ~infeasible, "load_twist": unknown, "force": unknown, "contact_force": unknown}
    columns = {"row": pa.array(rows, pa.int64()), "grasp_id": pa.array(contacts.grasp_id, pa.int64())}
    for name in ("position", "normal", "friction", "torsion", "active"):
        columns[name] = _lists(getattr(contacts, name), kind.field(name).type)
    for name, where in missing.items():
        columns[name] = _lists(getattr(forces, name), kind.field(name).type, where)
    for name in VALUES:
        columns[name] = pa.array(getattr(forces, name)).cast(kind.field(name).type)
    return pa.Table.from_arrays([columns[name] for name in kind.names], schema=kind)


class GraspFile(ContactFile):
    """A Parquet file of grasps that say all about themselves: coefficients, centre of mass, contact model, verdicts.

    What ``jaxgrasp screen`` writes, and what ``jaxgrasp forces`` writes.
    """

    def __post_init__(self):
        super().__post_init__()
        known = {*self.columns, *(("status",) if self._has_status() else ())}
        lacking = [name for name in ("friction", "torsion", "active", "status") if name not in known]
        lacking += [name for name in ("centre_of_mass", "model") if not self.metadata.get(name)]
        if lacking:
            raise UserError(
                f"{self.path} lacks {', '.join(lacking)}: screen it first, with jaxgrasp screen {self.path}"
            )

    def _has_status(self) -> bool:
        with pq.ParquetFile(self.path) as file:
            return "status" in file.schema_arrow.names

    def count(self, status: Status | None) -> int:
        """Rows with this status; all rows for None."""
        if status is None:
            return self.rows
        with pq.ParquetFile(self.path) as file:
            batches = file.iter_batches(1 << 20, columns=["status"])
            return sum(int(np.count_nonzero(_equal(batch, status))) for batch in batches)

    def selected(self, size: int, status: Status | None = None) -> Iterator[tuple[np.ndarray, Contacts]]:
        """Row numbers and contacts of the rows with this status, ``size`` at a time, in order."""
        waiting: list[tuple[np.ndarray, Contacts]] = []
        for part in self._kept(size, status):
            waiting.append(part)
            if sum(len(rows) for rows, _ in waiting) < size:
                continue
            rows, contacts = _joined(waiting)
            yield rows[:size], _taken(contacts, slice(None, size))
            waiting = [(rows[size:], _taken(contacts, slice(size, None)))]
        if any(len(rows) for rows, _ in waiting):
            yield _joined(waiting)

    def _kept(self, size: int, status: Status | None) -> Iterator[tuple[np.ndarray, Contacts]]:
        start = 0
        with pq.ParquetFile(self.path) as file:
            for batch in file.iter_batches(size, columns=[*self.columns, "status"]):
                rows = np.arange(start, start + len(batch))
                kept = np.ones(len(batch), bool) if status is None else _equal(batch, status)
                yield rows[kept], _taken(self._contacts(batch, start), kept)
                start += len(batch)

    def row(self, number: int) -> Contacts:
        """The contacts of row ``number``, from 0."""
        return self._contacts(_one(self.path, number, self.columns), number)


def _equal(batch: pa.RecordBatch, status: Status) -> np.ndarray:
    # a null is no status
    return pc.fill_null(batch["status"], 0).to_numpy(zero_copy_only=False) == int(status)


def _taken(contacts: Contacts, index: Any) -> Contacts:
    return Contacts(*(getattr(contacts, name)[index] for name in Contacts.__dataclass_fields__))


def _joined(parts: list[tuple[np.ndarray, Contacts]]) -> tuple[np.ndarray, Contacts]:
    if len(parts) == 1:
        return parts[0]
    names = Contacts.__dataclass_fields__
    contacts = Contacts(*(np.concatenate([getattr(c, name) for _, c in parts]) for name in names))
    return np.concatenate([rows for rows, _ in parts]), contacts


def _one(path: Path, number: int, columns: list[str]) -> pa.RecordBatch:
    """Row ``number`` alone, by reading its row group."""
    with pq.ParquetFile(path) as file:
        total = file.metadata.num_rows
        if not 0 <= number < total:
            raise UserError(f"{path} has rows 0 to {total - 1}, there is no row {number}")
        group = 0
        while number >= file.metadata.row_group(group).num_rows:
            number -= file.metadata.row_group(group).num_rows
            group += 1
        found = file.read_row_group(group, columns=columns)
    return found.slice(number, 1).combine_chunks().to_batches()[0]


def read_force_row(path: Path, number: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Row ``number`` (from 0) of a file of forces, lists as arrays, nulls as None; and the metadata."""
    metadata = read_metadata(path)
    if "load" not in metadata:
        raise UserError(f"{path} is not a file that jaxgrasp forces wrote")
    return as_row(pa.Table.from_batches([_one(path, number, list(COLUMNS))])), metadata


def as_row(found: pa.Table) -> dict[str, Any]:
    """The one row of a table: lists as arrays, nulls as None."""
    values = found.to_pylist()[0]
    return {name: np.asarray(value) if isinstance(value, list) else value for name, value in values.items()}
