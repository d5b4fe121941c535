"""Each example prints what stands below it; all of them run in this process, so that they share compiled programs."""

import contextlib
import io
import re
import runpy
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")


def parts(path: Path) -> tuple[str, list[str]]:
    """The code, and the lines that it prints according to the comment block at its end."""
    code, shown = path.read_text(encoding="utf-8").split("\n# prints:\n")
    lines = shown.splitlines()
    assert all(line.startswith("#") for line in lines)
    return code, [line[2:].rstrip() for line in lines]


def test_there_are_a_dozen_and_they_are_numbered():
    numbers = [int(path.name[:2]) for path in EXAMPLES]
    assert numbers == list(range(1, len(EXAMPLES) + 1))
    assert len(EXAMPLES) >= 12


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_asks_a_question(path):
    code, shown = parts(path)
    assert 10 <= len(code.splitlines()) <= 40
    assert code.startswith('"""')
    assert "?" in code.split('"""')[1]
    assert shown


# Compiling a placement takes longest by far; tests/test_placement.py asserts on a ball what this one prints of a mug.
DEAR = ("08_place_on_a_mug",)


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, marks=[pytest.mark.slow] * (p.stem in DEAR)) for p in EXAMPLES],
    ids=lambda path: path.stem,
)
def test_an_example_prints_what_it_shows(path):
    """Equal words; numbers equal to 1 %."""
    _, shown = parts(path)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        runpy.run_path(str(path), run_name="__main__")
    lines = [line.rstrip() for line in printed.getvalue().splitlines()]
    assert [NUMBER.sub("#", line) for line in lines] == [NUMBER.sub("#", line) for line in shown]
    numbers, wanted = ([float(x) for x in NUMBER.findall("\n".join(text))] for text in (lines, shown))
    assert numbers == pytest.approx(wanted, rel=1e-2, abs=1e-6)
