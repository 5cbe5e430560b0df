import h5py
import numpy as np
import pytest

from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.structure import expand, members
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ShardError
from lgrasp.grasp.schema import ATTRIBUTES, DATASETS


@pytest.fixture
def path(tmp_path, make_shard):
    write_shard(tmp_path / "s.h5", make_shard(40, objects=2, columns=2))
    return tmp_path / "s.h5"


def edit(path, change):
    with h5py.File(path, "r+") as file:
        file.attrs.pop("text_sha256")
        change(file)


def put(dataset, where, value):
    def change(file):
        values = file[dataset][()]
        values[where] = value
        file[dataset][...] = values

    return change


def first_contact(file):
    return tuple(np.argwhere(file["grasps/contact_links"][()] >= 0)[0])


def break_normal(file):
    put("grasps/contact_normals", first_contact(file), [0, 0, 2])(file)


def break_force(file):
    where = first_contact(file)
    put("grasps/contact_forces", where, 9.0 * file["grasps/contact_forces"][where])(file)


def break_padding(file):
    where = tuple(np.argwhere(file["grasps/contact_links"][()] < 0)[0])
    put("grasps/contact_points", where, 0.0)(file)


def flip_quaternion(file):
    put("grasps/object_pose", (0, 0), file["grasps/object_pose"][0, 0] * [1, 1, 1, -1, -1, -1, -1])(file)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (put("grasps/q", (3, 1), np.nan), "grasps/q: not finite (row 3, 1 rows)"),
        (put("grasps/q_squeeze", (3, 1), np.inf), "grasps/q_squeeze: not finite"),
        (put("grasps/q", (7, 0), 2.001), "grasps/q: outside the joint limits by more than 1e-4 (row 7"),
        (put("grasps/object_pose", (0, 0, 3), 1.7), "quaternion is not of unit length"),
        (flip_quaternion, "quaternion has w < 0"),
        (put("grasps/object_index", (0, 0), 2), "object_index: must be -1 to 1"),
        (put("grasps/object_index", (0, 0), -1), "object_pose: NaN if and only if absent"),
        (put("grasps/object_index", 0, -1), "no object is present"),
        (put("grasps/contact_links", (0, 0, 0), 3), "contact_links: must be -1 to 2"),
        (break_normal, "contact_normals: not of unit length"),
        (break_force, "do not sum to 1"),
        (break_padding, "contact_points: NaN if and only if contact_links is -1"),
        (put("objects/cup/faces", (0, 0), 4), "objects/cup/faces: index 4, there are 4 vertices"),
        (put("objects/cup/vertices", (0, 0), np.nan), "objects/cup/vertices: not finite"),
        (put("hand/joint_lower", 1, 5.0), "hand: joint 'joint_1' has limits [5.0, 2.0]"),
        (lambda f: f.attrs.modify("object_sha256", "b" * 64), "object_sha256 does not belong"),
        (lambda f: f.attrs.modify("created", "yesterday"), "must be an ISO 8601 time"),
        (lambda f: f.attrs.modify("config", "{"), "must be a JSON document"),
        (lambda f: f.attrs.create("seed", "one"), "must be an integer"),
        (lambda f: f.attrs.modify("complete", 0), "incomplete"),
        (lambda f: f.pop("objects") and f.create_group("objects"), "objects: no object"),
        (lambda f: f.pop("statistics"), "statistics: missing group"),
        (lambda f: f.move("grasps/q", "grasps/p"), "grasps/q: missing dataset"),
    ],
)
def test_each_violation_is_named(path, change, problem):
    edit(path, change)
    problems = validate_shard(path)
    assert any(problem in line for line in problems), problems
    assert all("\n" not in line and str(path) not in line for line in problems)


@pytest.mark.parametrize("spec", [s for s in DATASETS if "*" not in s.path], ids=lambda s: s.path)
def test_wrong_dtype_and_shape_of_every_dataset(path, spec):
    def replace_dataset(data):
        def change(file):
            del file[spec.path]
            file[spec.path] = data

        return change

    edit(path, replace_dataset(np.zeros((1,) * len(spec.shape), dtype="c8")))
    assert any(line.startswith(f"{spec.path}: dtype is complex64, must be") for line in validate_shard(path))
    data = np.zeros((3,) * (len(spec.shape) + 1), dtype="S4" if spec.dtype == "text" else spec.dtype)
    edit_again = replace_dataset(data)
    with h5py.File(path, "r+") as file:
        edit_again(file)
    assert any(line.startswith(f"{spec.path}: shape is") for line in validate_shard(path))
    with pytest.raises(ShardError, match=spec.path):
        read_shard(path)


@pytest.mark.parametrize("spec", [a for a in ATTRIBUTES if a.required], ids=lambda a: f"{a.path}@{a.name}")
def test_every_required_attribute_is_required(path, spec):
    edit(path, lambda file: file[expand(members(file), spec.path)[0] or "/"].attrs.pop(spec.name))
    assert any(spec.name in line for line in validate_shard(path))


def test_changed_text_is_noticed(path):
    with h5py.File(path, "r+") as file:
        file["hand/urdf"][()] = file["hand/urdf"].asstr()[()].replace("toy", "boy")
    assert validate_shard(path) == ["/: attributes or texts were changed after writing (text_sha256 differs)"]
