"""A HandModel on a device, as Warp structs; forward kinematics and Jacobians of whole postures."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.geometry.poses import device_from_matrix
from lgrasp.hand.model import HandModel
from lgrasp.math.convex import Pieces
from lgrasp.math.kinematics import MAX_JOINTS, Kinematics, group_forward, point_column, vec_dof
from lgrasp.math.sdf import sdf_part
from lgrasp.runtime.device import KERNEL_OPTIONS, start

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Contacts:
    """Contact surfaces of a HandModel (same names, same meaning)."""

    first: wp.array(dtype=wp.int32)
    points: wp.array(dtype=wp.vec3)
    normals: wp.array(dtype=wp.vec3)
    body: wp.array(dtype=wp.int32)
    link: wp.array(dtype=wp.int32)
    grid: wp.array(dtype=wp.int32)
    grid_first: wp.array(dtype=wp.int32)
    grid_shape: wp.array(dtype=wp.vec3i)
    grid_origin: wp.array(dtype=wp.vec3)
    grid_inv_cell: wp.array(dtype=wp.float32)
    grid_values: wp.array(dtype=wp.float32)
    grid_link: wp.array(dtype=wp.int32)
    rule_first: wp.array(dtype=wp.int32)
    rules: wp.array(dtype=wp.vec4)
    mesh: wp.array(dtype=wp.uint64)


@wp.struct
class Overlaps:
    """Link pairs tested on their true surfaces (names of a HandModel without ``overlap_``)."""

    first: wp.array(dtype=wp.int32)
    sides: wp.array(dtype=wp.vec4i)
    points: wp.array(dtype=wp.vec3)
    grid_first: wp.array(dtype=wp.int32)
    grid_shape: wp.array(dtype=wp.vec3i)
    grid_origin: wp.array(dtype=wp.vec3)
    grid_inv_cell: wp.array(dtype=wp.float32)
    grid_values: wp.array(dtype=wp.float32)


@wp.struct
class Hand:
    """All of a hand that kernels read."""

    kin: Kinematics
    pieces: Pieces
    contacts: Contacts
    sphere_first: wp.array(dtype=wp.int32)
    spheres: wp.array(dtype=wp.vec4)
    cluster_first: wp.array(dtype=wp.int32)
    cluster_sphere: wp.array(dtype=wp.vec4)
    samples: wp.array(dtype=wp.vec3)
    body_group: wp.array(dtype=wp.int32)  # group of each body, -1 for the base
    piece_grid: wp.array(dtype=wp.int32)  # distance grid of the piece's link, -1 when it is no contact link
    pair_first: wp.array(dtype=wp.int32)
    pairs: wp.array(dtype=wp.vec2i)
    overlaps: Overlaps
    box_low: wp.vec3
    box_high: wp.vec3


@dataclass(frozen=True)
class HandArrays:
    """A HandModel and its copy on one device; keeps the device meshes alive."""

    model: HandModel
    device: str
    struct: "Hand"
    meshes: tuple[wp.Mesh, ...]


def upload_hand(model: HandModel, device: str) -> HandArrays:
    """Copy a hand to a device."""
    start()

    def put(a: np.ndarray, dtype) -> wp.array:
        return wp.array(np.ascontiguousarray(a), dtype=dtype, device=device)

    t = model.tree
    kin = Kinematics()
    kin.groups = t.groups
    kin.joint_first = put(t.joint_first, wp.int32)
    kin.dof_first = put(t.dof_first, wp.int32)
    kin.joint_parent = put(t.joint_parent, wp.int32)
    kin.joint_dof = put(t.joint_dof, wp.int32)
    kin.joint_mult = put(t.joint_mult, wp.float32)
    kin.joint_offset = put(t.joint_offset, wp.float32)
    kin.joint_axis = put(t.joint_axis, wp.vec3)
    kin.joint_prismatic = put(t.joint_prismatic, wp.int32)
    kin.joint_origin = put(device_from_matrix(t.T_parent_joint), wp.transform)
    kin.dof_lower = put(t.joint_lower[t.dof_index], wp.float32)
    kin.dof_upper = put(t.joint_upper[t.dof_index], wp.float32)
    kin.dof_index = put(t.dof_index, wp.int32)
    kin.dof_free = put(t.dof_free, wp.int32)
    kin.settings = len(t.settings)
    kin.dof_setting = put(t.settings[:, t.dof_index], wp.float32)
    pieces = Pieces()
    pieces.body_first = put(model.piece_first, wp.int32)
    pieces.body_sphere = put(model.body_sphere, wp.vec4)
    pieces.vertex_first = put(model.vertex_first, wp.int32)
    pieces.vertices = put(model.vertices, wp.vec3)
    pieces.plane_first = put(model.plane_first, wp.int32)
    pieces.planes = put(model.planes, wp.vec4)
    pieces.sphere = put(model.piece_sphere, wp.vec4)
    pieces.radius = put(model.piece_radius, wp.float32)
    pieces.body = put(model.piece_body, wp.int32)
    contacts = Contacts()
    contacts.first = put(model.contact_first, wp.int32)
    contacts.points = put(model.contact_points, wp.vec3)
    contacts.normals = put(model.contact_normals, wp.vec3)
    contacts.body = put(model.contact_body, wp.int32)
    contacts.link = put(model.contact_link, wp.int32)
    contacts.grid = put(model.contact_grid, wp.int32)
    contacts.grid_first = put(model.grid_first, wp.int32)
    contacts.grid_shape = put(model.grid_shape, wp.vec3i)
    contacts.grid_origin = put(model.grid_origin, wp.vec3)
    contacts.grid_inv_cell = put(1.0 / model.grid_cell, wp.float32)
    contacts.grid_values = put(model.grid_values, wp.float32)
    contacts.grid_link = put(model.grid_link, wp.int32)
    contacts.rule_first = put(model.rule_first, wp.int32)
    contacts.rules = put(model.rules, wp.vec4)
    meshes = []
    for i in range(len(model.grid_link)):
        v = model.mesh_vertices[model.mesh_vertex_first[i] : model.mesh_vertex_first[i + 1]]
        f = model.mesh_faces[model.mesh_face_first[i] : model.mesh_face_first[i + 1]]
        meshes.append(wp.Mesh(put(v, wp.vec3), put(f.ravel(), wp.int32)))
    contacts.mesh = put(np.array([m.id for m in meshes], np.uint64), wp.uint64)
    hand = Hand()
    hand.kin = kin
    hand.pieces = pieces
    hand.contacts = contacts
    hand.sphere_first = put(model.sphere_first, wp.int32)
    hand.spheres = put(model.spheres, wp.vec4)
    hand.cluster_first = put(model.cluster_first, wp.int32)
    hand.cluster_sphere = put(model.cluster_sphere, wp.vec4)
    hand.samples = put(model.samples, wp.vec3)
    hand.body_group = put(t.body_group, wp.int32)
    grid_of = {int(link): i for i, link in enumerate(model.grid_link)}
    hand.piece_grid = put(np.array([grid_of.get(int(link), -1) for link in model.piece_link], np.int32), wp.int32)
    hand.pair_first = put(model.pair_first, wp.int32)
    hand.pairs = put(model.pairs, wp.vec2i)
    overlaps = Overlaps()
    overlaps.first = put(model.overlap_first, wp.int32)
    overlaps.sides = put(model.overlap_sides, wp.vec4i)
    overlaps.points = put(model.overlap_points, wp.vec3)
    overlaps.grid_first = put(model.overlap_grid_first, wp.int32)
    overlaps.grid_shape = put(model.overlap_grid_shape, wp.vec3i)
    overlaps.grid_origin = put(model.overlap_grid_origin, wp.vec3)
    overlaps.grid_inv_cell = put(1.0 / model.overlap_grid_cell, wp.float32)
    overlaps.grid_values = put(model.overlap_grid_values, wp.float32)
    hand.overlaps = overlaps
    hand.box_low = wp.vec3(*map(float, model.canonical_box[0]))
    hand.box_high = wp.vec3(*map(float, model.canonical_box[1]))
    return HandArrays(model, device, hand, tuple(meshes))


@wp.func
def hand_grid(c: Contacts, i: wp.int32):
    """Distance grid of contact link i."""
    return sdf_part(c.grid_values, c.grid_first[i], c.grid_shape[i], c.grid_origin[i], c.grid_inv_cell[i])


@wp.func
def overlap_grid(c: Overlaps, i: wp.int32):
    """Distance grid of side i."""
    return sdf_part(c.grid_values, c.grid_first[i], c.grid_shape[i], c.grid_origin[i], c.grid_inv_cell[i])


@wp.func
def group_dofs(h: Kinematics, g: wp.int32, q: wp.array2d(dtype=wp.float32), row: wp.int32):
    """The group's part of row ``row`` of q (N, K)."""
    v = vec_dof()
    first = h.dof_first[g]
    for d in range(h.dof_first[g + 1] - first):
        v[d] = q[row, h.dof_index[first + d]]
    return v


@wp.kernel
def _body_poses(h: Kinematics, q: wp.array2d(dtype=wp.float32), pose_out: wp.array2d(dtype=wp.transform)):
    row = wp.tid()
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    pose_out[row, 0] = wp.transform_identity()
    for g in range(h.groups):
        first = group_forward(h, g, group_dofs(h, g, q, row), X, 0)
        for j in range(h.joint_first[g + 1] - first):
            pose_out[row, 1 + first + j] = X[j]


@wp.kernel
def _point_jacobians(
    h: Kinematics,
    pose: wp.array2d(dtype=wp.transform),
    body_group: wp.array(dtype=wp.int32),
    body: wp.array(dtype=wp.int32),
    point: wp.array(dtype=wp.vec3),
    jacobian_out: wp.array3d(dtype=wp.float32),
):
    row = wp.tid()
    b = body[row]
    g = body_group[b]
    if g < 0:
        return
    p = wp.transform_point(pose[row, b], point[row])
    first = h.joint_first[g]
    j = b - 1 - first
    while j >= 0:
        k = first + j
        v = point_column(h, k, pose[row, 1 + k], p)
        column = h.dof_index[h.dof_first[g] + h.joint_dof[k]]
        for a in range(3):
            jacobian_out[row, a, column] = jacobian_out[row, a, column] + v[a]
        j = h.joint_parent[k]


def body_poses(hand: HandArrays, q: np.ndarray) -> np.ndarray:
    """T_base_body of every body as device poses (N, B, 7) for postures q (N, K)."""
    q = np.ascontiguousarray(q, np.float32)
    bodies = len(hand.model.tree.joint_dof) + 1
    out = wp.empty((len(q), bodies), dtype=wp.transform, device=hand.device)
    queries = wp.array(q, dtype=wp.float32, device=hand.device)
    wp.launch(_body_poses, dim=len(q), inputs=[hand.struct.kin, queries], outputs=[out], device=hand.device)
    return out.numpy().reshape(len(q), bodies, 7)


def point_jacobians(hand: HandArrays, q: np.ndarray, body: np.ndarray, point: np.ndarray) -> np.ndarray:
    """d(base position)/dq, (N, 3, K) [m/rad or m/m], of a body-frame point (N, 3) on body (N,) at postures q (N, K)."""
    poses = wp.array(body_poses(hand, q), dtype=wp.transform, device=hand.device)
    out = wp.zeros((len(q), 3, hand.model.dofs), dtype=wp.float32, device=hand.device)
    inputs = [
        hand.struct.kin,
        poses,
        wp.array(hand.model.tree.body_group, dtype=wp.int32, device=hand.device),
        wp.array(np.asarray(body, np.int32), dtype=wp.int32, device=hand.device),
        wp.array(np.ascontiguousarray(point, np.float32), dtype=wp.vec3, device=hand.device),
    ]
    wp.launch(_point_jacobians, dim=len(q), inputs=inputs, outputs=[out], device=hand.device)
    return out.numpy()
