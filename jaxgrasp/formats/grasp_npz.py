"""One grasp in a file (.npz), bit for bit: what reproduces a lane in a bug report."""

from __future__ import annotations

import json
import os
import zlib
from pathlib import Path
from zipfile import BadZipFile

import jax.numpy as jnp
import numpy as np

from ..contacts import Frictionless, Grasp, HardFinger, SoftFinger

__all__ = ["load_grasp", "save_grasp"]

FORMAT, VERSION = "jaxgrasp lane", 1
_MODELS = {"Frictionless": Frictionless, "HardFinger": HardFinger, "SoftFinger": SoftFinger}


def save_grasp(grasp: Grasp, path: str | os.PathLike) -> None:
    """Write one grasp to ``path`` (.npz), bit for bit, for a bug report; ``load_grasp`` reads it back.

    Index the batch for the failing lane: ``save_grasp(grasps[17], "lane.npz")``. The file holds arrays and JSON, no
    code; it is written beside and renamed.
    """
    path = Path(path)
    model = type(grasp.model).__name__
    if model not in _MODELS:
        raise ValueError(f"cannot save the contact model {model}; known models: {', '.join(_MODELS)}")
    header = {"format": FORMAT, "version": VERSION, "model": model}
    beside = path.with_name(path.name + ".tmp")
    try:
        with open(beside, "wb") as file:
            np.savez(
                file,
                header=np.frombuffer(json.dumps(header).encode(), np.uint8),
                position=np.asarray(grasp.position),
                normal=np.asarray(grasp.normal),
                friction=np.asarray(grasp.model.friction_coefficient),
                torsion=np.asarray(grasp.model.torsion_coefficient),
                active=np.asarray(grasp.active),
            )
        os.replace(beside, path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def load_grasp(path: str | os.PathLike) -> Grasp:
    """The grasp that ``save_grasp`` wrote; ValueError if the file is not one."""
    try:
        with open(path, "rb") as source, np.load(source, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays["header"].tobytes().decode())
        if (header["format"], header["version"]) != (FORMAT, VERSION):
            raise ValueError(f"it holds {header['format']!r} version {header['version']}")
        model = _MODELS[header["model"]]()
        coefficients = jnp.asarray(arrays["friction"]), jnp.asarray(arrays["torsion"])
        model = model.with_coefficients(*coefficients)
        return Grasp(arrays["position"], arrays["normal"], model, arrays["active"])
    except (
        OSError,
        KeyError,
        ValueError,
        TypeError,
        AttributeError,
        EOFError,
        BadZipFile,
        zlib.error,
    ) as error:
        raise ValueError(f"{path} is not a grasp written by jaxgrasp.save_grasp ({error})") from error
