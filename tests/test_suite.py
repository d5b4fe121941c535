"""The tests themselves: each stands alone, seeds itself, and if slow has a fast brother."""

import ast
from pathlib import Path

import pytest
from interfaces import INTERFACES

HERE = Path(__file__).parent
FILES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(HERE.rglob("*.py"))}
TESTS = {path: tree for path, tree in FILES.items() if path.name.startswith("test_")}
GENERATORS = ("np.random.default_rng", "numpy.random.default_rng", "random.Random")


def names(path):
    return "/".join(path.relative_to(HERE).parts)


@pytest.mark.parametrize("path", FILES, ids=names)
def test_no_file_imports_from_a_test_file(path):
    for node in ast.walk(FILES[path]):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [node.module or ""]
        else:
            continue
        assert not [m for m in modules if m.startswith("test_")], f"line {node.lineno}"


def test_test_files_lie_in_one_folder_what_others_publish_in_another_and_shared_data_in_tables():
    assert {path.parent for path in TESTS} == {HERE, HERE / "conformance"}
    assert {path.parent for path in FILES} == {HERE, HERE / "conformance", HERE / "tables"}


def module_level(tree):
    """Nodes that run when the file is imported: all but the bodies of functions."""
    waiting = list(tree.body)
    while waiting:
        node = waiting.pop()
        yield node
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            waiting += [*node.args.defaults, *[d for d in node.args.kw_defaults if d is not None]]
            waiting += getattr(node, "decorator_list", [])
        else:
            waiting += ast.iter_child_nodes(node)


@pytest.mark.parametrize("path", FILES, ids=names)
def test_no_generator_of_random_numbers_outlives_a_test(path):
    """Neither a generator that tests of a file share, nor NumPy's global one: the order of tests would change data."""
    for node in ast.walk(FILES[path]):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("np.random", "numpy.random"):
            known = ("default_rng", "Generator", "SeedSequence", "PCG64")
            assert node.attr in known, f"line {node.lineno}: {ast.unparse(node)} has a global state"
    for node in module_level(FILES[path]):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        made = node.value
        kept = isinstance(made, ast.Call) and ast.unparse(made.func) in GENERATORS
        assert not kept, f"line {node.lineno}: {ast.unparse(node)}"


def functions(collected):
    """(file, function) of every test: whether some of its cases are fast, and the brothers that slow marks name."""
    fast, brothers = set(), {}
    for item in collected:
        key = item.path.name, item.originalname
        marks = list(item.iter_markers("slow"))
        if not marks:
            fast.add(key)
        for mark in marks:
            brothers.setdefault(key, set()).update(mark.args)
    return fast, brothers


def test_every_slow_test_has_a_fast_brother(collected):
    """Cases of its own that are fast, or the tests that its mark names: the same asserted on less, or in the plane."""
    fast, brothers = functions(collected)
    found = {item.path.name for item in collected}  # a run of a few files does not know the others
    alone = []
    for (file, function), named in brothers.items():
        if (file, function) in fast and not named:
            continue
        where = {tuple(name.split("::")) if "::" in name else (file, name) for name in named}
        if not named or not {brother for brother in where if brother[0] in found} <= fast:
            alone.append(f"{file}::{function}")
    assert alone == []


def test_interfaces_are_files():
    assert {f"{name}.py" for name in INTERFACES} <= {path.name for path in TESTS}
