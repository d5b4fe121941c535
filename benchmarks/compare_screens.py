"""Do two screenings of the same candidates say the same? Files of ``jaxgrasp screen``, of any schema version.

    jaxgrasp screen mug --fingers 3 --samples 20000 -o before.parquet     (one version of the code)
    jaxgrasp screen mug --fingers 3 --samples 20000 -o after.parquet      (another one)
    python benchmarks/compare_screens.py before.parquet after.parquet

grasp_id, position, normal, status and rank must be the same in every row, both ends of the margin's bracket equal to
1e-12. Prints the largest difference of each column; exit code 1 where one is too large.
"""

from __future__ import annotations

import argparse
import json
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

SAME = ("grasp_id", "position", "normal", "status", "rank")
CLOSE = ("margin", "upper")


def column(table: pa.Table, name: str) -> np.ndarray:
    """The numbers of a column in one row of the array for each row of the table; nulls are NaN."""
    values = table[name].combine_chunks()
    while pa.types.is_nested(values.type):
        values = values.flatten()
    return np.asarray(values.to_numpy(zero_copy_only=False), float).reshape(len(table), -1)


def read(path: str) -> dict[str, np.ndarray]:
    """The columns to compare."""
    table = pq.read_table(path)
    version = json.loads(table.schema.metadata[b"jaxgrasp"])["schema_version"]
    found = {name: column(table, name) for name in (*SAME, "margin")}
    found["upper"] = found["margin"] + column(table, "gap") if version == 1 else column(table, "upper")
    return found


def difference(before: np.ndarray, after: np.ndarray) -> float:
    """The largest one; 0 where both are infinite or both are NaN, infinite where only one of them is."""
    if before.shape != after.shape:
        return float("inf")
    equal = (before == after) | (np.isnan(before) & np.isnan(after))
    with np.errstate(invalid="ignore"):
        apart = np.where(equal, 0.0, np.abs(after - before))
    return float(np.max(np.nan_to_num(apart, nan=np.inf), initial=0.0))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("before")
    parser.add_argument("after")
    parser.add_argument("--tolerance", type=float, default=1e-12, help="of the margin's bracket")
    asked = parser.parse_args()
    before, after = read(asked.before), read(asked.after)
    print(f"{len(before['status']):,} rows before, {len(after['status']):,} after")
    failed = False
    for name in (*SAME, *CLOSE):
        found = difference(before[name], after[name])
        good = found <= (asked.tolerance if name in CLOSE else 0.0)
        failed |= not good
        print(f"{name:9} largest difference {found:.3g}{'' if good else '  TOO LARGE'}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
