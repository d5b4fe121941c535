"""Requests: their fields are the options of the commands, and a file's command asks for the same run again."""

import dataclasses
import importlib
import inspect
import shlex
from dataclasses import dataclass
from typing import Annotated, get_args, get_origin

import jax
import numpy as np
import pytest
import typer

import jaxgrasp as jg
from jaxgrasp import jobs
from jaxgrasp.backend import precision
from jaxgrasp.cli.main import main
from jaxgrasp.cli.options import Vector, options
from jaxgrasp.core import UserError
from jaxgrasp.jobs.provenance import command_line

COMMANDS = {
    name: importlib.import_module(f"jaxgrasp.cli.{name}") for name in ("screen", "forces", "check", "place")
}
REQUESTS = {
    "screen": jobs.ScreenRequest,
    "forces": jobs.ForcesRequest,
    "check": jobs.CheckRequest,
    "place": jobs.PlaceRequest,
}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_field_of_a_request_is_an_option_of_its_command(name):
    told = getattr(COMMANDS[name], f"{name.upper()}_OPTIONS")
    fields = {field.name for field in dataclasses.fields(REQUESTS[name])}
    more = {"screen": {"resume"}, "check": {"resume", "row"}}.get(name, set())
    assert set(told) == fields | more


@dataclass(frozen=True)
class Order:
    source: str
    size: float | None = None
    at: tuple[float, ...] = (1.0, 0.5)


def test_a_request_becomes_a_command():
    asked = []
    told = {
        "source": typer.Argument(help="what"),
        "at": Vector(typer.Option(metavar="X,Y"), (2,), "two numbers"),
        "loud": typer.Option("--loud"),
        "size": typer.Option(help="how much"),
    }

    @options(Order, told)
    def command(request: Order, loud: bool = False) -> None:
        asked.append((request, loud))

    parameters = inspect.signature(command).parameters
    assert list(parameters) == ["source", "at", "loud", "size"]
    assert parameters["source"].default is inspect.Parameter.empty and parameters["at"].default == "1,0.5"
    kinds = [get_args(parameter.annotation)[0] for parameter in parameters.values()]
    assert kinds == [str, str | None, bool, float | None]
    assert all(get_origin(parameter.annotation) is Annotated for parameter in parameters.values())
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(command)
    app(["a", "--at", "-1,2e3", "--loud"], standalone_mode=False)
    app(["b", "--size", "3"], standalone_mode=False)
    assert asked == [(Order("a", None, (-1.0, 2000.0)), True), (Order("b", 3.0), False)]
    for text in ("1", "1,2,3", "1,x", ""):
        with pytest.raises(UserError, match="--at must be two numbers, got"):
            app(["a", "--at", text], standalone_mode=False)


def test_the_command_written_back():
    given = {
        "row": None,
        "max_normal": 2.5,
        "filter": True,
        "resume": False,
        "wrench": (0, -3.0, 1e-9),
        "seed": 0,
    }
    assert (
        command_line("forces", "my file.parquet", given)
        == "jaxgrasp forces 'my file.parquet' --max-normal 2.5 --filter --wrench 0.0,-3.0,1e-09 --seed 0"
    )


def saved_grasp():
    """Three fingers around a circle, in a file."""
    angle = 2 * np.pi * np.arange(3) / 3
    normal = -np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    with precision("float64"):
        jg.save_grasp(jg.Grasp(-0.04 * normal, normal, jg.SoftFinger(0.5, 0.02)), "ring.npz")


@pytest.mark.parametrize(
    "words",
    [
        "screen mug",
        "screen sphere --model soft -k 2 --friction 0.3 -n 1000 --seed 4 --com 0,0.001,0 --verdict-only --filter",
        "screen box --model frictionless --dtype float32 --chunk 100 --tolerance 1e-6 --sampler surface",
        "forces ring.npz --mass 0.3 --gravity 0,-2,0 --g 1.62 --criterion least-norm --length 0.1",
        "forces ring.npz --wrench 0,0,-3,0,1e-3,0 --criterion robust --weight 0.1 --max-normal 20 --row 0",
        "check mug --mass 0.3 --most 10 --chunk 4 --gravity 0,0,-1.62 --fingers 3 --seed 2",
        "check box --mass 1 --model soft --torsion 0.004 --object mug",
        "place box",
        "place box --model soft -k 2 --torsion 0.01 --apart 0.01 --jaw-width 0.1 --objective epsilon --best 3",
    ],
)
def test_the_command_of_a_file_asks_for_the_same_run(words, tmp_path, monkeypatch):
    if not jax.config.jax_enable_x64:
        pytest.skip("the commands switch to float64 themselves")
    monkeypatch.chdir(tmp_path)
    saved_grasp()
    name, metadata = words.split()[0], []
    plan = getattr(COMMANDS[name], f"plan_{name}")

    def planned(request):
        metadata.append(plan(request).metadata)
        raise UserError("that is all")

    monkeypatch.setattr(COMMANDS[name], f"plan_{name}", planned)
    assert main(shlex.split(words)) == 2
    assert main(shlex.split(metadata[0]["command"])[1:]) == 2
    first, again = metadata
    assert first == again
