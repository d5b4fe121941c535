"""Every public function under every transformation: the same values as without, and derivatives where there are any."""

import inspect
import os
import subprocess
import sys
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from manners import CASES, HOST, pinch, row

import jaxgrasp as jg
from jaxgrasp import quality

HERE = Path(__file__).parent
STRETCHED = 1.3
EAGER = ("grasp_map", "null_space", "quality.grasp_isotropy", "contacts.nearest_admissible")
QUICK = ("grasp_map", "quality.grasp_isotropy")  # all others are slow


def numbers(name, scale, padding=None):
    return row(CASES[name].of(pinch(scale, padding)))


def weighed(name, padding=None):
    """All numbers of a case as one number, a function of the lengths' scale."""

    def of(scale):
        found = numbers(name, scale, padding)
        return jnp.sum(jnp.linspace(1.0, 2.0, len(found)) * found)

    return of


def close(a, b):
    a, b = np.asarray(a), np.asarray(b)
    assert np.all(np.isfinite(a)) and np.all(np.isfinite(b))
    np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9)


def split(names, quick, *brothers):
    """``names`` as parameters, all but the ``quick`` ones marked slow."""
    return [pytest.param(n, marks=[] if n in quick else [pytest.mark.slow(*brothers)]) for n in names]


SMOOTH = [name for name, case in CASES.items() if case.smooth]


def test_every_public_function_is_in_the_table():
    named = {name.split(",")[0] for name in CASES} | set(HOST)
    missing = [n for n in jg.__all__ if inspect.isfunction(inspect.unwrap(getattr(jg, n))) and n not in named]
    assert missing == []


@pytest.mark.parametrize("name", split(CASES, QUICK))
def test_functions_agree_under_transformations(name):
    """``jit`` and ``vmap``, two threads at once, ``jax.checkpoint`` of what is mapped."""
    expected = [numbers(name, s) for s in (1.0, STRETCHED)]
    scales = jnp.array([1.0, STRETCHED])
    mapped = jax.jit(jax.vmap(jax.checkpoint(lambda s: numbers(name, s))))
    close(mapped(scales), jnp.stack(expected))
    close(jax.jit(lambda s: numbers(name, s))(STRETCHED), expected[1])

    found = {}
    threads = [
        threading.Thread(target=lambda s=s: found.update({s: numbers(name, s)}), daemon=True)
        for s in (1.0, STRETCHED)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(300)
    close(found[1.0], expected[0])
    close(found[STRETCHED], expected[1])


@pytest.mark.parametrize("padding", [0.0, np.nan], ids=["zeros", "nan"])
@pytest.mark.parametrize("name", split(CASES, QUICK))
def test_padding_is_not_read(name, padding):
    """Values are those of the contacts there are, and so are derivatives."""
    close(numbers(name, 1.0, padding), numbers(name, 1.0))
    if name in SMOOTH:
        close(jax.grad(weighed(name, padding))(1.0), jax.grad(weighed(name))(1.0))


@pytest.mark.parametrize("name", split(SMOOTH, QUICK))
def test_derivatives_agree_in_every_mode(name):
    """Forward, backward, linearised, rematerialised, and forward over backward of a derivative that exists."""
    of = weighed(name)
    slope = jax.grad(of)(1.0)
    close(jax.jvp(of, (1.0,), (1.0,))[1], slope)
    close(jax.linearize(of, 1.0)[1](1.0), slope)
    close(jax.grad(jax.checkpoint(of))(1.0), slope)
    if name not in ("epsilon_quality",):  # its second derivatives do not exist
        step = 1e-5
        bent = jax.jvp(jax.grad(of), (1.0,), (1.0,))[1]
        assert np.isfinite(bent)
        if name in ("grasp_map", "contacts.length_scale", "quality.grasp_volume"):
            up, down = jax.grad(of)(1.0 + step), jax.grad(of)(1.0 - step)
            np.testing.assert_allclose(bent, (up - down) / (2 * step), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", split(CASES, QUICK))
def test_a_healthy_grasp_makes_no_nan(name):
    """Not in what any compiled program returns; for what padding says, too."""
    expected = numbers(name, 1.0)
    with jax.debug_nans(True):
        close(numbers(name, 1.0), expected)
        close(numbers(name, 1.0, 0.0), expected)


@pytest.mark.parametrize("name", split(CASES, EAGER))
def test_functions_work_without_compiling(name):
    """Operation by operation, none of which makes a NaN."""
    expected = numbers(name, 1.0)
    with jax.disable_jit(), jax.debug_nans(True):
        close(numbers(name, 1.0), expected)


def on_two_devices(names):
    """What ``on_two_devices`` of the table says, in a process with two devices."""
    environment = os.environ | {
        "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2",
        "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE / "tables")]),
    }
    done = subprocess.run(
        [sys.executable, str(HERE / "tables" / "manners.py"), *names],
        env=environment, capture_output=True, text=True, timeout=900,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    found = [line.split(maxsplit=1) for line in done.stdout.splitlines()]
    assert [name for _, name in found] == [name for name in names for _ in range(2)]
    assert max(float(worst) for worst, _ in found) < 1e-9


@pytest.mark.parametrize("name", ["grasp_map", "wrench_resistance", "optimize_forces, robust"])
def test_programs_pass_the_checks_of_shard_map(name):
    """``jax.shard_map`` with its defaults, traced for one device: loops agree with what they begin with."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("device",))
    split = jax.sharding.PartitionSpec("device")

    def of(scales):
        return jax.vmap(lambda s: numbers(name, s))(scales)

    scales = jnp.array([1.0, STRETCHED])
    mapped = jax.shard_map(of, mesh=mesh, in_specs=split, out_specs=split)
    assert jax.eval_shape(mapped, scales).shape == jax.eval_shape(of, scales).shape


@pytest.mark.slow("test_programs_pass_the_checks_of_shard_map")
def test_two_devices_find_the_same():
    """``jax.shard_map`` with its defaults, and arrays that lie on two devices."""
    on_two_devices(list(CASES))


def test_isotropy_and_volume_through_padding():
    """The derivative in a scale of the positions where a contact of zeros is no contact."""
    p, n = np.array([[-1.0, 0.0], [1.0, 0.1], [0.0, 0.0]]), np.array([[1.0, 0.1], [-1.0, 0.0], [0.0, 0.0]])

    def grasp(scale):
        return jg.Grasp(scale * jnp.asarray(p), n, jg.HardFinger(0.5), np.array([True, True, False]))

    def slope(measure):
        return jax.grad(lambda s: jnp.sum(measure(grasp(s))))(1.0)

    np.testing.assert_allclose(
        slope(lambda g: quality.grasp_isotropy(g, torque_scale=1.0)), -0.047503, atol=1e-6
    )
    # sigma_1 sigma_2 are of forces, sigma_3 grows with the lengths' scale: the volume's derivative is itself.
    volume = quality.grasp_volume(grasp(1.0), torque_scale=1.0)
    two = quality.grasp_volume(jg.Grasp(p[:2], n[:2], jg.HardFinger(0.5)), torque_scale=1.0)
    np.testing.assert_allclose(volume, two, rtol=1e-12)
    assert np.isfinite(slope(lambda g: quality.grasp_volume(g, torque_scale=1.0)))
    # So its second derivative is 0, though those of the singular values are not: their vectors turn.
    assert abs(jax.grad(jax.grad(lambda s: quality.grasp_volume(grasp(s), torque_scale=1.0)))(1.0)) < 1e-12
    direct = np.asarray(jg.grasp_map(grasp(1.0)))[
        2
    ].sum()  # torques are what a scale of the positions changes
    np.testing.assert_allclose(slope(jg.grasp_map), direct, rtol=1e-12)
