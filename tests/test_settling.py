"""Settling: contacts go where an objective is best on the triangles themselves, each start on its own."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxgrasp as jg
from jaxgrasp import surfaces
from jaxgrasp.placement import place as placement
from jaxgrasp.placement.objectives import Measure
from jaxgrasp.placement.requirements import Apart, Beyond
from jaxgrasp.placement.search import Search
from jaxgrasp.placement.settle import CLOUD, settle

MODEL = jg.HardFinger(0.5)
TARGET = np.array([[0.06, 0.0, 0.0], [0.0, 0.06, 0.0]])


def coarse(subdivisions=1, resolution=32):
    """A ball of 5 cm out of few triangles: a facet's normal is up to 20 degrees off the ball's."""
    return surfaces.MeshSurface(trimesh.creation.icosphere(subdivisions, radius=0.05), resolution=resolution)


def near_targets(grasp):
    """Minus the distances of two contacts to the two targets, m: best at the points of the surface nearest to these."""
    return -jnp.sum(jnp.linalg.norm(grasp.position - TARGET, axis=-1), axis=-1)


@pytest.fixture(scope="module")
def ball():
    return coarse()


def settled(surface, objective, requirements=(), count=24, seed=5, rounds=32):
    point, normal = surface.sample(7, 2 * 24)
    point, normal = point.reshape(24, 2, 3)[:count], normal.reshape(24, 2, 3)[:count]
    groups = list(settle(surface, MODEL, Measure(objective), requirements, point, normal, seed, rounds))
    assert np.concatenate([g.start for g in groups]).tolist() == list(range(count))
    return point, np.concatenate([g.position for g in groups]), np.concatenate([g.normal for g in groups])


def test_contacts_come_to_rest_nearest_to_their_targets(ball):
    """The best is known; the points they may go to are about ``sqrt(area / CLOUD)`` apart."""
    _, position, normal = settled(ball, near_targets, rounds=60)
    centre = np.asarray(ball.centre)
    best = ball.exact_contact(TARGET + centre)[0] - centre
    gap = np.sqrt(ball.triangles.area.sum() / CLOUD)
    assert np.median(np.linalg.norm(position - centre - best, axis=-1)) < 2 * gap
    exact = ball.project_exact(position)
    assert exact.distance.max() < 1e-12
    inside = exact.barycentric.min(axis=-1) > 1e-6  # on an edge either face's normal is right
    np.testing.assert_allclose(normal[inside], exact.normal[inside], atol=1e-12)


def test_requirements_hold_at_every_rest_that_moved(ball):
    """A ball around one target is forbidden, and both contacts keep their distance."""
    centre = np.asarray(ball.centre)
    asked = (Apart(0.03), Beyond(tuple(TARGET[0] + centre), 0.03))
    slack = 1e-3 * float(ball.radius)

    def distances(position):
        apart = np.linalg.norm(position[:, 0] - position[:, 1], axis=-1)
        return apart, np.linalg.norm(position - centre - TARGET[0], axis=-1).min(axis=1)

    before, position, _ = settled(ball, near_targets, asked)
    moved = (position != before).any(axis=(1, 2))
    allowed = np.min(distances(before), axis=0) >= 0.03
    assert 12 <= allowed.sum() < 24
    assert moved[allowed].all()
    apart, away = distances(position)
    assert apart[moved].min() >= 0.03 - slack
    assert away[moved].min() >= 0.03 - slack
    assert np.median(away[moved]) < 0.033  # they come as near as they may


def test_a_start_settles_on_its_own_and_the_same_way_again(ball):
    whole = settled(ball, near_targets)
    some = settled(ball, near_targets, count=10)
    assert some[1].tobytes() == whole[1][:10].tobytes()
    assert settled(ball, near_targets)[1].tobytes() == whole[1].tobytes()
    assert settled(ball, near_targets, seed=6)[1].tobytes() != whole[1].tobytes()


def test_no_number_is_no_improvement(ball):
    """NaN above the middle: who starts below stays below, and only a number takes the others away."""

    def holes(grasp):
        return jnp.where(jnp.any(grasp.position[..., 2] > 0, axis=-1), jnp.nan, near_targets(grasp))

    before, position, _ = settled(ball, holes)
    centre = np.asarray(ball.centre)
    low = (before[..., 2] <= centre[2]).all(axis=1)
    assert 3 <= low.sum() <= 21
    moved = (position != before).any(axis=(1, 2))
    assert moved[low].all()
    assert (position[moved][..., 2] <= centre[2] + 1e-15).all()


def test_nowhere_to_go_leaves_contacts_alone(ball):
    before, position, normal = settled(ball, lambda grasp: jnp.full(grasp.batch_shape, jnp.nan))
    assert position.tobytes() == before.tobytes()
    assert np.isfinite(normal).all()


@pytest.mark.slow("test_contacts_come_to_rest_nearest_to_their_targets")
def test_placement_on_large_facets_gains_by_settling():
    """Facets of an icosahedron: the smooth surface that is climbed is another body than the one that is grasped."""
    surface = coarse(0)
    with_, without = (
        placement.place_contacts(
            surface, fingers=3, search=Search(64, steps=60, candidates=64, settling=rounds)
        )
        for rounds in (32, 0)
    )
    assert (with_.after >= without.after - 1e-9).all()
    assert np.median(with_.after) > np.median(without.after) + 0.02
    assert with_.resistant.all() and with_.proved.all()
