"""Which rows of a file hold best? Screen a built-in mug into Parquet, and read it with pyarrow."""

import tempfile
from pathlib import Path

import jax
import pyarrow.parquet as pq

from jaxgrasp.jobs import ScreenRequest, plan_screen, screen

jax.config.update("jax_enable_x64", True)  # 64-bit; without it JAX computes in float32

with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "mug.parquet"
    # On the command line: jaxgrasp screen mug --fingers 3 --samples 2000 -o mug.parquet
    summary = screen(plan_screen(ScreenRequest("mug", file, fingers=3, samples=2000)))
    best = pq.read_table(file, filters=[("status", "=", 1)]).sort_by([("margin", "descending")])

print(f"{summary.rows} grasps, {best.num_rows} hold")
for row in best.slice(0, 3).to_pylist():
    print(
        f"grasp {row['grasp_id']}: margin {row['margin']:.4f}, first contact at z = {row['position'][0][2]:.4f} m"
    )

# prints:
# 2000 grasps, 178 hold
# grasp 713: margin 0.8375, first contact at z = 0.0555 m
# grasp 264: margin 0.7767, first contact at z = 0.0325 m
# grasp 1453: margin 0.6771, first contact at z = 0.0605 m
