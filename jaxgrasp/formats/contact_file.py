"""Parquet files of grasps as input: bare contacts, and grasps that say all about themselves (screened ones)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from ..core import Status, UserError
from .lists import dense
from .metadata import stored_metadata
from .parquet import MOST_CONTACTS, REQUIRED, Contacts, batches, open_parquet, require, row_of

__all__ = ["ContactFile", "GraspFile"]


@dataclass
class ContactFile:
    """A Parquet file of contacts as input: its size, its contacts a grasp, and what it says about itself."""

    path: Path
    rows: int = field(init=False)
    fingers: int = field(init=False)
    columns: list[str] = field(init=False)
    metadata: dict[str, Any] = field(init=False)

    def __post_init__(self):
        with open_parquet(self.path) as file:
            require(self.path, file, REQUIRED)
            self.metadata = stored_metadata(self.path, file)
            optional = ("grasp_id", "friction", "torsion", "active")
            self.columns = [*REQUIRED, *(name for name in optional if name in file.schema_arrow.names)]
            self.rows = file.metadata.num_rows
            if self.rows < 1:
                raise UserError(f"{self.path} holds no rows")
            first = next(batches(self.path, file, 1, list(REQUIRED)), None)
            if first is None:
                raise UserError(f"{self.path} is damaged: it has fewer rows than it says")
        if len(self.metadata.get("centre_of_mass") or (0, 0, 0)) != 3:
            raise UserError(
                f"{self.path}: the metadata under the key 'jaxgrasp' are damaged: the centre of mass is not in space"
            )
        self.fingers = self._vectors(first, "position").shape[1]
        if self.fingers < 1:
            raise UserError(f"{self.path}: the column position holds no contacts in its first row")
        if self.fingers > MOST_CONTACTS:
            raise UserError(
                f"{self.path} has {self.fingers} contacts a grasp; at most {MOST_CONTACTS} are read"
            )

    @property
    def kind(self) -> str:
        """The contact model's name, one of ``contacts.MODELS`` unless the file is newer than we are; "" if not said."""
        return (self.metadata.get("model") or {}).get("kind") or ""

    def _vectors(self, batch: pa.RecordBatch, name: str) -> np.ndarray:
        values = dense(batch.column(name), name)
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
        with open_parquet(self.path) as file:
            for batch in batches(self.path, file, size, self.columns):
                yield self._contacts(batch, start)
                start += len(batch)

    def _contacts(self, batch: pa.RecordBatch, start: int) -> Contacts:
        shape = (len(batch), self.fingers)
        parts: dict[str, np.ndarray] = {name: self._vectors(batch, name) for name in REQUIRED}
        for name in ("friction", "torsion", "active"):
            if name in self.columns:
                values = dense(batch.column(name), name)
                parts[name] = np.broadcast_to(values[:, None], shape) if values.ndim == 1 else values
        for name, values in parts.items():
            if values.shape[:2] != shape:
                raise UserError(
                    f"{self.path}: {name} has {values.shape[1]} contacts a row, position {shape[1]}"
                )
        if "active" in parts and parts["active"].dtype != bool:
            raise UserError(f"{self.path}: the column active must be boolean")
        if "grasp_id" in self.columns:
            grasp_id = dense(batch.column("grasp_id"), "grasp_id")
            if grasp_id.dtype.kind not in "iu" or grasp_id.ndim != 1:
                raise UserError(f"{self.path}: the column grasp_id must hold whole numbers without nulls")
            grasp_id = grasp_id.astype(np.int64)
        else:
            grasp_id = np.arange(start, start + len(batch))
        return Contacts(grasp_id, **parts)


class GraspFile(ContactFile):
    """A Parquet file of grasps that say all about themselves: coefficients, centre of mass, contact model, verdicts.

    What ``jaxgrasp screen`` writes, and what ``jaxgrasp forces`` writes.
    """

    dimension = 3

    @property
    def centre_of_mass(self) -> np.ndarray:
        """(3,) m, mesh frame."""
        return np.asarray(self.metadata["centre_of_mass"], np.float64)

    @property
    def about(self) -> dict[str, Any]:
        """Metadata that files computed from this one take over."""
        return {name: self.metadata.get(name) for name in ("object", "unit", "model")}

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
        with open_parquet(self.path) as file:
            return "status" in file.schema_arrow.names

    def count(self, status: Status | None) -> int:
        """Rows with this status; all rows for None."""
        if status is None:
            return self.rows
        with open_parquet(self.path) as file:
            found = batches(self.path, file, 1 << 20, ["status"])
            return sum(int(np.count_nonzero(_equal(batch, status))) for batch in found)

    def selected(self, size: int, status: Status | None = None) -> Iterator[tuple[np.ndarray, Contacts]]:
        """Row numbers and contacts of the rows with this status, ``size`` at a time, in order."""
        waiting: list[tuple[np.ndarray, Contacts]] = []
        for part in self._kept(size, status):
            waiting.append(part)
            if sum(len(rows) for rows, _ in waiting) < size:
                continue
            rows, contacts = _joined(waiting)
            yield rows[:size], contacts.taken(slice(None, size))
            waiting = [(rows[size:], contacts.taken(slice(size, None)))]
        if any(len(rows) for rows, _ in waiting):
            yield _joined(waiting)

    def _kept(self, size: int, status: Status | None) -> Iterator[tuple[np.ndarray, Contacts]]:
        start = 0
        with open_parquet(self.path) as file:
            for batch in batches(self.path, file, size, [*self.columns, "status"]):
                rows = np.arange(start, start + len(batch))
                kept = np.ones(len(batch), bool) if status is None else _equal(batch, status)
                yield rows[kept], self._contacts(batch, start).taken(kept)
                start += len(batch)

    def row(self, number: int) -> Contacts:
        """The contacts of row ``number``, from 0."""
        with open_parquet(self.path) as file:
            found = row_of(self.path, file, number, self.columns)
            return self._contacts(found.to_batches()[0], number)


def _equal(batch: pa.RecordBatch, status: Status) -> np.ndarray:
    # a null is no status
    return pc.fill_null(batch["status"], 0).to_numpy(zero_copy_only=False) == int(status)


def _joined(parts: list[tuple[np.ndarray, Contacts]]) -> tuple[np.ndarray, Contacts]:
    if len(parts) == 1:
        return parts[0]
    names = Contacts.__dataclass_fields__
    contacts = Contacts(*(np.concatenate([getattr(c, name) for _, c in parts]) for name in names))
    return np.concatenate([rows for rows, _ in parts]), contacts
