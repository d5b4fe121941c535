"""Forces against one load as Parquet, one row a grasp.

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
    cost, lower     double            the criterion at these forces, and a proven lower bound of every admissible
                                      force's cost; infinite where INFEASIBLE, NaN where INVALID
    force           list<double>      k n numbers: contact after contact, (f_x, f_y, f_n, tau_n) as far as they exist, N
                                      and N m; null where INFEASIBLE or INVALID
    contact_force   list<double[d]>   what each contact does to the object, N, mesh axes; null as above
    escape_twist    list<double>      m numbers: the motion that proves INFEASIBLE (velocity of the centre of mass;
                                      angular velocity), mesh axes, unit norm; null elsewhere
    load_twist      list<double>      m numbers: derivative of the cost with respect to the load; it proves ``lower``;
                                      null where INFEASIBLE or INVALID
    iterations      int32             of the solver

The metadata (key ``jaxgrasp``, JSON) and the schema versions are those of ``formats.parquet``, and ``load``
(``wrench``: force in N and torque in N m about the centre of mass, mesh axes; ``mass``, ``gravity`` and ``g`` where it
is a weight), ``criterion`` (name, weight, length, unit of the cost), ``max_normal`` (N, or null), ``dimension`` and
``contacts`` (the source).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from ..core import Status, UserError
from .lists import fixed_lists, nullable_lists
from .metadata import METADATA_KEY, dump_metadata, stored_metadata
from .parquet import Contacts, as_row, open_parquet, require, row_of

if TYPE_CHECKING:
    from ..forces import OptimalForces

__all__ = ["COLUMNS", "Forces", "force_schema", "force_table", "read_force_row"]

COLUMNS = (
    "row", "grasp_id", "position", "normal", "friction", "torsion", "active", "status", "cost", "lower", "force",
    "contact_force", "escape_twist", "load_twist", "iterations",
)  # fmt: skip
VALUES = ("status", "cost", "lower", "iterations")


@dataclass
class Forces:
    """The answers' columns as numpy arrays of one length: twists (N, m), forces (N, k n) and (N, k, d)."""

    status: np.ndarray
    cost: np.ndarray
    lower: np.ndarray
    force: np.ndarray
    contact_force: np.ndarray
    escape_twist: np.ndarray
    load_twist: np.ndarray
    iterations: np.ndarray

    @classmethod
    def of(cls, answer: OptimalForces, contact_force: np.ndarray, count: int) -> Forces:
        """The columns of the first ``count`` rows of an answer, and its forces (N, k, d) in mesh axes."""
        names = ("status", "cost", "force", "escape_twist", "load_twist", "iterations")
        columns = {name: np.asarray(getattr(answer, name))[:count] for name in names}
        return cls(lower=np.asarray(answer.lower)[:count], contact_force=contact_force[:count], **columns)


def force_schema(fingers: int, dimension: int, metadata: dict[str, Any]) -> pa.Schema:
    """The columns above for k = ``fingers``."""
    real, vector = pa.float64(), pa.list_(pa.float64(), dimension)
    per_contact, vectors = pa.list_(real, fingers), pa.list_(vector, fingers)
    kinds = (
        pa.int64(), pa.int64(), vectors, vectors, per_contact, per_contact, pa.list_(pa.bool_(), fingers),
        pa.int8(), real, real, pa.list_(real), pa.list_(vector), pa.list_(real), pa.list_(real), pa.int32(),
    )  # fmt: skip
    return pa.schema(list(zip(COLUMNS, kinds, strict=True)), {METADATA_KEY: dump_metadata(metadata)})


def force_table(rows: np.ndarray, contacts: Contacts, forces: Forces, kind: pa.Schema) -> pa.Table:
    """One Arrow table of these rows with the columns of ``kind``, nulls where the documentation says so."""
    infeasible = forces.status == Status.INFEASIBLE.value
    unknown = infeasible | (forces.status == Status.INVALID.value)
    missing = {"escape_twist": ~infeasible, "load_twist": unknown, "force": unknown, "contact_force": unknown}
    columns = {"row": pa.array(rows, pa.int64()), "grasp_id": pa.array(contacts.grasp_id, pa.int64())}
    for name in ("position", "normal", "friction", "torsion", "active"):
        columns[name] = fixed_lists(getattr(contacts, name), kind.field(name).type)
    for name, where in missing.items():
        columns[name] = nullable_lists(getattr(forces, name), kind.field(name).type, where)
    for name in VALUES:
        columns[name] = pa.array(getattr(forces, name)).cast(kind.field(name).type)
    return pa.Table.from_arrays([columns[name] for name in kind.names], schema=kind)


def read_force_row(path: Path, number: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Row ``number`` (from 0) of a file of forces, lists as arrays, nulls as None; and the metadata.

    A file of schema version 1 gives the columns of version 2.
    """
    with open_parquet(path) as file:
        metadata = stored_metadata(path, file)
        if "load" not in metadata:
            raise UserError(f"{path} is not a file that jaxgrasp forces wrote")
        former = {"lower": "bound"} if metadata["schema_version"] == 1 else {}
        names = [former.get(name, name) for name in COLUMNS]
        require(path, file, names)
        return as_row(row_of(path, file, number, names).select(names).rename_columns(list(COLUMNS))), metadata
