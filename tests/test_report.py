import builtins
from pathlib import Path

import numpy as np
import pytest
import trimesh

from jaxgrasp import objects, report
from jaxgrasp.core.errors import UserError
from jaxgrasp.core.geometry import contact_frame
from jaxgrasp.core.status import Status
from jaxgrasp.report import Verdict, drawing, explain, reprove_verdict
from jaxgrasp.report.words import screw

COM = np.array([0.01, -0.02, 0.03])


def verdict(**changes):
    """Two hard contacts facing each other along x about the centre of mass; by default a rank-5 pinch."""
    values = {
        "position": COM + np.array([[-0.04, 0, 0], [0.04, 0, 0]]),
        "normal": np.array([[1.0, 0, 0], [-1.0, 0, 0]]),
        "friction": np.array([0.5, 0.5]),
        "torsion": np.zeros(2),
        "active": np.ones(2, bool),
        "centre_of_mass": COM,
        "model": "hard",
        "status": Status.NOT_RESISTANT,
        "margin": 1.0,
        "upper": changes.get("margin", 1.0),
        "rank": 5,
        "force": np.array([[0.0, 0, 1], [0, 0, 1]]),
        "twist": np.array([0.0, 0, 0, 1, 0, 0]),
        **changes,
    }
    return Verdict(**values)


def twist_of(axis, point, pitch):
    """Twist at the centre of mass of a unit turn about the line, advancing ``pitch``."""
    omega = np.asarray(axis, float) / np.linalg.norm(axis)
    twist = np.concatenate([np.cross(omega, COM - point) + pitch * omega, omega])
    return twist / np.linalg.norm(twist)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 0, -2), (1, 2, 3)])
@pytest.mark.parametrize("point", [(0, 0, 0), (0.3, -0.2, 0.1)])
def test_rotations_are_recovered(axis, point):
    found = screw(twist_of(axis, np.asarray(point), 0.0), COM, 0.05)
    unit = np.asarray(axis) / np.linalg.norm(axis)
    assert found.kind == "rotation" and found.pitch == 0
    assert found.direction == pytest.approx(unit)
    arm = found.point - np.asarray(point)
    assert arm - (arm @ unit) * unit == pytest.approx([0, 0, 0], abs=1e-12)  # a point on the same line
    assert (found.point - COM) @ unit == pytest.approx(0, abs=1e-12)  # the one nearest to the centre of mass


def test_slides_and_screws_are_recovered():
    slide = screw(np.array([0, 0.6, -0.8, 0, 0, 0]), COM, 0.05)
    assert slide.kind == "slide" and slide.direction == pytest.approx([0, 0.6, -0.8]) and slide.point is None
    found = screw(twist_of((0, 1, 0), np.zeros(3), 0.02), COM, 0.05)
    assert found.kind == "screw" and found.pitch == pytest.approx(0.02)
    assert found.point == pytest.approx([0, -0.02, 0])
    slight = screw(twist_of((0, 1, 0), np.zeros(3), 1e-4), COM, 0.05)
    assert slight.kind == "rotation" and slight.pitch == pytest.approx(1e-4)


def test_the_drawn_motion_has_the_twist_as_its_velocity():
    random = np.random.default_rng(0)
    points = random.normal(size=(20, 3)) * 0.05
    for twist in (twist_of((1, 2, 3), np.array([0.02, 0, 0.01]), 0.03), np.array([0, 0.6, -0.8, 0, 0, 0])):
        motion, h = screw(twist, COM, 0.05), 1e-6
        ahead, behind = (drawing.moved(points, motion, COM, 0.05, s) for s in (h, -h))
        velocity = (ahead - behind) / (2 * h)
        expected = twist[:3] + np.cross(twist[3:], points - COM)
        cosine = (
            np.sum(velocity * expected, 1)
            / np.linalg.norm(velocity, axis=1)
            / np.linalg.norm(expected, axis=1)
        )
        assert cosine == pytest.approx(1, abs=1e-9)
        ratio = np.linalg.norm(velocity, axis=1) / np.linalg.norm(expected, axis=1)
        assert ratio == pytest.approx(ratio[0], rel=1e-6)
        far = drawing.moved(points, motion, COM, 0.05, 0.3)
        if motion.kind != "slide":
            before = np.linalg.norm(points[:1] - points[1:], axis=1)
            assert np.linalg.norm(far[:1] - far[1:], axis=1) == pytest.approx(before)  # rigid


def test_a_pinch_that_spins_in_words():
    told = explain(verdict())
    assert Status.NOT_RESISTANT.sentence in told
    assert "Rank: 5 of 6" in told
    assert "a rotation about the axis along (1, 0, 0) through (0.01, -0.02, 0.03) m" in told
    assert "passes through the centre of mass" in told
    assert told.count("the surface only spins on the finger") == 2
    assert "balance" not in told  # forces are no proof here


def test_the_bracket_of_the_margin_in_words():
    assert "Margin: between 1 and 1.25 (1 is the best" in explain(verdict(upper=1.25))


def test_a_slide_in_words():
    normal = np.array([[1.0, 0, 0], [0.8, 0.6, 0]])
    told = explain(
        verdict(normal=normal, rank=6, margin=-np.inf, force=None, twist=np.array([1.0, 0, 0, 0, 0, 0]))
    )
    assert "Margin: -inf" in told and "a slide along (1, 0, 0)" in told
    assert (
        "contact 0: the surface draws away at 90.0 degrees to itself; friction holds up to 26.6 degrees"
        in told
    )
    assert "contact 1: the surface draws away at 53.1 degrees to itself" in told


def test_a_screw_in_words():
    twist = twist_of((0, 0, 1), np.array([0.11, -0.02, 0.0]), 0.03)
    told = explain(verdict(twist=twist, rank=6, margin=-0.25, force=None))
    assert "the axis along (0, 0, 1) through (0.11, -0.02, 0.03) m" in told
    assert (
        f"advancing {30 * np.pi / 180:.3g} mm along it with each degree (100 mm from the centre of mass)"
        in told
    )


def test_forces_in_words():
    force = np.array([[0.3, 0.0, 1.0, 0.002], [0.0, -0.4, 1.0, 0.0]])
    told = explain(
        verdict(
            status=Status.RESISTANT,
            model="soft",
            torsion=np.full(2, 0.0025),
            rank=6,
            force=force,
            twist=None,
            margin=0.2,
        )
    )
    assert Status.RESISTANT.sentence in told and "Margin: between 0.2 and 0.2" in told
    assert (
        "contact 0: normal 1 N, tangential 0.3 N, spin torque 0.002 N m, 100 % of the cone" in told
    )  # 0.6, 0.8
    assert "contact 1: normal 1 N, tangential 0.4 N, spin torque 0 N m, 80 % of the cone" in told
    told = explain(
        verdict(status=Status.RESISTANT, model="frictionless", rank=6, force=np.ones((2, 1)), twist=None)
    )
    assert "normal 1 N, tangential 0 N, 0 % of the cone" in told


def test_inactive_contacts_are_not_mentioned():
    told = explain(verdict(active=np.array([True, False])))
    assert "contact 0" in told and "contact 1" not in told


def test_what_is_wrong_with_an_invalid_grasp():
    position = verdict().position.copy()
    position[1, 2] = np.nan
    broken = verdict(
        status=Status.INVALID, position=position, normal=np.zeros((2, 3)), friction=np.array([-1.0, 0.5]),
        margin=np.nan, rank=None, force=None, twist=None,
    )  # fmt: skip
    told = explain(broken)
    for line in (
        "contact 0: the normal has length zero",
        "contact 0: the friction is negative",
        "contact 1: the position is not",
    ):
        assert line in told
    assert "no contact is active" in explain(verdict(status=Status.INVALID, active=np.zeros(2, bool)))
    assert "nothing to prove" in reprove_verdict(broken, {"dtype": "float64"})
    assert "do not fit" in reprove_verdict(verdict(status=Status.INVALID), {"dtype": "float64"})
    with pytest.raises(UserError, match="invalid grasp has no picture"):
        report.draw(broken, Path("never.png"))


def test_stored_evidence_is_proved_again():
    metadata = {"dtype": "float64", "tolerance": 1e-8}
    assert "the proof holds" in reprove_verdict(verdict(), metadata)
    assert "does NOT" in reprove_verdict(verdict(twist=np.array([0.0, 0, 0, 0, 1, 0])), metadata)
    assert "does NOT" in reprove_verdict(verdict(status=Status.RESISTANT), metadata)
    assert "nothing to prove" in reprove_verdict(verdict(status=Status.UNDECIDED), metadata)


def test_rows_without_metadata_are_refused():
    known = {"centre_of_mass": [0.0] * 3, "model": {"kind": "hard"}}
    for metadata in ({}, {**known, "model": ["hard"]}, {**known, "model": {"kind": "gecko"}}):
        with pytest.raises(UserError, match="screen it again"):
            Verdict.from_row({"internal_force": None}, metadata)
    for status in (None, 77):
        with pytest.raises(UserError, match=f"the row's status, {status}, is none"):
            Verdict.from_row({"status": status}, known)


def test_forces_are_drawn_in_the_solver_s_frame():
    normal = np.array([0.6, 0.0, -0.8])
    found = drawing._world_force(verdict(force=np.array([[0.1, 0.2, 0.3], [0, 0, 1]])), 0, normal)
    first, second = contact_frame(normal)
    assert found == pytest.approx(0.1 * np.asarray(first) + 0.2 * np.asarray(second) + 0.3 * normal)


@pytest.mark.parametrize(
    "shown",
    [
        verdict(),
        verdict(twist=np.array([1.0, 0, 0, 0, 0, 0])),
        verdict(status=Status.RESISTANT, twist=None, rank=6),
    ],
)
def test_pictures(tmp_path, shown):
    mesh = objects.make_object("box")
    report.draw(shown, tmp_path / "a.png", mesh)
    report.draw(shown, tmp_path / "b.png", mesh)
    data = (tmp_path / "a.png").read_bytes()
    assert data.startswith(b"\x89PNG") and data == (tmp_path / "b.png").read_bytes()
    report.draw(shown, tmp_path / "c.png")  # contacts only
    assert (tmp_path / "c.png").read_bytes() != data
    assert len(list(tmp_path.iterdir())) == 3


def test_pictures_that_cannot_be_written(tmp_path):
    for path in (tmp_path / "no" / "a.png", tmp_path / "a.xyz"):
        with pytest.raises(UserError, match="cannot be written as a picture"):
            report.draw(verdict(), path)
    assert list(tmp_path.iterdir()) == []


def test_without_matplotlib(tmp_path, monkeypatch):
    original = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(UserError, match=r"pip install 'jaxgrasp\[viz\]'"):
        report.draw(verdict(), tmp_path / "a.png")


def test_large_meshes_are_simplified_for_drawing():
    sphere = trimesh.creation.icosphere(subdivisions=6)
    simple = drawing._simpler(sphere)
    assert len(simple.faces) <= drawing.MOST_FACES < len(sphere.faces)
    assert simple.extents == pytest.approx(sphere.extents, rel=0.05)
    mug = objects.load_mesh("mug").mesh
    assert drawing._simpler(mug) is mug
