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
    margin, upper   real            the true margin lies in [margin, upper], so margin is its lower bound; both
                                    -inf where no internal force has a normal component; NaN where INVALID
    rank            int8            of the folded grasp map; null where INVALID
    internal_force  list<real>      k n numbers: contact after contact, (f_x, f_y, f_n, tau_n) as far as
                                    they exist, mean normal force 1; null where margin is -inf or NaN
    escape_twist    list<real>      6 numbers: (velocity of the centre of mass; angular velocity), mesh
                                    axes, unit norm; null where there is none
    bound_twist     list<real>      6 numbers like these: the twist that proves ``upper``; null where INVALID. Files
                                    of version 0.1 lack it
    iterations      int32           of the solver

(Forces and twists are lists of variable size: few readers take nulls among fixed-size ones. More columns may
follow, which readers of grasps pass over: ``jaxgrasp place`` writes two, see ``jobs.place``.)

The file's metadata holds one key, ``jaxgrasp``, with JSON (``formats.metadata``): ``schema_version``;
``object`` (name, sha256); ``unit``; ``centre_of_mass`` (m, mesh frame); ``model`` (kind, friction, torsion);
``fingers``; ``dtype``; ``seed``; ``command``; ``versions``; and what else the run wants to be known by. No time, no
path but the one typed: the same run gives the same bytes.

A file of contacts needs ``position`` and ``normal`` only; lists of variable size and flat lists of 3 k
numbers will do (``formats.contact_file`` reads them).
"""

from __future__ import annotations

import os
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..core import UserError, check_file
from .lists import fixed_lists, nullable_lists
from .metadata import METADATA_KEY, dump_metadata, stored_metadata

if TYPE_CHECKING:
    from ..resistance import WrenchResistance

__all__ = [
    "Contacts",
    "Verdicts",
    "as_row",
    "batches",
    "damage_told",
    "open_parquet",
    "read_metadata",
    "read_row",
    "require",
    "row_of",
    "verdict_schema",
    "verdict_table",
    "write",
]

REQUIRED = ("position", "normal")
MOST_BYTES = 1 << 40  # rows are read as they are needed, so memory does not follow the size
MOST_CONTACTS = 1024  # of a grasp
LONGEST = 4 * MOST_CONTACTS  # numbers of a row
BATCH = 4096  # rows read at a time where one is wanted
# pyarrow's own, and what NumPy and the standard library make of numbers and text that cannot be.
DAMAGED = (
    pa.ArrowException,
    OSError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    OverflowError,
    MemoryError,
)
# Columns with few distinct values; dictionaries on the others would cost time for nothing.
REPETITIVE = ["normal.list.element.list.element", "friction.list.element", "torsion.list.element"]
REPETITIVE += ["status", "rank", "iterations"]
OPTIONS: dict[str, Any] = {
    "compression": "snappy",  # zstd would save 5 % of the size and take half as long again
    "use_dictionary": REPETITIVE,
    "write_statistics": ["grasp_id", "status", "margin"],
}
VERDICT_COLUMNS = ("status", "margin", "upper", "rank", "internal_force", "escape_twist", "iterations")
LATER = "bound_twist"  # a column that files of version 0.1 lack


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

    def taken(self, index: Any) -> Contacts:
        """The rows that ``index`` chooses: a slice, numbers or a mask."""
        values = (getattr(self, name) for name in Contacts.__dataclass_fields__)
        return Contacts(*(None if value is None else value[index] for value in values))  # pyright: ignore[reportArgumentType]

    def padded(self, rows: int) -> Contacts:
        """With lanes of inactive contacts up to ``rows``, so that every chunk has one shape; they end at once."""
        parts = []
        for name in Contacts.__dataclass_fields__:
            value = getattr(self, name)
            full = np.zeros((max(rows, len(value)), *value.shape[1:]), value.dtype)
            full[: len(value)] = value
            parts.append(full)
        return Contacts(*parts)


@dataclass
class Verdicts:
    """The answers' columns as numpy arrays of one length."""

    status: np.ndarray
    margin: np.ndarray
    upper: np.ndarray
    rank: np.ndarray
    internal_force: np.ndarray
    escape_twist: np.ndarray
    bound_twist: np.ndarray
    iterations: np.ndarray

    @classmethod
    def of(cls, answer: WrenchResistance, rows: Any = slice(None)) -> Verdicts:
        """The columns of the ``rows`` of an answer: a slice, numbers or a mask."""
        names = ("status", "upper", "rank", "internal_force", "escape_twist", "bound_twist", "iterations")
        columns = {name: np.asarray(getattr(answer, name))[rows] for name in names}
        return cls(margin=np.asarray(answer.lower)[rows], **columns)


def verdict_schema(fingers: int, dtype: str, metadata: dict[str, Any] | None = None) -> pa.Schema:
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
        ("upper", real),
        ("rank", pa.int8()),
        ("internal_force", pa.list_(real)),
        ("escape_twist", pa.list_(real)),
        ("bound_twist", pa.list_(real)),
        ("iterations", pa.int32()),
    ]
    return pa.schema(columns, {METADATA_KEY: dump_metadata(metadata)} if metadata is not None else None)


def verdict_table(contacts: Contacts, verdicts: Verdicts, kind: pa.Schema) -> pa.Table:
    """One Arrow table of these rows with the columns of ``kind``, nulls where the documentation says so."""
    invalid = np.isnan(verdicts.margin)
    no_force = ~np.isfinite(verdicts.margin)
    twist = verdicts.escape_twist
    no_twist = np.asarray(~np.isfinite(twist).all(axis=1) | ~twist.any(axis=1))
    rank = np.where(invalid, 0, verdicts.rank).astype(np.int8)
    columns = {
        "grasp_id": pa.array(contacts.grasp_id, pa.int64()),
        "rank": pa.array(rank, pa.int8(), mask=invalid),
        "internal_force": nullable_lists(
            verdicts.internal_force, kind.field("internal_force").type, no_force
        ),
        "escape_twist": nullable_lists(twist, kind.field("escape_twist").type, no_twist),
        "bound_twist": nullable_lists(verdicts.bound_twist, kind.field("bound_twist").type, invalid),
    }
    for name in ("position", "normal", "friction", "torsion", "active"):
        columns[name] = fixed_lists(getattr(contacts, name), kind.field(name).type)
    for name in ("status", "margin", "upper", "iterations"):
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


@contextmanager
def open_parquet(path: Path) -> Generator[pq.ParquetFile]:
    """The file, open; UserError where there is none, where it is no Parquet, and where its bytes turn out damaged."""
    check_file(path, MOST_BYTES)
    with damage_told(f"{path} cannot be read as Parquet"):
        file = pq.ParquetFile(path)
    with file, damage_told(f"{path} is damaged"):
        yield file


@contextmanager
def damage_told(what: str) -> Generator[None]:
    """What a reader of foreign bytes may raise, as a UserError: ``what``, and the reason in one line."""
    try:
        yield
    except UserError:
        raise
    except DAMAGED as error:
        reason = (str(error).splitlines() or [""])[0][:200] or type(error).__name__
        raise UserError(f"{what}: {reason}") from error


def require(path: Path, file: pq.ParquetFile, names: Sequence[str]) -> None:
    """UserError where the file lacks one of these columns."""
    missing = [name for name in names if name not in file.schema_arrow.names]
    if missing:
        raise UserError(
            f"{path} lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; it has: "
            f"{', '.join(file.schema_arrow.names)}"
        )


def read_metadata(path: Path) -> dict[str, Any]:
    """What the run said about itself; empty for a file that jaxgrasp did not write."""
    with open_parquet(path) as file:
        return stored_metadata(path, file)


def row_of(path: Path, file: pq.ParquetFile, number: int, columns: Sequence[str] | None = None) -> pa.Table:
    """Row ``number`` alone, from 0, by reading its row group."""
    total = file.metadata.num_rows
    if not 0 <= number < total:
        raise UserError(f"{path} has rows 0 to {total - 1}, there is no row {number}")
    group = 0
    while number >= file.metadata.row_group(group).num_rows:
        number -= file.metadata.row_group(group).num_rows
        group += 1
    for batch in batches(path, file, BATCH, columns, [group]):
        if number < len(batch):
            return pa.Table.from_batches([batch.slice(number, 1)]).combine_chunks()
        number -= len(batch)
    raise UserError(f"{path} is damaged: it has fewer rows than it says")


def batches(
    path: Path,
    file: pq.ParquetFile,
    size: int,
    columns: Sequence[str] | None = None,
    groups: Sequence[int] | None = None,
) -> Iterator[pa.RecordBatch]:
    """Rows in order, ``size`` at a time. UserError, before any is read, where rows are longer than a grasp's."""
    for number in range(file.num_row_groups) if groups is None else groups:
        group = file.metadata.row_group(number)
        for column in map(group.column, range(group.num_columns)):
            name, most = column.path_in_schema.split(".")[0], LONGEST * max(1, group.num_rows)
            if (columns is None or name in columns) and column.num_values > most:
                raise UserError(
                    f"{path}: the column {name} has {column.num_values // max(1, group.num_rows)} numbers a row; "
                    f"grasps of up to {MOST_CONTACTS} contacts are read"
                )
    return file.iter_batches(size, columns=columns, row_groups=groups)


def as_row(found: pa.Table) -> dict[str, Any]:
    """The one row of a table: lists as arrays, nulls as None."""
    values = found.to_pylist()[0]
    return {name: np.asarray(value) if isinstance(value, list) else value for name, value in values.items()}


def read_row(path: Path, row: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Row ``row`` (from 0) of a file of verdicts, lists as arrays, nulls as None; and the metadata.

    A file of schema version 1 gives the columns of version 2.
    """
    with open_parquet(path) as file:
        metadata = stored_metadata(path, file)
        former = metadata.get("schema_version") == 1
        names = [{"upper": "gap"}.get(name, name) if former else name for name in VERDICT_COLUMNS]
        require(path, file, (*REQUIRED, "friction", "torsion", "active", *names, "grasp_id"))
        values = {LATER: None} | as_row(row_of(path, file, row))
    if former:
        margin, gap = values["margin"], values.pop("gap")
        values["upper"] = None if margin is None or gap is None else margin + gap
    return values, metadata
