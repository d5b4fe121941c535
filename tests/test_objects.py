import numpy as np
import pytest

from jaxgrasp import objects
from jaxgrasp.core.errors import UserError


@pytest.mark.parametrize("name", list(objects.OBJECTS))
def test_a_closed_surface_of_everyday_size(name):
    mesh = objects.make_object(name)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0
    assert 0.05 <= mesh.extents.max() <= 0.20
    assert mesh.area_faces.min() > 1e-7
    edges = np.sort(mesh.edges, axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 2).all()  # one surface, no edge shared by more than two faces


@pytest.mark.parametrize("name", list(objects.OBJECTS))
def test_the_same_every_time(name):
    first, second = objects.make_object(name), objects.make_object(name)
    assert np.array_equal(first.vertices, second.vertices) and np.array_equal(first.faces, second.faces)


@pytest.mark.parametrize(
    ("name", "volume"),
    [
        ("box", 0.12 * 0.08 * 0.06),
        ("sphere", 4 / 3 * np.pi * 0.04**3),
        ("cylinder", np.pi * 0.033**2 * 0.12),
        ("torus", 2 * np.pi**2 * 0.05 * 0.015**2),
    ],
)
def test_volumes_of_the_shapes_they_approximate(name, volume):
    mesh = objects.make_object(name)
    assert 0.985 * volume <= mesh.volume <= volume * (1 + 1e-9)
    assert np.allclose(mesh.center_mass, 0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "holes"), [("mug", 1), ("torus", 1), ("bottle", 0), ("bowl", 0), ("box", 0)]
)
def test_number_of_handles(name, holes):
    assert objects.make_object(name).euler_number == 2 - 2 * holes


def test_the_mug_has_a_cavity_a_wall_and_a_handle():
    mesh = objects.make_object("mug")
    sections = 64
    polygon = sections / 2 * np.sin(2 * np.pi / sections)  # area of the 64-gon in a unit circle
    cup = polygon * (0.040**2 * 0.095 - 0.036**2 * (0.095 - 0.006))
    arc = 0.0075 * 0.0050 * np.pi * 0.096  # elliptic section times the length of the handle's middle line
    assert cup < mesh.volume < cup + 1.3 * arc
    assert mesh.volume > cup + 0.7 * arc
    assert mesh.bounds[1, 0] == pytest.approx(0.040 + 0.034 + 0.005, abs=2e-4)
    assert 0 < mesh.center_mass[0] < 0.01 and abs(mesh.center_mass[1]) < 1e-9
    # From the middle of the cavity: no wall above, the inner wall to the side, the bottom below.
    axis_points = np.linalg.norm(mesh.vertices[:, :2], axis=1) < 1e-9
    assert sorted(mesh.vertices[axis_points, 2]) == pytest.approx([0.0, 0.006])


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(UserError, match="mug"):
        objects.make_object("teacup")
