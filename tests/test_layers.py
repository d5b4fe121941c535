"""The floors of the house: a module imports only what stands above it in one list."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "jaxgrasp"

# From the ground up. An entry may import the entries before it and nothing else of this project.
FLOORS = [
    # geometry and cones
    "_types",
    "geometry",
    "cones",
    "contacts",
    # the grasp
    "grasp",
    "criteria",
    "lmi_problem",
    "barrier",
    "semidefinite",
    "lmi",
    "lmi_forces",
    # the solver: has never heard of grasping
    "solver.stages",
    "solver.linear",
    "solver.program",
    "solver.interior_point",
    "solver.convex",
    "solver.blocks",
    "solver.kkt",
    "solver.steps",
    "solver.newton",
    "solver.primal_dual",
    "solver.newton_matrix",
    "solver.implicit",
    "solver.regularity",
    "solver",
    # answers and their proofs
    "status",
    "certificate.rebuilt",
    "certificate.resistance",
    "certificate.forces",
    "certificate.epsilon",
    "certificate",
    # the questions
    "lanes",
    "singular",
    "margin",
    "verdict",
    "tangents",
    "margin_sensitivity",
    "resistance",
    "balance",
    "duality",
    "optimum",
    "sensitivity",
    "forces",
    "equilibrium",
    # quality
    "effort",
    "polytope",
    "weakest",
    "facets",
    "epsilon",
    "critical_friction",
    "guaranteed_radius",
    "measures",
    "tracing",
    # motion
    "rotations",
    "dynamics",
    "linearization",
    "controllability",
    "simulation",
    "admissible",
    "control",
    "regulator",
    "closed_loop",
    "screws",
    "controllability_words",
    # the roof
    "errors",
    "backend",
    "objects",
    "meshes",
    "raycast",
    "surfaces.surface",
    "surfaces.rounded",
    "surfaces.gauge",
    "surfaces.triangles",
    "surfaces.nearest",
    "surfaces.grid",
    "surfaces.mesh",
    "surfaces",
    "requirements",
    "objectives",
    "climbing",
    "settling",
    "placement",
    "candidates",
    "formats",
    "formats.parquet",
    "formats.saved_grasp",
    "formats.force_table",
    "run",
    "summary",
    "shards",
    "screening",
    "drawing",
    "report",
    "loads",
    "loading",
    "force_report",
    "checking",
    "placing",
    "",  # jaxgrasp/__init__.py, the table of contents
    "terminal",
    "cli_forces",
    "cli_check",
    "cli_place",
    "cli",
    "__main__",
]
SOLVER_KNOWS = {"_types", "cones"}
HEAVY = ("mujoco", "trimesh", "pyarrow", "typer", "rich", "matplotlib")
# The version is a constant of the table of contents; these read it when a command runs.
READS_VERSION = {"cli", "run"}


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


PATHS = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def type_checking_nodes(tree: ast.AST) -> set[int]:
    """Imports that exist for the type checker only never run."""
    inside = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            inside |= {id(child) for statement in node.body for child in ast.walk(statement)}
    return inside


def imports(name: str) -> tuple[set[str], set[str]]:
    """Modules of this project and top-level foreign packages that ``name`` imports, wherever the statement stands."""
    path = PATHS[name]
    package = [part for part in name.split(".") if part]
    if path.name != "__init__.py":
        package = package[:-1]
    tree = ast.parse(path.read_text())
    skipped = type_checking_nodes(tree)
    own, foreign = set(), set()
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
            own |= {t.partition(".")[2] for t in targets if t.split(".")[0] == "jaxgrasp"}
            foreign |= {t.split(".")[0] for t in targets if t.split(".")[0] != "jaxgrasp"}
        elif isinstance(node, ast.ImportFrom):
            parts = node.module.split(".") if node.module else []
            if node.level:
                base = [*package[: len(package) - (node.level - 1)], *parts]
            elif parts[0] == "jaxgrasp":
                base = parts[1:]
            else:
                foreign.add(parts[0])
                continue
            for alias in node.names:
                candidate = ".".join([*base, alias.name])
                version = not base and alias.name == "__version__"
                if not (version and name in READS_VERSION):
                    own.add(candidate if candidate in PATHS else ".".join(base))
    return own, foreign


def test_every_module_has_its_floor():
    assert len(set(FLOORS)) == len(FLOORS)
    assert set(PATHS) == set(FLOORS)


@pytest.mark.parametrize("name", FLOORS, ids=lambda name: name or "__init__")
def test_imports_point_down(name):
    own, _ = imports(name)
    below = set(FLOORS[: FLOORS.index(name)])
    assert own <= below, f"{name} imports {sorted(own - below)}, which stand beside or above it"


def test_the_reader_of_imports_sees_them():
    """Relative, nested and delayed imports are all found."""
    assert imports("resistance")[0] >= {"_types", "solver", "solver.interior_point", "verdict"}
    assert imports("solver.linear")[0] == {"_types", "cones", "solver.stages"}
    assert "formats.parquet" in imports("screening")[0]
    assert "backend" in imports("cli")[0]
    assert imports("certificate.rebuilt") == (set(), {"__future__", "numpy", "typing"})


def test_the_solver_has_never_heard_of_grasping():
    for name in FLOORS:
        if name.split(".")[0] == "solver":
            outside = {m for m in imports(name)[0] if m.split(".")[0] != "solver"}
            assert outside <= SOLVER_KNOWS, name


def test_the_checker_knows_nothing_but_numpy():
    for name in FLOORS:
        if name.split(".")[0] == "certificate":
            own, others = imports(name)
            assert {m.split(".")[0] for m in own} <= {"certificate"}
            assert others <= {"__future__", "numpy", "typing"}


def test_only_the_simulation_imports_mujoco():
    assert [name for name in FLOORS if imports(name)[1] & {"mujoco", "mujoco_mjx"}] == ["simulation"]


def test_no_module_is_longer_than_a_few_screens():
    lengths = {name: len(path.read_text().splitlines()) for name, path in PATHS.items()}
    assert {name: n for name, n in lengths.items() if n > 400} == {}


def test_importing_the_library_loads_nothing_heavy():
    code = f"import sys, jaxgrasp; print([m for m in {HEAVY!r} if m in sys.modules])"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout.strip() == "[]"
