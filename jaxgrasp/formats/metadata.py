"""What a file says about itself: JSON under the key ``jaxgrasp``, looked at before it is believed.

Schema versions (of all files of ours, that of forces in ``formats.force_table`` included; all of them are read):

    2               ``upper`` instead of ``gap``; in files of forces ``lower`` instead of ``bound``
    1               ``gap``, the width of the bracket: upper = margin + gap; ``bound`` of the cost, now ``lower``
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from ..core import UserError

__all__ = ["METADATA_KEY", "SCHEMA_VERSION", "dump_metadata", "stored_metadata"]

SCHEMA_VERSION, READABLE = 2, (1, 2)
METADATA_KEY = b"jaxgrasp"


def _number(value: Any) -> bool:
    try:
        return (
            not isinstance(value, bool) and isinstance(value, int | float) and bool(np.isfinite(float(value)))
        )
    except OverflowError:
        return False


def _vector(*sizes: int) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and len(value) in sizes and all(map(_number, value))


def _text(value: Any) -> bool:
    return isinstance(value, str)


def _maybe(kind: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or kind(value)


def _record(**parts: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: (
        isinstance(value, dict) and all(kind(value.get(name)) for name, kind in parts.items())
    )


# What readers rely on, where it is there; other metadata may be anything.
KINDS: dict[str, Callable[[Any], bool]] = {
    "centre_of_mass": _maybe(_vector(2, 3)),
    "model": _maybe(_record(kind=_maybe(_text))),
    "object": _maybe(_record(name=_maybe(_text), sha256=_maybe(_text))),
    "unit": _maybe(_text),
    "dtype": lambda value: value in ("float64", "float32"),
    "tolerance": _number,
    "max_normal": _maybe(_number),
    "criterion": _record(name=_text, weight=_maybe(_number), length=_maybe(_number), unit=_text),
    "load": _record(wrench=_vector(3, 6), mass=_maybe(_number), gravity=_maybe(_vector(2, 3))),
}


def dump_metadata(metadata: dict[str, Any]) -> bytes:
    """JSON with sorted keys: equal metadata are equal bytes."""
    return json.dumps({"schema_version": SCHEMA_VERSION, **metadata}, sort_keys=True).encode()


def stored_metadata(path: Path, file: pq.ParquetFile) -> dict[str, Any]:
    """The metadata under our key; empty where there are none, UserError where they are damaged or too new."""
    raw = (file.schema_arrow.metadata or {}).get(METADATA_KEY)
    if raw is None:
        return {}
    damaged = f"{path}: the metadata under the key 'jaxgrasp' is damaged"
    try:
        found = json.loads(raw)
        version = found["schema_version"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(damaged) from error
    if version not in READABLE:
        known = " and ".join(map(str, READABLE))
        told = str(version)[:20]
        raise UserError(f"{path} has schema version {told}, this jaxgrasp reads {known}; update jaxgrasp")
    for name in KINDS.keys() & found.keys():
        if not KINDS[name](found[name]):
            raise UserError(f"{damaged}: {name} is {json.dumps(found[name])[:80]}")
    return found
