"""What the documents show is what happens: commands, example, printed words, notebook pairs."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = {
    path.relative_to(ROOT): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md")))
}
CI = ROOT / ".ci" / "run"
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")


def block(name: str) -> str:
    """The text of the fenced block under the mark ``<!-- name -->`` in the README or in a page of docs/."""
    mark = re.compile(rf"^<!-- {re.escape(name)} -->\n```\w*\n(.*?)^```$", re.S | re.M)
    found = [text for page in PAGES.values() for text in mark.findall(page)]
    assert len(found) == 1, f"{len(found)} blocks are marked {name!r}"
    return found[0]


def run(*arguments: str, cwd: Path) -> str:
    """Standard output of a Python process as a reader would start it, warnings as errors."""
    strange = ("JAX_", "JAXGRASP_", "PYTEST_")
    shared = ("JAX_COMPILATION_CACHE_", "JAX_PERSISTENT_CACHE_")  # the tests' store of compiled programs
    environment = {k: v for k, v in os.environ.items() if k.startswith(shared) or not k.startswith(strange)}
    environment |= {
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
        # Another process may be writing the program that this one reads; it then compiles its own.
        "PYTHONWARNINGS": "error,ignore:Error reading persistent compilation cache entry",
        "COLUMNS": "120",
    }
    environment |= {"PYTHONIOENCODING": "utf-8", "XDG_CACHE_HOME": str(cwd / "cache")}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, encoding="utf-8"
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def same_words(shown: str, printed: str) -> None:
    """Equal words; numbers equal to 1 %, because the last digits of a twist differ between JAX versions."""
    lines = [line.rstrip() for line in shown.strip().splitlines()]
    others = [line.rstrip() for line in printed.strip().splitlines()]
    assert [NUMBER.sub("#", line) for line in lines] == [NUMBER.sub("#", line) for line in others]
    numbers, wanted = ([float(x) for x in NUMBER.findall("\n".join(text))] for text in (others, lines))
    assert numbers == pytest.approx(wanted, rel=1e-2, abs=1e-6)


def test_the_number_pattern_sees_numbers_and_not_names():
    assert NUMBER.findall("row 185, -0.8593, 1e-8, (0.5, float64, t1)") == ["185", "-0.8593", "1e-8", "0.5"]


# Commands --------------------------------------------------------------------------------------------


def test_both_commands_are_one_line_that_installs_and_works():
    for name, work in (("main command", "jaxgrasp screen mug"), ("test command", "python -m pytest")):
        (line,) = block(name).splitlines()
        install, action = line.split(" && ")
        assert install.startswith("pip install ")
        assert action.startswith(work)


@pytest.mark.parametrize("name", ["main command", "test command"])
def test_ci_runs_the_readmes_command(name):
    """The script's own extraction, run on this README, yields the line shown to the reader."""
    script = CI.read_text(encoding="utf-8")
    function = re.search(r"^readme_command\(\) \{\n.*?^\}$", script, re.S | re.M)
    assert function is not None
    assert f'$(readme_command "{name}")' in script
    extracted = subprocess.run(
        ["bash", "-euc", f"{function[0]}\nreadme_command '{name}'"], cwd=ROOT, capture_output=True, text=True
    )
    assert extracted.stdout == block(name)


def test_ci_uses_the_extracted_commands_unchanged():
    script = CI.read_text(encoding="utf-8")
    assert script.count('"$test_command"\n') == 1  # on Python 3.11
    # On the newest other Python: its install, then the files that meet that Python's interfaces.
    assert '"${test_command%%&&*}"' in script
    assert '"${main_command%%&&*}"' in script
    assert "${main_command#*&& }" in script
    assert os.access(CI, os.X_OK)
    assert "\nset -euo pipefail\n" in script


# What is printed ---------------------------------------------------------------------------------------


def test_the_python_example_prints_what_is_shown(tmp_path):
    printed = run("-c", block("example"), cwd=tmp_path)
    assert "Not wrench resistant" in printed
    same_words(block("example output"), printed)


def test_the_forces_example_prints_what_is_shown(tmp_path):
    printed = run("-c", block("forces example"), cwd=tmp_path)
    assert "d cost / d mu = -6.0000 N" in printed  # W / (2 mu), differentiated
    same_words(block("forces example output"), printed)


@pytest.mark.slow("test_the_forces_example_prints_what_is_shown")
def test_the_motion_example_prints_what_is_shown(tmp_path):
    same_words(block("motion example output"), run("-c", block("motion example"), cwd=tmp_path))


def test_explain_prints_what_is_shown(tmp_path):
    """A row depends on the seed and its number alone, so 300 samples hold the README's rows."""
    action = block("main command").split(" && ")[1].split()
    action[action.index("--samples") + 1] = "300"
    assert action[0] == "jaxgrasp"
    run("-m", *action, cwd=tmp_path)
    file = action[action.index("-o") + 1]
    same_words(block("explain 185"), run("-m", "jaxgrasp", "explain", file, "185", cwd=tmp_path))
    held = run("-m", "jaxgrasp", "explain", file, "282", "--picture", "mug_holds.png", cwd=tmp_path)
    assert "Wrench resistant (force closure)" in held
    assert (tmp_path / "mug_holds.png").stat().st_size > 10_000


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_linked_files_exist(page):
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)|src=\"([^\"]+)\"", PAGES[page])
    local = [target for pair in links for target in pair if target and "://" not in target]
    assert len(local) >= 5 or page.name != "README.md"
    missing = [target for target in local if not (ROOT / page.parent / target).exists()]
    assert missing == []


def test_every_page_of_docs_can_be_reached():
    """From the README or from the index of decisions."""
    index = README + PAGES[Path("docs/decisions/README.md")]
    pages = [path for path in PAGES if path.parts[0] == "docs"]
    assert [str(path) for path in pages if f"({path.name})" not in index and f"({path})" not in index] == []


# How long, and what is named -----------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "most"), [("README.md", 200), ("docs/architecture.md", 150)])
def test_the_first_pages_stay_short(name, most):
    assert len(PAGES[Path(name)].splitlines()) <= most


def test_every_file_named_in_the_architecture_exists():
    named = set(re.findall(r"`((?:jaxgrasp|tests|benchmarks)/[\w/.]+)`", PAGES[Path("docs/architecture.md")]))
    assert len(named) >= 20
    assert sorted(name for name in named if not (ROOT / name).exists()) == []


def test_the_architecture_lists_the_rooms_in_their_order_and_shows_their_figures():
    """What ``python tests/test_rooms.py`` prints stands in the last column between the marks."""
    page = PAGES[Path("docs/architecture.md")]
    printed = subprocess.run(
        [sys.executable, ROOT / "tests" / "test_rooms.py"], capture_output=True, encoding="utf-8", check=True
    )
    shown = page.split("<!-- figures -->")[1].split("<!-- /figures -->")[0]
    rows = [[cell.strip() for cell in row.strip("| ").split("|")] for row in shown.strip().splitlines()[2:]]
    assert printed.stdout.splitlines() == [f"| {row[0]} | {row[-1]} |" for row in rows]
    rooms = re.findall(r"^\| `(\w+)` \| .* \| .*\|$", page, re.M)
    order = re.search(r"^ROOMS = \((.*?)^\)", (ROOT / "tests" / "test_rooms.py").read_text(), re.S | re.M)
    assert order is not None
    assert rooms == re.findall(r'"(\w+)"', order[1])


def test_the_changelog_knows_every_name_that_moved():
    """The message of an AttributeError and the table say the same."""
    source = (ROOT / "jaxgrasp" / "core" / "renamed.py").read_text(encoding="utf-8")
    moved = re.findall(r'^    "(\w+)": "([\w.]+)",$', source.split("# Modules.")[0], re.M)
    assert len(moved) > 50
    page = PAGES[Path("CHANGELOG.md")]
    assert [old for old, new in moved if f"| `{old}` | `{new}` |" not in page] == []


# Notebooks ---------------------------------------------------------------------------------------------

Cell = tuple[str, str]


def cells_of_script(path: Path) -> list[Cell]:
    """(kind, source) of each cell of a percent script; markdown without its comment marks."""
    head, *parts = re.split(r"^# %%", path.read_text(encoding="utf-8"), flags=re.M)
    assert head.startswith("# ---\n")
    cells = []
    for part in parts:
        first, _, rest = part.partition("\n")
        rest = rest.strip("\n")
        if first.strip() == "[markdown]":
            cells.append(("markdown", "\n".join(line[1:].removeprefix(" ") for line in rest.split("\n"))))
        else:
            assert first.strip() == ""
            cells.append(("code", rest))
    return cells


def cells_of_notebook(path: Path) -> list[Cell]:
    book = json.loads(path.read_text(encoding="utf-8"))
    return [(cell["cell_type"], "".join(cell["source"])) for cell in book["cells"]]


SCRIPTS = sorted((ROOT / "notebooks").glob("*.py"))


def test_every_notebook_has_a_script_and_the_other_way_round():
    books = sorted((ROOT / "notebooks").glob("*.ipynb"))
    assert [b.stem for b in books] == [s.stem for s in SCRIPTS] != []


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_notebook_stays_short(script):
    """At most 200 lines of source; what draws is in ``jaxgrasp.report.plots``."""
    assert len(script.read_text(encoding="utf-8").splitlines()) <= 200


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_notebook_and_script_agree(script):
    """Regenerate with: jupytext --to ipynb notebooks/NAME.py"""
    assert cells_of_notebook(script.with_suffix(".ipynb")) == cells_of_script(script)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_notebook_is_committed_without_outputs(script):
    book = json.loads(script.with_suffix(".ipynb").read_text(encoding="utf-8"))
    code = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
    assert code
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
