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
CI = ROOT / ".ci" / "run"
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")


def block(name: str) -> str:
    """The text of the fenced block under the mark ``<!-- name -->``."""
    found = re.findall(rf"^<!-- {re.escape(name)} -->\n```\w*\n(.*?)^```$", README, re.S | re.M)
    assert len(found) == 1, f"README.md has {len(found)} blocks marked {name!r}"
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


def test_linked_files_exist():
    links = re.findall(r"\]\(([^)#]+)\)|src=\"([^\"]+)\"", README)
    local = [target for pair in links for target in pair if target and "://" not in target]
    assert len(local) >= 5
    missing = [target for target in local if not (ROOT / target).exists()]
    assert missing == []


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
def test_notebook_and_script_agree(script):
    """Regenerate with: jupytext --to ipynb notebooks/NAME.py"""
    assert cells_of_notebook(script.with_suffix(".ipynb")) == cells_of_script(script)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_notebook_is_committed_without_outputs(script):
    book = json.loads(script.with_suffix(".ipynb").read_text(encoding="utf-8"))
    code = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
    assert code
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
