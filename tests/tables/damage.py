"""Damaged files: every way in which bytes of a good file go wrong, seeded."""

from __future__ import annotations

import io
import json
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
import pyarrow.parquet as pq


def flipped(rng: np.random.Generator, data: bytes) -> bytes:
    changed = bytearray(data)
    for at in rng.integers(len(data), size=rng.integers(1, 9)):
        changed[at] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def flipped_at_the_end(rng: np.random.Generator, data: bytes) -> bytes:
    """Where formats keep what they say about themselves."""
    cut = max(0, len(data) - int(rng.integers(16, 4096)))
    return data[:cut] + flipped(rng, data[cut:])


def truncated(rng: np.random.Generator, data: bytes) -> bytes:
    return data[: int(rng.integers(1, len(data)))]


def without_a_piece(rng: np.random.Generator, data: bytes) -> bytes:
    a, b = sorted(rng.integers(len(data), size=2))
    return data[:a] + data[b:] or b"P"


def overwritten(rng: np.random.Generator, data: bytes) -> bytes:
    """Zeros, ones, or bytes from elsewhere in the file."""
    size = int(rng.integers(1, max(2, len(data) // 4)))
    at, other = (int(x) for x in rng.integers(len(data), size=2))
    piece = [bytes(size), b"\xff" * size, data[other : other + size]][rng.integers(3)]
    return (data[:at] + piece + data[at + len(piece) :])[: len(data)]


def grown(rng: np.random.Generator, data: bytes) -> bytes:
    at = int(rng.integers(len(data)))
    return data[:at] + rng.bytes(int(rng.integers(1, 300))) + data[at:]


BYTES = (flipped, flipped_at_the_end, truncated, without_a_piece, overwritten, grown)
ODD = (
    None, True, -1, 0, 1e400, float("nan"), 10**400, "", "x" * 9999, "\ud800", [], [[]], {}, [1, 2], ["a"] * 3,
    [None] * 3, [1e308] * 3, [float("nan")] * 3, {"kind": 3}, {"kind": "hard\n"}, {"name": 5}, {"wrench": [1]}, "none",
)  # fmt: skip


def with_odd_metadata(rng: np.random.Generator, data: bytes) -> bytes:
    """A Parquet file that says strange things about itself."""
    table = pq.read_table(io.BytesIO(data))
    known = dict(table.schema.metadata or {})
    said = json.loads(known.get(b"jaxgrasp", b"{}"))
    for _ in range(rng.integers(1, 4)):
        name = str(rng.choice(sorted(said)))
        inner = said[name]
        if isinstance(inner, dict) and inner and rng.random() < 0.5:
            inner[str(rng.choice(sorted(inner)))] = ODD[rng.integers(len(ODD))]
        elif rng.random() < 0.2:
            del said[name]
            said.setdefault("seed", 0)
        else:
            said[name] = ODD[rng.integers(len(ODD))]
    text = json.dumps(said).encode()
    if rng.random() < 0.1:
        text = b'{"schema_version": 2, "object": ' + b"[" * 100_000
    sink = io.BytesIO()
    pq.write_table(table.replace_schema_metadata({**known, b"jaxgrasp": text}), sink)
    return sink.getvalue()


def with_odd_columns(rng: np.random.Generator, data: bytes) -> bytes:
    """Nulls, missing columns, other types and other lengths of lists."""
    table = pq.read_table(io.BytesIO(data))
    for _ in range(rng.integers(1, 4)):
        i = int(rng.integers(table.num_columns))
        name, column = table.column_names[i], table.column(i).to_pylist()
        change = rng.integers(5)
        if change == 0:
            table = table.drop_columns([name])
            continue
        if change == 1:
            column = [None] * len(column)
        elif change == 2:
            column = [str(x) for x in column]
        elif change == 3:
            column = [x[:-1] if isinstance(x, list) else None if x is None else 99 for x in column]
        else:
            column = [None if x is None else [x] for x in column]
        table = table.set_column(i, name, [column])
    sink = io.BytesIO()
    pq.write_table(table, sink)
    return sink.getvalue()


def npz(members: dict[str, bytes], compression: int = ZIP_STORED) -> bytes:
    sink = io.BytesIO()
    with ZipFile(sink, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return sink.getvalue()


HEADERS = (
    b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }",
    b"{'descr': '<f8', 'fortran_order': False, 'shape': (-3, 3), }",
    b"{'descr': '|O', 'fortran_order': False, 'shape': (3, 3), }",
    b"{'descr': '<f8', 'fortran_order': False, 'shape': " + b"(" * 300 + b")" * 300 + b", }",
    b"{'descr': '<f8', 'fortran_order': False, 'shape': (" + b"-" * 3500 + b"1,), }",
    b"{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (3, 3), }",
    b"{'descr': '<M8[s]', 'fortran_order': False, 'shape': (3, 3), }",
    b"not a header",
    b"",
)


def with_odd_arrays(rng: np.random.Generator, data: bytes) -> bytes:
    """An ``.npz`` with one strange member, compressed or not."""
    with ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = str(rng.choice(sorted(members)))
    change = rng.integers(5)
    if change == 0:
        del members[name]
    elif change == 1:
        text = HEADERS[rng.integers(len(HEADERS))]
        members[name] = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(72)
    elif change == 2:
        text = b"[" * int(rng.integers(10, 100_000))
        array = io.BytesIO()
        np.save(array, np.frombuffer(text, np.uint8))
        members["header.npy"] = array.getvalue()
    elif change == 3:
        array = io.BytesIO()
        np.save(array, np.zeros((int(rng.integers(0, 5)),) * int(rng.integers(0, 5))))
        members[name] = array.getvalue()
    else:
        members[name] = flipped(rng, members[name])
    return npz(members, [ZIP_STORED, ZIP_DEFLATED][rng.integers(2)])


def damaged(rng: np.random.Generator, path: Path) -> tuple[str, bytes]:
    """The name of a kind of damage, and the bytes of the file at ``path`` with it."""
    own = (
        (with_odd_arrays,) * 3
        if path.suffix == ".npz"
        else (with_odd_metadata,) * 2 + (with_odd_columns,) * 2
    )
    kinds = (*BYTES, *own)
    kind = kinds[rng.integers(len(kinds))]
    return kind.__name__, kind(rng, path.read_bytes())
