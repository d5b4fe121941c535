import json
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from jaxgrasp.core.errors import UserError
from jaxgrasp.core.status import Status
from jaxgrasp.formats import Contacts, Forces, Verdicts, force_schema, parquet, read_force_row
from jaxgrasp.formats.contact_file import ContactFile, GraspFile
from jaxgrasp.formats.force_table import force_table
from jaxgrasp.resistance.solve import WrenchResistance

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
        real(n, 6),
        np.arange(n, dtype=np.int32),
    )
    return contacts, verdicts


def test_the_schema_is_the_documented_one():
    kind = parquet.verdict_schema(2, "float64", METADATA)
    expected = {
        "grasp_id": "int64",
        "position": "fixed_size_list<item: fixed_size_list<item: double>[3]>[2]",
        "normal": "fixed_size_list<item: fixed_size_list<item: double>[3]>[2]",
        "friction": "fixed_size_list<item: double>[2]",
        "torsion": "fixed_size_list<item: double>[2]",
        "active": "fixed_size_list<item: bool>[2]",
        "status": "int8",
        "margin": "double",
        "upper": "double",
        "rank": "int8",
        "internal_force": "list<item: double>",
        "escape_twist": "list<item: double>",
        "bound_twist": "list<item: double>",
        "iterations": "int32",
    }
    assert {field.name: str(field.type) for field in kind} == expected
    assert json.loads(kind.metadata[b"jaxgrasp"]) == {"schema_version": 2, **METADATA}
    assert str(parquet.verdict_schema(2, "float32").field("margin").type) == "float"


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_there_and_back(tmp_path, dtype):
    contacts, verdicts = rows(dtype=dtype)
    verdicts.margin[1], verdicts.internal_force[1] = -np.inf, 0
    verdicts.margin[3], verdicts.upper[3], verdicts.rank[3] = np.nan, np.nan, np.nan
    verdicts.internal_force[3], verdicts.escape_twist[3] = np.nan, np.nan
    verdicts.escape_twist[0] = 0
    kind = parquet.verdict_schema(2, dtype, METADATA)
    path = tmp_path / "a.parquet"
    parquet.write(path, [parquet.verdict_table(contacts, verdicts, kind)], kind)

    file = ContactFile(path)
    assert (file.rows, file.fingers, file.metadata["centre_of_mass"]) == (4, 2, [0, 0, 0.1])
    (found,) = file.chunks(100)
    for name in Contacts.__dataclass_fields__:
        assert np.array_equal(getattr(found, name), getattr(contacts, name)), name
    assert found.position.dtype == dtype

    back = pq.read_table(path)
    assert back["internal_force"].is_null().to_pylist() == [False, True, False, True]
    assert back["escape_twist"].is_null().to_pylist() == [True, False, False, True]
    assert back["bound_twist"].is_null().to_pylist() == [False, False, False, True]
    assert back["rank"].to_pylist() == [6, 6, 6, None]
    row, metadata = parquet.read_row(path, 2)
    assert metadata["object"]["name"] == "box" and row["status"] == 3 and row["grasp_id"] == 6
    assert np.array_equal(row["internal_force"], verdicts.internal_force[2].astype(float))
    assert parquet.read_row(path, 1)[0]["internal_force"] is None


def test_the_same_rows_are_the_same_bytes(tmp_path):
    kind = parquet.verdict_schema(2, "float64", METADATA)
    for name in "ab":
        parquet.write(tmp_path / name, [parquet.verdict_table(*rows(), kind)], kind)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_failed_write_leaves_nothing(tmp_path):
    kind = parquet.verdict_schema(2, "float64", METADATA)

    def parts():
        yield parquet.verdict_table(*rows(), kind)
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError):
        parquet.write(tmp_path / "a.parquet", parts(), kind)
    assert list(tmp_path.iterdir()) == []


def test_rows_of_later_row_groups(tmp_path):
    kind = parquet.verdict_schema(2, "float64", METADATA)
    part = parquet.verdict_table(*rows(), kind)
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
    kind = parquet.verdict_schema(2, "float64", METADATA)
    newer = kind.with_metadata({b"jaxgrasp": json.dumps({"schema_version": 3}).encode()})
    parquet.write(path, [parquet.verdict_table(*rows(), kind).replace_schema_metadata(newer.metadata)], newer)
    with pytest.raises(UserError, match="schema version 3, this jaxgrasp reads 1 and 2"):
        ContactFile(path)
    broken = kind.with_metadata({b"jaxgrasp": b"{"})
    parquet.write(
        path, [parquet.verdict_table(*rows(), kind).replace_schema_metadata(broken.metadata)], broken
    )
    with pytest.raises(UserError, match="damaged"):
        parquet.read_metadata(path)
    listed = kind.with_metadata({b"jaxgrasp": json.dumps({"schema_version": 2, "model": ["hard"]}).encode()})
    parquet.write(
        path, [parquet.verdict_table(*rows(), kind).replace_schema_metadata(listed.metadata)], listed
    )
    with pytest.raises(UserError, match="damaged"):
        _ = ContactFile(path).kind
    pq.write_table(pa.table({"position": good, "normal": good}), path)
    with pytest.raises(UserError, match="lacks the columns friction"):
        parquet.read_row(path, 0)


# Files of schema version 1 -----------------------------------------------------------------------------


def as_version_1(path, table, name, column):
    """Write ``table`` as version 1 did: ``column`` instead of its column ``name``, called otherwise."""
    metadata = {**json.loads(table.schema.metadata[b"jaxgrasp"]), "schema_version": 1}
    former = {"upper": "gap", "lower": "bound"}[name]
    columns = [column if x == name else table[x] for x in table.column_names]
    names = [former if x == name else x for x in table.column_names]
    old = pa.table(dict(zip(names, columns, strict=True)))
    pq.write_table(old.replace_schema_metadata({b"jaxgrasp": json.dumps(metadata).encode()}), path)
    return path


@pytest.fixture(params=["float64", "float32"])
def verdict_files(tmp_path, request):
    """The same four verdicts in a file of version 1 and in one of version 2."""
    contacts, verdicts = rows(dtype=request.param)
    gap = np.array([0.5, 0.0, 0.25, np.nan], request.param)
    verdicts.margin[:] = np.array([0.125, -np.inf, -1.5, np.nan], request.param)
    verdicts.upper[:] = verdicts.margin + gap
    kind = parquet.verdict_schema(2, request.param, METADATA)
    table = parquet.verdict_table(contacts, verdicts, kind)
    parquet.write(tmp_path / "new.parquet", [table], kind)
    return as_version_1(tmp_path / "old.parquet", table, "upper", pa.array(gap)), tmp_path / "new.parquet"


def same(a, b):
    return np.array_equal(a, b, equal_nan=isinstance(a, float) or np.asarray(a).dtype.kind == "f")


def test_a_file_of_version_1_reads_the_same(verdict_files):
    old, new = verdict_files
    assert "gap" in pq.read_schema(old).names and "upper" not in pq.read_schema(old).names
    for number in range(4):
        (before, told), (after, _) = parquet.read_row(old, number), parquet.read_row(new, number)
        assert told["schema_version"] == 1 and before.keys() == after.keys()
        assert all(same(before[name], after[name]) for name in after)
    assert parquet.read_row(old, 0)[0]["upper"] == 0.625
    (found,), (expected,) = (ContactFile(path).chunks(10) for path in verdict_files)
    for name in Contacts.__dataclass_fields__:
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name
    files = [GraspFile(path) for path in verdict_files]
    assert [file.count(Status.NOT_RESISTANT) for file in files] == [1, 1]
    assert np.array_equal(files[0].row(2).position, files[1].row(2).position)
    assert files[0].about == files[1].about and files[0].kind == "hard"


def test_a_version_1_file_without_its_columns_is_refused_in_its_own_words(verdict_files, tmp_path):
    table = pq.read_table(verdict_files[0])
    pq.write_table(table.drop_columns(["gap"]), tmp_path / "broken.parquet")
    with pytest.raises(UserError, match="lacks the column gap"):
        parquet.read_row(tmp_path / "broken.parquet", 0)


def test_a_file_of_forces_of_version_1_reads_the_same(tmp_path):
    contacts, _ = rows(3)
    status = np.array([Status.OPTIMAL, Status.INFEASIBLE, Status.INVALID], np.int8)
    cost, lower = np.array([2.0, np.inf, np.nan]), np.array([1.75, np.inf, np.nan])
    random = np.random.default_rng(1)
    forces, pulls, twists = (random.normal(size=shape) for shape in ((3, 6), (3, 2, 3), (3, 6)))
    found = Forces(status, cost, lower, forces, pulls, twists, twists, np.arange(3, dtype=np.int32))
    kind = force_schema(2, 3, {**METADATA, "load": {"wrench": [0.0] * 6}})
    table = force_table(np.arange(3), contacts, found, kind)
    parquet.write(tmp_path / "new.parquet", [table], kind)
    as_version_1(tmp_path / "old.parquet", table, "lower", table["lower"])
    assert "bound" in pq.read_schema(tmp_path / "old.parquet").names
    for number in range(3):
        before, after = (read_force_row(tmp_path / f"{name}.parquet", number)[0] for name in ("old", "new"))
        assert before.keys() == after.keys() and all(same(before[name], after[name]) for name in after)
    assert read_force_row(tmp_path / "old.parquet", 0)[0]["lower"] == 1.75
    damaged = pq.read_table(tmp_path / "old.parquet").drop_columns(["bound"])
    pq.write_table(damaged, tmp_path / "damaged.parquet")
    with pytest.raises(UserError, match="lacks the column bound"):
        read_force_row(tmp_path / "damaged.parquet", 0)


def test_the_columns_come_from_the_solvers_answer():
    answer = SimpleNamespace(
        status=np.array([1, 2, 5]),
        lower=np.array([0.5, -np.inf, np.nan]),
        upper=np.array([0.75, -np.inf, np.nan]),
        rank=np.array([6, 5, -1]),
        internal_force=np.ones((3, 6)),
        escape_twist=np.zeros((3, 6)),
        bound_twist=np.ones((3, 6)),
        iterations=np.array([4, 5, 0]),
    )
    found = Verdicts.of(answer, slice(None, 2))
    assert found.upper.tolist() == [0.75, -np.inf] and found.margin.tolist() == [0.5, -np.inf]
    assert found.status.tolist() == [1, 2] and found.iterations.tolist() == [4, 5]
    assert set(vars(answer)) <= set(WrenchResistance.__dataclass_fields__)


def test_rows_are_taken_and_padded():
    contacts, _ = rows(3)
    full = contacts.padded(5)
    assert len(full) == 5 and full.position.dtype == contacts.position.dtype
    assert np.array_equal(full.position[:3], contacts.position) and not full.active[3:].any()
    assert len(contacts.padded(2)) == 3
    assert contacts.taken([2, 0]).grasp_id.tolist() == [6, 0]
    assert (
        Contacts(*(getattr(contacts, n) for n in ("grasp_id", "position", "normal"))).taken([0]).active
        is None
    )
