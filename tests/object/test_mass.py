"""Mass properties of closed and open meshes, and that all who weigh an object agree."""

import numpy as np
import pytest
import trimesh
from support.jaws import mesh_record
from support.solids import YOU, no_cut, prism

from lgrasp.dataset.metrics import mass_frame
from lgrasp.errors import ObjectError
from lgrasp.hold.run import course_of
from lgrasp.judge.meshes import clean_mesh, mass_centre
from lgrasp.object.mass import mass_properties
from lgrasp.object.preprocess import preprocess_object
from lgrasp.simulate.solid import object_of_record


def opened(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Without the faces of its upper end."""
    top = mesh.triangles_center[:, 2] > mesh.bounds[1, 2] - 1e-6
    assert top.any()
    return trimesh.Trimesh(mesh.vertices, mesh.faces[~top], process=False)


def joined(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """One mesh, vertices at one place being one."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    faces = np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=False)])
    return trimesh.Trimesh(np.concatenate([m.vertices for m in meshes]), faces)


def bottle() -> trimesh.Trimesh:
    """A wide closed cylinder with a narrow one beneath, apart: its hull is another body than it."""
    wide, narrow = (trimesh.creation.cylinder(radius, 0.04) for radius in (0.03, 0.01))
    return joined(wide.apply_translation([0.01, 0, 0.05]), narrow)


def test_closed_mesh_against_trimesh():
    mesh = prism(YOU, 0.02).apply_translation([3.0, -2.0, 1.0])
    found = mass_properties(mesh.vertices, mesh.faces)
    assert found.solid
    assert found.volume == pytest.approx(mesh.volume, rel=1e-9)
    np.testing.assert_allclose(found.center, mesh.center_mass, atol=1e-9)
    at_home = prism(YOU, 0.02)
    np.testing.assert_allclose(found.inertia, at_home.moment_inertia, atol=1e-9 * np.trace(at_home.moment_inertia))


def test_inertia_of_a_box():
    x, y, z = 0.04, 0.06, 0.08
    mesh = trimesh.creation.box((x, y, z))
    found = mass_properties(mesh.vertices, mesh.faces)
    wanted = np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) / 12
    np.testing.assert_allclose(found.inertia / found.volume, wanted, atol=1e-12)


def test_open_mesh_is_its_hull():
    mesh = opened(bottle())
    hull = mesh.convex_hull
    found = mass_properties(mesh.vertices, mesh.faces)
    assert not found.solid
    assert found.volume == pytest.approx(hull.volume, rel=1e-9)
    np.testing.assert_allclose(found.center, hull.center_mass, atol=1e-9)
    np.testing.assert_allclose(found.inertia, hull.moment_inertia, atol=1e-9 * np.trace(hull.moment_inertia))


def test_faces_that_share_no_vertex_by_number_are_joined():
    mesh = trimesh.creation.box((0.04, 0.06, 0.08))
    apart = mass_properties(mesh.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    assert apart.solid
    assert apart.volume == pytest.approx(mesh.volume)


def test_two_cubes_that_share_an_edge_are_solid():
    """Four faces meet there: closed, though no manifold."""
    cubes = [trimesh.creation.box([0.02] * 3).apply_translation([d, d, 0.0]) for d in (0.0, 0.02)]
    mesh = joined(*cubes)
    assert not mesh.is_watertight
    found = mass_properties(mesh.vertices, mesh.faces)
    assert found.solid
    assert found.volume == pytest.approx(2 * 0.02**3)
    np.testing.assert_allclose(mass_centre(mesh), found.center, atol=1e-9)


def test_bodies_that_overlap_count_once():
    beam = trimesh.creation.box((0.04, 0.02, 0.02))
    block = trimesh.creation.box((0.02, 0.04, 0.03)).apply_translation([0.005, 0.012, 0.0])
    mesh = trimesh.util.concatenate([beam, block])
    found = mass_properties(mesh.vertices, mesh.faces)
    one, other, both = 1.6e-5, 2.4e-5, 0.02 * 0.018 * 0.02
    volume = one + other - both
    center = (other * np.array([0.005, 0.012, 0.0]) - both * np.array([0.005, 0.001, 0.0])) / volume
    assert found.solid
    assert found.volume == pytest.approx(volume, rel=1e-5)
    np.testing.assert_allclose(found.center, center, atol=1e-7)
    np.testing.assert_allclose(
        found.inertia, trimesh.boolean.union([beam, block]).moment_inertia, rtol=1e-4, atol=1e-15
    )
    np.testing.assert_allclose(mass_centre(mesh), center, atol=1e-4)


def test_what_fills_a_cavity_counts():
    """Ice in a shell: their boxes overlap, they do not."""
    shell, cavity, ice = (trimesh.creation.icosphere(subdivisions=3, radius=r) for r in (0.04, 0.03, 0.02))
    cavity.invert()
    mesh = trimesh.util.concatenate([shell, cavity, ice.apply_translation([0.005, 0.0, 0.0])])
    found = mass_properties(mesh.vertices, mesh.faces)
    assert found.volume == pytest.approx(mesh.volume)
    np.testing.assert_allclose(found.center, mesh.center_mass, atol=1e-9)
    np.testing.assert_allclose(mass_centre(mesh), mesh.center_mass, atol=1e-9)


def test_flat_is_refused():
    with pytest.raises(ObjectError, match="flat"):
        mass_properties(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), np.array([[0, 1, 2]]))


@pytest.mark.parametrize("mesh", [bottle(), opened(bottle())], ids=["closed", "open"])
def test_all_who_weigh_an_object_agree(mesh, fast):
    """Generator, hold test, simulators, metrics and judge: one centre of mass and one inertia."""
    model = preprocess_object(mesh, params=fast)
    center = model.com + model.center
    record = mesh_record("bottle", trimesh.Trimesh(model.vertices, model.faces, process=False))
    solid = object_of_record(record, no_cut)
    np.testing.assert_allclose(solid.center, center, atol=1e-6)
    np.testing.assert_allclose(mass_frame(record)[0], center, atol=1e-6)
    np.testing.assert_allclose(mass_centre(clean_mesh(record.vertices, record.faces)), center, atol=1e-6)
    course = course_of(model, "cpu")
    np.testing.assert_allclose(np.asarray(course.com) + model.center, center, atol=1e-6)
    over_mass = solid.inertia / solid.volume
    np.testing.assert_allclose(np.asarray(course.inertia).reshape(3, 3), over_mass, atol=1e-5 * np.trace(over_mass))
