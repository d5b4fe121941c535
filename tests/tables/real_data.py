"""Where the real meshes are that tests marked ``realdata`` need."""

import os
from pathlib import Path

import pytest


def real_meshes() -> Path:
    """The folder ``meshes`` of JAXGRASP_DATA or, failing that, of the shared data; skips where neither exists."""
    told = os.environ.get("JAXGRASP_DATA")
    folder = Path(told) if told else Path(__file__).parents[3] / "shared" / "data"
    if not (folder / "meshes").is_dir():
        pytest.skip("no real meshes: set JAXGRASP_DATA to a folder that holds meshes/")
    return folder / "meshes"
