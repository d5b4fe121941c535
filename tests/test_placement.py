"""Placement: contacts climb to the best grasp of a ball, keep what is required of them, and prove what they reach."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp import surfaces
from jaxgrasp.core.errors import UserError
from jaxgrasp.placement import place as placement
from jaxgrasp.placement.objectives import Epsilon, EpsilonFloor
from jaxgrasp.placement.requirements import SLACK, Apart, Beyond, EdgeClearance, JawWidth, Requirement, Within
from jaxgrasp.placement.search import Search


class NotNumbers(Requirement):
    """NaN wherever the first contact lies above the middle."""

    def excess(self, surface, position, normal):
        return jnp.where(position[..., 0, 2] > 0, jnp.nan, 0.0)


BALL = surfaces.Sphere(0.05, jnp.array([0.1, 0.0, -0.2]))
ASKED = (Apart(0.03), Beyond((0.1, 0.0, -0.15), 0.03))


@pytest.fixture(scope="module")
def placed():
    seen = []
    out = placement.place_contacts(
        BALL, fingers=3, requirements=ASKED, search=Search(24, steps=120), progress=seen.append
    )
    return out, seen


def test_three_fingers_climb_to_the_equator_of_a_ball(placed):
    """Margin 1: equal normal forces in balance, three fingers 120 degrees apart in a plane through the centre."""
    out, seen = placed
    assert out.resistant.all()
    assert (out.after >= out.before - 1e-9).all()
    assert np.median(out.after) > 0.98
    assert out.value[0] > 0.995
    assert (np.diff(out.value) <= 0).all()
    normal = np.asarray(out.grasp.normal[0])
    cosines = [normal[i] @ normal[j] for i, j in ((0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(cosines, -0.5, atol=0.1)
    assert str(out).startswith(
        f"{len(out.value)} distinct grasps of 3 contacts from 24 starts; 24 starts ended"
    )
    assert f"value {out.value[0]:.6g}, start {out.start[0]}, RESISTANT, proved" in str(out)
    assert seen[-1].done == 24
    assert seen[-1].best == pytest.approx(out.after.max(), rel=0.02)


def test_every_grasp_returned_is_proved_and_within_what_was_asked(placed):
    out, _ = placed
    assert out.proved.all()
    assert jg.check(out.grasp, out.verdict).all()
    distance = np.linalg.norm(out.position - np.array([0.1, 0.0, -0.2]), axis=-1)
    np.testing.assert_allclose(distance, 0.05, rtol=1e-9)
    pairs = [
        np.linalg.norm(out.position[:, i] - out.position[:, j], axis=-1) for i, j in ((0, 1), (0, 2), (1, 2))
    ]
    assert np.min(pairs) >= 0.03 - SLACK * 0.05
    assert np.linalg.norm(out.position - np.array([0.1, 0.0, -0.15]), axis=-1).min() >= 0.03 - SLACK * 0.05
    for i in range(len(out.value)):  # no two alike, however their fingers are numbered
        for j in range(i):
            assert np.abs(np.sort(out.position[i], axis=0) - np.sort(out.position[j], axis=0)).max() > 0


def test_the_same_seed_gives_the_same_bytes(placed):
    out, _ = placed
    again = placement.place_contacts(BALL, fingers=3, requirements=ASKED, search=Search(24, steps=120))
    assert out.position.tobytes() == again.position.tobytes()
    assert out.after.tobytes() == again.after.tobytes()


def test_excesses_are_distances():
    position = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.02], [0.0, 0.0, 0.1]])
    normal = jnp.zeros((3, 3))

    def excess(requirement):
        return float(requirement.excess(BALL, position, normal))

    assert excess(Apart(0.05)) == pytest.approx(0.03)
    assert excess(Apart(0.01)) == 0
    assert excess(JawWidth(0.015)) == pytest.approx(0.005)
    assert excess(JawWidth(0.5, 0.03)) == pytest.approx(0.01)
    assert excess(Within(lambda p: p[2] - 0.01)) == pytest.approx(0.01)
    assert excess(Beyond((0.0, 0.0, 0.11), 0.02)) == pytest.approx(0.01)
    assert excess(EdgeClearance(0.01)) == 0  # a ball has no edges
    box = surfaces.RoundedBox(jnp.array([0.1, 0.1, 0.1]), 0.01)
    corner = jnp.array([[0.1, 0.08, 0.0]])
    assert float(EdgeClearance(0.03).excess(box, corner, corner)) == pytest.approx(0.02, abs=1e-6)


def test_mistakes_are_answered(monkeypatch):
    with pytest.raises(ValueError, match=r"surface must be a jaxgrasp\.surfaces\.Surface"):
        placement.place_contacts("mug")
    with pytest.raises(ValueError, match="fingers must be an integer of 1 or more"):
        placement.place_contacts(BALL, fingers=0)
    with pytest.raises(ValueError, match="starts must be an integer of 1 or more"):
        Search(0)
    with pytest.raises(ValueError, match="settling must be an integer of 0 or more"):
        Search(settling=-1)
    with pytest.raises(ValueError, match=r"requirements must be those of jaxgrasp\.placement"):
        placement.place_contacts(BALL, requirements=[0.02])
    monkeypatch.setattr(placement, "DRAWS", 4)  # of the many after which it gives up
    with pytest.raises(UserError, match="no contact on this surface meets the requirements"):
        placement.place_contacts(BALL, search=Search(4), requirements=[Within(lambda p: p[0] - 5.0)])


@pytest.mark.slow("test_settling.py::test_no_number_is_no_improvement")
def test_a_start_without_numbers_ends_alone():
    out = placement.place_contacts(BALL, fingers=3, requirements=(NotNumbers(),), search=Search(24, steps=60))
    assert len(out.value) > 0
    assert np.isfinite(out.value).all()
    assert (out.position[:, 0, 2] <= 0).all()


def test_a_start_does_not_depend_on_how_many_there_are(placed):
    out, _ = placed
    fewer = placement.place_contacts(BALL, fingers=3, requirements=ASKED, search=Search(10, steps=120))
    assert fewer.before.tobytes() == out.before[:10].tobytes()
    assert fewer.end.tobytes() == out.end[:10].tobytes()


@pytest.mark.slow(
    "test_objectives.py::test_the_bank_finds_the_weakest_direction",
    "test_objectives.py::test_the_floor_is_below_epsilon_and_ranks_like_it",
)
def test_epsilon_as_the_objective_on_an_ellipsoid():
    """What is climbed grows, beyond what its guide reaches; the numbers are those of ``epsilon_quality``."""
    surface = surfaces.Ellipsoid(jnp.array([0.03, 0.04, 0.06]))
    climbed = placement.place_contacts(surface, fingers=4, objective=Epsilon("L1", 0.06), search=Search(32))
    guided = placement.place_contacts(surface, fingers=4, objective=EpsilonFloor(0.06), search=Search(32))
    margin = placement.place_contacts(surface, fingers=4, search=Search(32))
    assert climbed.resistant.all() and climbed.proved.all()
    epsilon = [
        np.asarray(
            jg.epsilon_quality(
                jg.Grasp(out.end, surface.normal(out.end), jg.HardFinger(0.5)), torque_scale=0.06
            ).upper
        )
        for out in (margin, guided, climbed)
    ]
    median = np.median(epsilon, axis=1)
    assert median[1] > 1.01 * median[0]
    assert median[2] > 1.02 * median[1]
    again = jg.epsilon_quality(climbed.grasp, torque_scale=0.06)
    np.testing.assert_allclose(climbed.value, again.upper, rtol=1e-9)
    assert (np.diff(climbed.value) <= 0).all()


@pytest.mark.slow("test_three_fingers_climb_to_the_equator_of_a_ball")
@pytest.mark.parametrize(
    ("measure", "gains"),
    [
        (lambda grasp: -jg.critical_friction(grasp).factor, True),
        (lambda grasp: jg.guaranteed_radius(grasp).radius, False),
        (jg.quality.grasp_isotropy, True),
    ],
    ids=["critical friction", "guaranteed radius", "isotropy"],
)
def test_any_measure_climbs(measure, gains):
    surface = surfaces.Ellipsoid(jnp.array([0.03, 0.04, 0.06]))
    few = Search(8, steps=40, candidates=32)
    climbed = placement.place_contacts(surface, objective=measure, search=few)
    margin = placement.place_contacts(surface, search=few)

    def median(out):
        grasp = jg.Grasp(out.end, surface.normal(out.end), jg.HardFinger(0.5))
        return np.median(np.asarray(measure(grasp)))

    # Where the margin is largest the internal force has a kink, and so has the radius: both end there, to rounding.
    if gains:
        assert median(climbed) > median(margin)
    else:
        assert median(climbed) >= (1 - 1e-9) * median(margin) > 0


@pytest.mark.slow("test_three_fingers_climb_to_the_equator_of_a_ball")
def test_most_starts_on_the_mug_end_resistant():
    out = placement.place_contacts(surfaces.of("mug", resolution=64), fingers=4, search=Search(128))
    assert out.resistant.mean() > 0.95
    assert np.median(out.after) > np.median(out.before)
    assert out.proved.all()
