from itertools import pairwise

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


def pull(file):
    """Two contacts, of which one pulls as much as the other presses too much."""
    forces, normals = file["grasps/contact_forces"][()], file["grasps/contact_normals"][()]
    row, slot = np.argwhere((file["grasps/contact_links"][()] >= 0).sum(2) == 2)[0]
    one, other = np.flatnonzero(file["grasps/contact_links"][row, slot] >= 0)
    forces[row, slot, [one, other]] = [[-1.2], [0.2]] * normals[row, slot, [one, other]]
    file["grasps/contact_forces"][...] = forces


def text(dataset, value):
    def change(file):
        del file[dataset]
        file[dataset] = value

    return change


def array(dataset, shape, dtype):
    return text(dataset, np.zeros(shape, dtype))


LINKS = [*("palm", "link_0", "link_1", "link_2"), "tip"]
URDF = "".join(
    f'<link name="{child}"/><joint name="joint_{k}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
    "</joint>"
    for k, (parent, child) in enumerate(pairwise(LINKS))
)
URDF = f'<robot name="toy"><link name="palm"/>{URDF}</robot>'
"""Of the hand of the shards."""
BOUNDS = '{"bounds": {"profile": "strict", "numbers": {"friction": "high"}}}'
MERGED = '[{"file": "a.h5", "shard_index": 0, "rows": 39}]'


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
        (lambda f: f["statistics"].create_dataset("a", data=1), "statistics/a: statistics are attributes"),
        (lambda f: f["statistics"].attrs.create("a", [1, 2]), "statistics: attribute a is neither a number nor"),
        (pull, "contact_forces: a force points out of the object"),
        (text("hand/urdf", np.bytes_("<robot/>")), "hand/urdf: dtype is |S8, must be text of variable length"),
        (text("hand/urdf", "<robot"), "URDF hand/urdf is not XML"),
        (text("hand/urdf", "<hand/>"), "URDF hand/urdf: root element is <hand>, expected <robot>"),
        (text("hand/urdf", '<!DOCTYPE robot [<!ENTITY a "b">]><robot/>'), "URDF hand/urdf declares a DOCTYPE"),
        (text("hand/urdf", URDF.replace("palm", "back")), "hand: attribute base_link: its URDF has no link 'palm'"),
        (text("hand/urdf", URDF.replace("link_1", "link_9")), "hand/link_names: its URDF has no link 'link_1'"),
        (text("hand/urdf", URDF.replace("joint_2", "j")), "hand/joint_names: its URDF has no movable joint 'joint_2'"),
        (text("hand/urdf", URDF.replace("revolute", "fixed")), "its URDF has no movable joint 'joint_0'"),
        (array("objects/cup/faces", (0, 3), "i4"), "objects/cup: neither faces, as of a mesh, nor normals, as of a"),
        (array("objects/cup/vertices", (0, 3), "f4"), "objects/cup/vertices: none"),
        (lambda f: f["objects/cup"].attrs.create("watertight", 2), "watertight is '2', must be true or false"),
        (lambda f: f.attrs.modify("shard_index", -5), "shard_index is -5, must be 0 or more, or -1 with merged_from"),
        (lambda f: f.attrs.modify("shard_index", -1), "shard_index is -1, must be 0 or more, or -1 with merged_from"),
        (lambda f: f.attrs.modify("config", "[1]"), "config is '[1]', must be a JSON object"),
        (lambda f: f.attrs.modify("config", '{"bounds": {}}'), "config: bounds is '{}', must hold a profile"),
        (lambda f: f.attrs.modify("config", BOUNDS), "must hold a profile (text) and numbers (by their names)"),
        (lambda f: f.attrs.create("merged_from", "{}"), "merged_from is '{}', must be a JSON list of file (text)"),
        (lambda f: f.attrs.create("merged_from", "[{}]"), "merged_from is '[{}]', must be a JSON list of file (text)"),
        (lambda f: f.attrs.create("merged_from", "[]"), "merged_from is '[]', must be a JSON list of file (text)"),
        (lambda f: f.attrs.create("merged_from", MERGED), "merged_from names 39 rows, the file has 40"),
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


def test_what_may_be_is_accepted(path):
    """A URDF with what lgrasp does not use, a config that tells no bounds, and a merged file."""

    def change(file):
        text("hand/urdf", URDF.replace("</robot>", '<gazebo/><joint name="f" type="floating"/></robot>'))(file)
        file.attrs.update(config="{}", shard_index=-1, merged_from=MERGED.replace("39", "40"))

    edit(path, change)
    assert validate_shard(path) == []


def test_changed_text_is_noticed(path):
    with h5py.File(path, "r+") as file:
        file["hand/urdf"][()] = file["hand/urdf"].asstr()[()].replace("toy", "boy")
    assert validate_shard(path) == [
        "/: attributes or texts were changed after writing (text_sha256 differs); "
        "delete that attribute if they are yours"
    ]
