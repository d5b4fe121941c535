"""Grasps checked in motion as Parquet, one row a grasp: what ``jaxgrasp check`` writes.

    row, grasp_id   int64             in the source (a sampled grasp: its number)
    verdict         int8              a Status: controllability
    status          int8              a Status: wrench resistance
    rank            float64           of the controllability matrix, 12 where controllable; null where INVALID
    effort          float64           of the direction hardest to reach, in weights; null where not controllable
    weakest         list<float64>[6]  (velocity m/s; angular velocity rad/s): the motion least or not affected
    recovered       bool              null where there is no equilibrium to return to
    settling_time   float64           s after the push begins, the longest of six; null where not recovered
    peak_force      float64           N, the largest normal force; null as recovered
    cone_use        float64           the largest share of friction used; null as recovered

The metadata (key ``jaxgrasp``, JSON) are those of the screening (``formats.parquet``), and ``mass`` (kg), ``gravity``
(m/s^2, mesh axes), ``inertia`` (the mesh that it comes from), ``checked`` (grasps) and ``chunk``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from .lists import fixed_lists
from .metadata import METADATA_KEY, dump_metadata

__all__ = ["check_schema", "check_table", "read_check_columns"]

REAL = pa.float64()
COLUMNS = (
    ("row", pa.int64()),
    ("grasp_id", pa.int64()),
    ("verdict", pa.int8()),
    ("status", pa.int8()),
    ("rank", REAL),
    ("effort", REAL),
    ("weakest", pa.list_(REAL, 6)),
    ("recovered", pa.bool_()),
    ("settling_time", REAL),
    ("peak_force", REAL),
    ("cone_use", REAL),
)


def check_schema(metadata: dict[str, Any]) -> pa.Schema:
    """The columns above."""
    return pa.schema(list(COLUMNS), {METADATA_KEY: dump_metadata(metadata)})


def check_table(columns: dict[str, np.ndarray], steerable: np.ndarray, kind: pa.Schema) -> pa.Table:
    """One Arrow table of these columns.

    steerable  (N,) there is an equilibrium, and forces reach all of the motion
    """
    missing = {
        "rank": columns["rank"] < 0,
        "effort": ~np.isfinite(columns["effort"]),
        "recovered": ~steerable,
        "settling_time": ~columns["recovered"],
        "peak_force": ~steerable,
        "cone_use": ~steerable,
    }
    arrays = []
    for name in kind.names:
        values = columns[name]
        if values.ndim == 2:
            arrays.append(fixed_lists(values, kind.field(name).type))
        else:
            arrays.append(pa.array(values, mask=missing.get(name)).cast(kind.field(name).type))
    return pa.Table.from_arrays(arrays, schema=kind)


def read_check_columns(path: Path) -> dict[str, np.ndarray]:
    """The columns of a file of checked grasps as arrays: NaN where a number is null, False where recovered is."""
    table = pq.read_table(path)
    columns = {name: table[name] for name in table.column_names if name != "weakest"}
    columns["recovered"] = columns["recovered"].fill_null(False)
    return {name: x.to_numpy() for name, x in columns.items()}
