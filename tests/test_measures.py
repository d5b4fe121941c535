"""Task quality against closed forms; isotropy and volume against NumPy."""

import numpy as np
import pytest
from grasps import ball
from shapes import PLANAR

import jaxgrasp as jg

PAIR = np.array([[-1.0, 0.0], [1.0, 0.0]])


def pinch(normal):
    """Two planar fingers, padded to the shape that tests share."""
    rest = np.zeros((PLANAR - 2, 2))
    return jg.Grasp(
        np.concatenate([PAIR, rest]),
        np.concatenate([normal, rest + 1]),
        jg.HardFinger(0.4),
        np.arange(PLANAR) < 2,
    )


@pytest.mark.parametrize(("norm", "effort"), [("L1", 1.0), ("Linf", 0.5)])
def test_a_planar_pinch_lifts(norm, effort):
    """Two opposite planar fingers hold a weight w with w / (2 mu) each: effort w / mu in sum, w / (2 mu) at most."""
    grasp = pinch(-PAIR)
    loads = np.array([[0.0, -1.0, 0.0], [0.0, -3.0, 0.0], [0.0, 2.0, 0.0]])
    out = jg.task_quality(grasp, loads, norm=norm)
    np.testing.assert_allclose(out.effort, effort * np.array([1.0, 3.0, 2.0]) / 0.4, rtol=1e-6)
    assert int(out.worst) == 1
    assert float(out.multiple) == pytest.approx(0.4 / (3 * effort), rel=1e-6)
    with pytest.raises(ValueError, match="norm must be one of"):
        jg.task_quality(grasp, loads, norm="L2")


def test_what_cannot_be_held_has_no_multiple():
    shelf = pinch(np.array([[0.0, 1.0], [0.0, 1.0]]))
    out = jg.task_quality(shelf, np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]))
    assert float(out.multiple) == 0
    assert np.isfinite(np.asarray(out.effort)).tolist() == [True, False]
    assert int(out.worst) == 1


def test_isotropy_and_volume():
    position, normal, friction = ball(np.random.default_rng(0), 5, 3)
    grasp = jg.Grasp(position * 0.1, normal, jg.HardFinger(friction))
    G = np.asarray(jg.grasp_map(grasp)).copy()
    G[:, 3:] /= 0.05
    values = np.linalg.svd(G, compute_uv=False)
    np.testing.assert_allclose(
        jg.quality.grasp_isotropy(grasp, torque_scale=0.05), values[:, -1] / values[:, 0], rtol=1e-9
    )
    np.testing.assert_allclose(jg.quality.grasp_volume(grasp, torque_scale=0.05), values.prod(-1), rtol=1e-9)
    two = jg.Grasp(position[:, :1], normal[:, :1], jg.HardFinger(0.5))
    np.testing.assert_array_equal(jg.quality.grasp_volume(two), np.zeros(5))
