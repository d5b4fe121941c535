import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from jaxgrasp.core.errors import UserError
from jaxgrasp.formats import parquet
from jaxgrasp.formats.parquet import ContactFile, Contacts, Verdicts

METADATA = {
    "object": {"name": "box", "sha256": "0"},
    "centre_of_mass": [0.0, 0.0, 0.1],
    "model": {"kind": "hard"},
}


def rows(n=4, k=2, components=3, dtype="float64"):
    random = np.random.default_rng(0)

    def real(*shape):
        return random.normal(size=shape).astype(dtype)

    contacts = Contacts(
        np.arange(n) * 3,
        real(n, k, 3),
        real(n, k, 3),
        abs(real(n, k)),
        np.zeros((n, k), dtype),
        np.ones((n, k), bool),
    )
    verdicts = Verdicts(
        np.arange(1, n + 1, dtype=np.int32),
        real(n),
        abs(real(n)),
        np.full(n, 6, dtype),
        real(n, k * components),
        real(n, 6),
        np.arange(n, dtype=np.int32),
    )
    return contacts, verdicts


def test_the_schema_is_the_documented_one():
    kind = parquet.schema(2, "float64", METADATA)
    expected = {
        "grasp_id": "int64",
        "position": "fixed_size_list<item: fixed_size_list<item: double>[3]>[2]",
        "normal": "fixed_size_list<item: fixed_size_list<item: double>[3]>[2]",
        "friction": "fixed_size_list<item: double>[2]",
        "torsion": "fixed_size_list<item: double>[2]",
        "active": "fixed_size_list<item: bool>[2]",
        "status": "int8",
        "margin": "double",
        "gap": "double",
        "rank": "int8",
        "internal_force": "list<item: double>",
        "escape_twist": "list<item: double>",
        "iterations": "int32",
    }
    assert {field.name: str(field.type) for field in kind} == expected
    assert json.loads(kind.metadata[b"jaxgrasp"]) == {"schema_version": 1, **METADATA}
    assert str(parquet.schema(2, "float32").field("margin").type) == "float"


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_there_and_back(tmp_path, dtype):
    contacts, verdicts = rows(dtype=dtype)
    verdicts.margin[1], verdicts.internal_force[1] = -np.inf, 0
    verdicts.margin[3], verdicts.gap[3], verdicts.rank[3] = np.nan, np.nan, np.nan
    verdicts.internal_force[3], verdicts.escape_twist[3] = np.nan, np.nan
    verdicts.escape_twist[0] = 0
    kind = parquet.schema(2, dtype, METADATA)
    path = tmp_path / "a.parquet"
    parquet.write(path, [parquet.table(contacts, verdicts, kind)], kind)

    file = ContactFile(path)
    assert (file.rows, file.fingers, file.metadata["centre_of_mass"]) == (4, 2, [0, 0, 0.1])
    (found,) = file.chunks(100)
    for name in Contacts.__dataclass_fields__:
        assert np.array_equal(getattr(found, name), getattr(contacts, name)), name
    assert found.position.dtype == dtype

    back = pq.read_table(path)
    assert back["internal_force"].is_null().to_pylist() == [False, True, False, True]
    assert back["escape_twist"].is_null().to_pylist() == [True, False, False, True]
    assert back["rank"].to_pylist() == [6, 6, 6, None]
    row, metadata = parquet.read_row(path, 2)
    assert metadata["object"]["name"] == "box" and row["status"] == 3 and row["grasp_id"] == 6
    assert np.array_equal(row["internal_force"], verdicts.internal_force[2].astype(float))
    assert parquet.read_row(path, 1)[0]["internal_force"] is None


def test_the_same_rows_are_the_same_bytes(tmp_path):
    kind = parquet.schema(2, "float64", METADATA)
    for name in "ab":
        parquet.write(tmp_path / name, [parquet.table(*rows(), kind)], kind)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_failed_write_leaves_nothing(tmp_path):
    kind = parquet.schema(2, "float64", METADATA)

    def parts():
        yield parquet.table(*rows(), kind)
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError):
        parquet.write(tmp_path / "a.parquet", parts(), kind)
    assert list(tmp_path.iterdir()) == []


def test_rows_of_later_row_groups(tmp_path):
    kind = parquet.schema(2, "float64", METADATA)
    part = parquet.table(*rows(), kind)
    parquet.write(tmp_path / "a", [part, part], kind)
    assert pq.ParquetFile(tmp_path / "a").num_row_groups == 2
    assert parquet.read_row(tmp_path / "a", 5)[0]["grasp_id"] == 3
    for row in (-1, 8):
        with pytest.raises(UserError, match="rows 0 to 7"):
            parquet.read_row(tmp_path / "a", row)


@pytest.mark.parametrize("layout", ["nested lists", "flat", "flat fixed", "large"])
def test_contacts_as_others_write_them(tmp_path, layout):
    points = np.arange(12.0).reshape(2, 2, 3)
    flat = points.reshape(2, 6).tolist()
    kinds = {
        "nested lists": (points.tolist(), pa.list_(pa.list_(pa.float64()))),
        "flat": (flat, pa.list_(pa.float32())),
        "flat fixed": (flat, pa.list_(pa.float64(), 6)),
        "large": (points.tolist(), pa.large_list(pa.list_(pa.float64(), 3))),
    }
    column = pa.array(*kinds[layout])
    path = tmp_path / "contacts.parquet"
    pq.write_table(pa.table({"position": column, "normal": column, "friction": pa.array([0.5, 0.25])}), path)
    file = ContactFile(path)
    assert (file.fingers, file.rows, file.metadata) == (2, 2, {})
    (found,) = file.chunks(10)
    assert np.array_equal(found.position, points)
    assert np.array_equal(found.friction, [[0.5, 0.5], [0.25, 0.25]])
    assert found.grasp_id.tolist() == [0, 1] and found.active is None and found.torsion is None


def test_missing_numbers_become_nan_and_harm_no_other_row(tmp_path):
    position = [[[0.0, 0, 1], [None, 2, 3]], None, [[1.0, 1, 1], [2, 2, 2]]]
    normal = [[[0.0, 0, 1], [1, 2, 3]]] * 3
    kind = pa.list_(pa.list_(pa.float64()))
    path = tmp_path / "contacts.parquet"
    pq.write_table(pa.table({"position": pa.array(position, kind), "normal": pa.array(normal, kind)}), path)
    (found,) = ContactFile(path).chunks(10)
    assert np.isnan(found.position[0, 1, 0]) and np.isnan(found.position[1]).all()
    assert np.array_equal(found.position[2], position[2])
    assert np.array_equal(found.position[0, 0], [0, 0, 1])


def test_chunks_follow_each_other(tmp_path):
    column = pa.array(np.arange(60.0).reshape(10, 6).tolist())
    path = tmp_path / "contacts.parquet"
    pq.write_table(pa.table({"position": column, "normal": column}), path, row_group_size=3)
    found = list(ContactFile(path).chunks(4))
    assert [len(part) for part in found] == [4, 4, 2]
    assert np.concatenate([part.grasp_id for part in found]).tolist() == list(range(10))
    assert np.array_equal(np.concatenate([part.position for part in found]).ravel(), np.arange(60.0))


good = [[0.0, 0, 0, 1, 1, 1]]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"position": good}, "lacks the column normal; it has: position"),
        ({"a": [1]}, "lacks the columns position, normal"),
        ({"position": [[0.0, 1]], "normal": good}, "k x 3 numbers"),
        ({"position": good, "normal": [[1.0, 0, 0]]}, "normal has 1 contacts a row, position 2"),
        ({"position": [[0.0] * 3, [0.0] * 6], "normal": [[0.0] * 3] * 2}, "different lengths"),
        ({"position": [["a"] * 6], "normal": good}, "must hold numbers"),
        ({"position": good, "normal": good, "active": [[1.0, 1.0]]}, "must be boolean"),
        ({"position": good, "normal": good, "friction": [[1.0, 1.0, 1.0]]}, "friction has 3 contacts"),
        ({"position": good, "normal": good, "grasp_id": [1.5]}, "whole numbers"),
        (
            {
                "position": pa.array([], pa.list_(pa.float64(), 6)),
                "normal": pa.array([], pa.list_(pa.float64(), 6)),
            },
            "no rows",
        ),
    ],
)
def test_files_without_what_is_needed_get_one_clear_line(tmp_path, columns, message):
    path = tmp_path / "contacts.parquet"
    pq.write_table(pa.table(columns), path)
    with pytest.raises(UserError, match=message) as error:
        list(ContactFile(path).chunks(10))
    assert "\n" not in str(error.value)


def test_damaged_and_foreign_files(tmp_path):
    path = tmp_path / "a.parquet"
    with pytest.raises(UserError, match="no such file"):
        ContactFile(path)
    path.write_bytes(b"PAR1 nothing")
    with pytest.raises(UserError, match="cannot be read as Parquet"):
        ContactFile(path)
    kind = parquet.schema(2, "float64", METADATA)
    newer = kind.with_metadata({b"jaxgrasp": json.dumps({"schema_version": 2}).encode()})
    parquet.write(path, [parquet.table(*rows(), kind).replace_schema_metadata(newer.metadata)], newer)
    with pytest.raises(UserError, match="schema version 2, this jaxgrasp reads 1"):
        ContactFile(path)
    broken = kind.with_metadata({b"jaxgrasp": b"{"})
    parquet.write(path, [parquet.table(*rows(), kind).replace_schema_metadata(broken.metadata)], broken)
    with pytest.raises(UserError, match="damaged"):
        parquet.read_metadata(path)
    pq.write_table(pa.table({"position": good, "normal": good}), path)
    with pytest.raises(UserError, match="lacks the columns friction"):
        parquet.read_row(path, 0)


def test_the_result_of_the_solver_has_the_columns():
    from jaxgrasp.resistance.solve import WrenchResistance

    assert set(Verdicts.__dataclass_fields__) <= set(WrenchResistance.__dataclass_fields__)
