"""A HandModel on a device, as Warp structs; forward kinematics of whole postures."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from lgrasp.errors import HandError
from lgrasp.geometry.poses import device_from_matrix
from lgrasp.hand.model import HandModel, piece_arrays
from lgrasp.hand.params import ThumbBend
from lgrasp.hand.piece import Piece
from lgrasp.math.convex import Pieces
from lgrasp.math.kinematics import Kinematics, group_dofs, group_forward
from lgrasp.math.limits import MAX_JOINTS
from lgrasp.math.sdf import Grids
from lgrasp.runtime.device import KERNEL_OPTIONS, start
from lgrasp.runtime.fetch import to_numpy
from lgrasp.runtime.structs import on_device, upload_struct

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Contacts:
    """Contact surfaces of a HandModel (same names, same meaning)."""

    first: wp.array(dtype=wp.int32)  # (W (G + 1) + 1,), see contact_run
    points: wp.array(dtype=wp.vec3)  # (C,)
    normals: wp.array(dtype=wp.vec3)  # (C,)
    body: wp.array(dtype=wp.int32)  # (C,)
    link: wp.array(dtype=wp.int32)  # (C,)
    grid: wp.array(dtype=wp.int32)  # (C,)
    grids: Grids  # L of them, of contact links
    grid_link: wp.array(dtype=wp.int32)  # (L,)
    rule_first: wp.array(dtype=wp.int32)  # (L + 1,)
    rules: wp.array(dtype=wp.vec4)  # (R,)
    mesh: wp.array(dtype=wp.uint64)  # (L,)


@wp.struct
class Overlaps:
    """Link pairs tested on their true surfaces (names of a HandModel without ``overlap_``)."""

    first: wp.array(dtype=wp.int32)  # ((G + 1)^2 + 1,)
    sides: wp.array(dtype=wp.vec4i)  # (S,)
    points: wp.array(dtype=wp.vec3)  # (P,) [m]
    grids: Grids  # S of them


@wp.struct
class Bend:
    """Where the thumb has to be (:class:`~lgrasp.hand.params.ThumbBend`)."""

    body: wp.int32  # that the hinge moves; 0: the thumb may be anywhere
    axis: wp.vec3  # unit vector of the hinge, body frame
    normal: wp.vec3  # unit normal of the palm's plane, base frame
    least: wp.float32  # cosine between both lines
    most: wp.float32


@wp.struct
class Hand:
    """All of a hand that kernels read."""

    kin: Kinematics
    pieces: Pieces
    contacts: Contacts
    sphere_first: wp.array(dtype=wp.int32)  # (B + 1,)
    spheres: wp.array(dtype=wp.vec4)  # (S,)
    cluster_first: wp.array(dtype=wp.int32)  # (B + 1,)
    cluster_sphere: wp.array(dtype=wp.vec4)  # (C,)
    samples: wp.array(dtype=wp.vec3)  # (C * CLUSTER_SIZE,) [m]
    body_group: wp.array(dtype=wp.int32)  # (B,) group of each body, -1 for the base
    piece_grid: wp.array(dtype=wp.int32)  # (P,) distance grid of the piece's link, -1 when it is no contact link
    pair_first: wp.array(dtype=wp.int32)  # ((G + 1)^2 + 1,)
    pairs: wp.array(dtype=wp.vec2i)  # (Q,)
    overlaps: Overlaps
    thumb: Bend
    box_low: wp.vec3
    box_high: wp.vec3


@dataclass(frozen=True)
class HandArrays:
    """A HandModel and its copy on one device; keeps the device meshes alive."""

    model: HandModel
    device: str
    struct: "Hand"
    meshes: tuple[wp.Mesh, ...]


def upload_hand(model: HandModel, device: str, thumb: ThumbBend | None = None) -> HandArrays:
    """Copy a hand to a device.

    Args:
        thumb: where its thumb has to be; None: anywhere.

    Raises:
        HandError: that thumb is of another hand.
    """
    start()
    t = model.tree
    kin = _named(Kinematics, t) | {
        "joint_origin": device_from_matrix(t.T_parent_joint),
        "dof_lower": t.joint_lower[t.dof_index],
        "dof_upper": t.joint_upper[t.dof_index],
        "column_lower": t.joint_lower,
        "column_upper": t.joint_upper,
        "column_effort": t.joint_effort,
        "shared": len(t.shared_names),
        "settings": len(t.settings),
        "dof_setting": np.tile(t.settings[:, t.dof_index], (model.surfaces, 1)),
    }
    meshes = _link_meshes(model, device)
    contacts = _named(Contacts, model, "contact_") | {
        "grids": upload_struct(Grids, device, _named(Grids, model, "grid_") | {"inv_cell": 1.0 / model.grid_cell}),
        "mesh": np.array([m.id for m in meshes], np.uint64),
    }
    grids = _named(Grids, model, "overlap_grid_") | {"inv_cell": 1.0 / model.overlap_grid_cell}
    overlaps = _named(Overlaps, model, "overlap_") | {"grids": upload_struct(Grids, device, grids)}
    pieces = _named(Pieces, model, "piece_") | {"body_first": model.piece_first}
    grid_of = {int(link): i for i, link in enumerate(model.grid_link)}
    hand = _named(Hand, model) | {
        "kin": upload_struct(Kinematics, device, kin),
        "pieces": upload_struct(Pieces, device, pieces),
        "contacts": upload_struct(Contacts, device, contacts),
        "body_group": t.body_group,
        "piece_grid": np.array([grid_of.get(int(link), -1) for link in model.piece_link], np.int32),
        "overlaps": upload_struct(Overlaps, device, overlaps),
        "thumb": upload_struct(Bend, device, _bend(model, thumb) if thumb else {}),
        "box_low": model.canonical_box[0],
        "box_high": model.canonical_box[1],
    }
    return HandArrays(model, device, upload_struct(Hand, device, hand), meshes)


def upload_pieces(pieces: Sequence[Piece], body: np.ndarray, device: str) -> Pieces:
    """Convex pieces, each in the frame of its ``body``, (P,); nothing is known of the bodies."""
    named = {name.removeprefix("piece_"): values for name, values in piece_arrays(pieces).items()}
    return upload_struct(Pieces, device, named | {"body": np.asarray(body, np.int32)})


def _named(kind: Any, source: object, prefix: str = "") -> dict[str, Any]:
    """What a model calls like the fields of a struct, with a prefix or without."""
    at = {name: next((n for n in (prefix + name, name) if hasattr(source, n)), None) for name in kind.vars}
    return {name: getattr(source, n) for name, n in at.items() if n}


def _bend(model: HandModel, thumb: ThumbBend) -> dict[str, Any]:
    if thumb.link not in model.tree.link_names:
        raise HandError(f"hand.thumb: hand '{model.name}' has no link '{thumb.link}'")
    k, cosine = model.tree.link_names.index(thumb.link), float(np.cos(np.radians(thumb.angle)))
    axis, normal = model.tree.T_body_link[k, :3, :3] @ thumb.axis, np.array(thumb.normal)
    return {
        "body": int(model.tree.link_body[k]),
        "axis": axis / np.linalg.norm(axis),
        "normal": normal / np.linalg.norm(normal),
        "least": cosine if thumb.place == "adducted" else 0.0,
        "most": 2.0 if thumb.place == "adducted" else cosine,
    }


def _link_meshes(model: HandModel, device: str) -> tuple[wp.Mesh, ...]:
    """Triangle meshes of the contact links, body frames."""
    meshes = []
    for i in range(len(model.grid_link)):
        v = model.mesh_vertices[model.mesh_vertex_first[i] : model.mesh_vertex_first[i + 1]]
        f = model.mesh_faces[model.mesh_face_first[i] : model.mesh_face_first[i + 1]]
        points = wp.array(np.ascontiguousarray(v), dtype=wp.vec3, device=device)
        meshes.append(wp.Mesh(points, wp.array(np.ascontiguousarray(f.ravel()), dtype=wp.int32, device=device)))
    return tuple(meshes)


@wp.func
def contact_run(hand: Hand, setting: wp.int32, side: wp.int32):
    """Entry of ``contacts.first`` of a group (-1: static links): the contact surface is that of the setting."""
    surface = setting // hand.kin.settings
    return surface * (hand.kin.groups + 1) + wp.where(side < 0, hand.kin.groups, side)


@wp.func
def contact_allowed(c: Contacts, i: wp.int32, normal: wp.vec3):
    """True if the rules of contact link i let it touch where its outward normal is this."""
    for r in range(c.rule_first[i], c.rule_first[i + 1]):
        f = c.rules[r]
        if f[0] * normal[0] + f[1] * normal[1] + f[2] * normal[2] > f[3]:
            return False
    return True


@wp.func
def thumb_placed(hand: Hand, g: wp.int32, X: wp.array(dtype=wp.transform), at: wp.int32):
    """True unless group g is the thumb and is not where it has to be; X holds the bodies of g, from ``at`` on."""
    bend = hand.thumb
    if hand.body_group[bend.body] != g:
        return True
    axis = wp.transform_vector(X[at + bend.body - 1 - hand.kin.joint_first[g]], bend.axis)
    cosine = wp.abs(wp.dot(axis, bend.normal))
    return cosine >= bend.least and cosine <= bend.most


@wp.kernel
def place_bodies(
    h: Kinematics,
    pose: wp.array(dtype=wp.transform),
    q: wp.array2d(dtype=wp.float32),
    # out
    body_out: wp.array2d(dtype=wp.transform),
):
    """Bodies of hands in some frame; launched over hands.

    Args:
        pose: T_frame_base, (N,); or (0,): the frame is that of the base.
        q: [rad or m], (N, K).
        body_out: T_frame_body, (N, B).
    """
    row = wp.tid()
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    T = wp.transform_identity()
    if pose.shape[0] > 0:
        T = pose[row]
    body_out[row, 0] = T
    for g in range(h.groups):
        first = group_forward(h, g, group_dofs(h, g, q, row), X, 0)
        for j in range(h.joint_first[g + 1] - first):
            if pose.shape[0] > 0:
                body_out[row, 1 + first + j] = T * X[j]
            else:
                body_out[row, 1 + first + j] = X[j]


def body_poses(hand: HandArrays, q: np.ndarray) -> np.ndarray:
    """T_base_body of every body as device poses (N, B, 7) for postures q (N, K)."""
    q = np.ascontiguousarray(q, np.float32)
    d, bodies = hand.device, len(hand.model.tree.joint_dof) + 1
    out = wp.empty((len(q), bodies), dtype=wp.transform, device=d)
    inputs = [hand.struct.kin, wp.empty(0, dtype=wp.transform, device=d), on_device(q, wp.float32, d)]
    wp.launch(place_bodies, dim=len(q), inputs=inputs, outputs=[out], device=d)
    return to_numpy(out).reshape(len(q), bodies, 7)
