"""``jaxgrasp check`` as a user runs it."""

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest

from jaxgrasp import ControllabilityVerdict, Status
from jaxgrasp.cli import main

V = ControllabilityVerdict
pytestmark = pytest.mark.skipif(not jax.config.jax_enable_x64, reason="the command works in float64")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    return tmp_path


@pytest.mark.slow
def test_grasps_of_the_mug_are_checked(capsys, tmp_path):
    assert main(["check", "mug", "--mass", "0.3", "--fingers", "3", "--most", "60", "--row", "5"]) == 0
    printed = capsys.readouterr().out
    assert "written to mug.check.parquet" in printed and "Row 5: " in printed and "recovered" in printed
    table = pq.read_table(tmp_path / "mug.check.parquet")
    verdict, status = table["verdict"].to_numpy(), table["status"].to_numpy()
    assert table["row"].to_pylist() == list(range(60))
    assert ((verdict == V.RESISTANT.value) == (status == Status.RESISTANT.value)).all()
    steerable = np.isin(verdict, (V.RESISTANT.value, V.CONTROLLABLE.value))
    assert {V.RESISTANT.value, V.CONTROLLABLE.value, V.NO_EQUILIBRIUM.value} <= set(verdict.tolist())
    assert (np.asarray(table["rank"].to_pylist(), float)[steerable] == 12).all()
    back = np.array([bool(x) for x in table["recovered"].to_pylist()])
    assert [x is None for x in table["recovered"].to_pylist()] == (~steerable).tolist()
    assert back[steerable].mean() > 0.8
    time = np.array([np.nan if x is None else x for x in table["settling_time"].to_pylist()])
    assert (np.isfinite(time) == back).all() and (time[back] < 1.6).all() and (time[back] > 0.05).all()
    use = np.array([np.nan if x is None else x for x in table["cone_use"].to_pylist()])
    assert (use[steerable] <= 1 + 1e-9).all()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["mug", "--mass", "-1"], "--mass must be a number of kg > 0"),
        (["mug", "--mass", "0.3", "--gravity", "0,0,0"], "not all 0"),
        (["mug", "--mass", "0.3", "--gravity", "down"], "--gravity must be three numbers"),
        (["mug", "--mass", "0.3", "--most", "0"], "--most must be at least 1"),
        (["mug", "--mass", "0.3", "--row", "300"], "there is no row 300"),
        (["nothing.stl", "--mass", "0.3"], "no such file"),
        (["mug", "--mass", "0.3", "--torsion", "0.1"], "no torsion"),
    ],
)
def test_mistakes_are_told_in_one_line(words, complaint, capsys):
    assert main(["check", *words]) == 2
    said = capsys.readouterr().err.strip()
    assert complaint in said and len(said.splitlines()) == 1
