"""The rooms of the house: a room imports only rooms below it, and only through their ``__init__``.

Run as a script, it prints the figures of ``docs/architecture.md``: ``python tests/test_rooms.py``.
"""

import ast
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "jaxgrasp"

# From the ground up. A room may import the rooms before it.
ROOMS = (
    "core",
    "certificates",
    "backend",
    "conic",
    "contacts",
    "resistance",
    "forces",
    "quality",
    "motion",
    "lmi",
    "objects",
    "surfaces",
    "placement",
    "formats",
    "report",
    "jobs",
    "cli",
)
# What a room may load from outside besides NumPy, JAX, equinox, jaxtyping and the standard library.
MAY_LOAD = {
    "motion": {"mujoco"},
    "placement": {"optax", "scipy"},
    "objects": {"manifold3d", "scipy", "trimesh"},
    "surfaces": {"trimesh", "scipy"},
    "formats": {"pyarrow"},
    "report": {"matplotlib", "mpl_toolkits", "trimesh"},
    "jobs": {"pyarrow"},
    "cli": {"typer", "rich"},
}
EVERYWHERE = {"numpy", "jax", "equinox", "jaxtyping"}
ISLAND = {"numpy"}  # certificates: a bug elsewhere cannot make a wrong proof look right
HEAVY = ("mujoco", "trimesh", "pyarrow", "typer", "rich", "matplotlib", "optax")


def parts(path: Path) -> tuple[str, ...]:
    return path.relative_to(PACKAGE).with_suffix("").parts


FILES = {path: ast.parse(path.read_text()) for path in sorted(PACKAGE.rglob("*.py"))}


def type_checking_only(tree: ast.AST) -> set[int]:
    """Nodes under ``if TYPE_CHECKING``: they never run."""
    tests = (node for node in ast.walk(tree) if isinstance(node, ast.If))
    blocks = (node.body for node in tests if "TYPE_CHECKING" in ast.unparse(node.test))
    return {id(child) for body in blocks for statement in body for child in ast.walk(statement)}


@cache
def exported(name: str) -> frozenset[str]:
    """What the ``__init__`` of a room offers; a file inside may have the name of its function."""
    lists = [n for n in FILES[PACKAGE / name / "__init__.py"].body if ast.unparse(n).startswith("__all__")]
    return frozenset(ast.literal_eval(lists[0].value)) if lists else frozenset()


@cache
def imports(path: Path) -> tuple[frozenset[tuple[str, ...]], frozenset[str]]:
    """Modules of this project, as paths from its root, and foreign packages that a file imports, wherever it does."""
    package = parts(path)[:-1]
    tree, own, foreign = FILES[path], set(), set()
    skipped = type_checking_only(tree)
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            for name in (alias.name.split(".") for alias in node.names):
                own.add(tuple(name[1:])) if name[0] == "jaxgrasp" else foreign.add(name[0])
        elif isinstance(node, ast.ImportFrom):
            named = tuple((node.module or "").split(".")) if node.module else ()
            if not node.level and named[0] != "jaxgrasp":
                foreign.add(named[0])
                continue
            base = (*package[: len(package) - node.level + 1], *named) if node.level else named[1:]
            for alias in node.names:
                inside = (*base, alias.name)
                module = PACKAGE.joinpath(*inside)
                front_door = len(base) == 1 and base != package and alias.name in exported(base[0])
                is_module = module.is_dir() or module.with_suffix(".py").is_file()
                own.add(inside if is_module and not front_door else base)
    return frozenset(own), frozenset(foreign)


def room(path: Path) -> str:
    return parts(path)[0] if len(parts(path)) > 1 else ""


def arrows() -> set[tuple[str, str]]:
    """(room, a room that it imports)."""
    pairs = ((room(path), target[0]) for path in FILES for target in imports(path)[0] if target)
    return {(here, there) for here, there in pairs if here and here != there}


@cache
def floor(name: str) -> int:
    return 1 + max((floor(there) for here, there in arrows() if here == name), default=0)


def functions() -> list[tuple[str, ast.FunctionDef]]:
    nodes = ((path, node) for path, tree in FILES.items() for node in ast.walk(tree))
    return [
        ("/".join(parts(path)) + ":" + node.name, node)
        for path, node in nodes
        if isinstance(node, ast.FunctionDef)
    ]


def arguments(node: ast.FunctionDef) -> int:
    names = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
    return len([a for a in names if a.arg not in ("self", "cls")])


def test_every_folder_is_a_room():
    found = {path.name for path in PACKAGE.iterdir() if path.is_dir() and any(path.glob("*.py"))}
    assert found == set(ROOMS)
    assert {"/".join(parts(path)) for path in FILES if not room(path)} == {"__init__", "__main__"}


@pytest.mark.parametrize("name", ROOMS)
def test_a_room_imports_only_rooms_below_it_through_their_front_door(name):
    below = set(ROOMS[: ROOMS.index(name)])
    for path in FILES:
        if room(path) != name:
            continue
        for target in imports(path)[0]:
            where = f"{'/'.join(parts(path))} imports {'.'.join(target)}"
            assert target and target[0] in below | {name}, where
            assert target[0] == name or len(target) == 1, f"{where}, which is inside another room"


def test_no_import_circle_between_files():
    waiting = {parts(path): {t for t in imports(path)[0] if t != parts(path)} for path in FILES}
    waiting = {k[:-1] if k[-1] == "__init__" else k: v for k, v in waiting.items() if k != ("__init__",)}
    while waiting:
        free = {module for module, needs in waiting.items() if not (needs & waiting.keys()) - {module}}
        assert free, f"a circle among {sorted('.'.join(m) for m in waiting)}"
        waiting = {module: needs for module, needs in waiting.items() if module not in free}


@pytest.mark.parametrize("name", ROOMS)
def test_a_room_loads_only_the_libraries_it_may(name):
    allowed = ISLAND if name == "certificates" else EVERYWHERE | MAY_LOAD.get(name, set())
    standard = set(sys.stdlib_module_names)
    for path in FILES:
        if room(path) == name:
            assert imports(path)[1] - standard <= allowed, "/".join(parts(path))


def test_the_checker_is_an_island():
    assert {target for here, target in arrows() if here == "certificates"} == set()


def test_the_reader_of_imports_sees_them():
    """Relative, nested and delayed imports are all found."""
    assert ("conic",) in imports(PACKAGE / "resistance" / "solve.py")[0]
    assert ("resistance", "verdict") in imports(PACKAGE / "resistance" / "solve.py")[0]
    assert ("backend",) in imports(PACKAGE / "cli" / "main.py")[0]
    assert "mujoco" in imports(PACKAGE / "motion" / "mujoco.py")[1]


def test_no_module_is_longer_than_a_few_screens():
    lengths = {"/".join(parts(path)): len(path.read_text().splitlines()) for path in FILES}
    assert {name: n for name, n in lengths.items() if n > 400} == {}


def test_importing_the_library_loads_nothing_heavy():
    code = f"import sys, jaxgrasp; print([m for m in {HEAVY!r} if m in sys.modules])"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout.strip() == "[]"


def figures() -> dict[str, str]:
    """The figures of ``docs/architecture.md``."""
    longest = max(functions(), key=lambda f: f[1].end_lineno - f[1].lineno)
    widest = max(functions(), key=lambda f: arguments(f[1]))
    lengths = {"/".join(parts(path)): len(path.read_text().splitlines()) for path in FILES}
    largest = max(lengths, key=lengths.__getitem__)
    names = next(n for n in FILES[PACKAGE / "__init__.py"].body if isinstance(n, ast.Assign))
    return {
        "rooms": str(len(ROOMS)),
        "floors": str(max(floor(name) for name in ROOMS)),
        "arrows": str(len(arrows())),
        "largest module": f"{lengths[largest]} lines, {largest}",
        "longest function": f"{longest[1].end_lineno - longest[1].lineno + 1} lines, {longest[0]}",
        "longest argument list": f"{arguments(widest[1])}, {widest[0]}",
        "public names": str(len(ast.literal_eval(names.value))),
    }


if __name__ == "__main__":
    for name, value in figures().items():
        print(f"| {name} | {value} |")
