"""Where the real meshes and published problems are that tests marked ``realdata`` need."""

import os
from pathlib import Path

import pytest


def real_data(name: str) -> Path:
    """The folder ``name`` of JAXGRASP_DATA or, failing that, of the shared data; skips where neither exists."""
    told = os.environ.get("JAXGRASP_DATA")
    folder = Path(told) if told else Path(__file__).parents[3] / "shared" / "data"
    if not (folder / name).is_dir():
        pytest.skip(f"no real data: set JAXGRASP_DATA to a folder that holds {name}/")
    return folder / name


def real_meshes() -> Path:
    """The folder of real meshes."""
    return real_data("meshes")
