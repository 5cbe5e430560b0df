"""Which pieces of a hand must stay apart: all of non-adjacent links, save pairs that touch in every posture."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import trimesh
import warp as wp

from lgrasp.geometry.poses import device_matrix
from lgrasp.hand.arrays import body_poses, upload_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.overlap import OverlapSide, overlap_arrays, overlap_depth, overlap_sides
from lgrasp.hand.self_collision import OVERLAP
from lgrasp.math.convex import Pieces, pieces_clear
from lgrasp.runtime.device import KERNEL_OPTIONS, start
from lgrasp.runtime.fetch import to_numpy

wp.set_module_options(KERNEL_OPTIONS)

ALMOST_ALWAYS = 0.95
"""Links that touch in a larger share of all postures are left to touch."""
PAIR_POSTURES = 256
"""Random postures that tell which links touch."""
_CONFIRMING_POSTURES = 2000  # postures in which a pair must touch to count as touching always
_UNUSABLE_SHARE = 0.98  # of all postures
_GRID_ERROR = 5.0e-5  # [m] that distance grids may err


@wp.kernel
def mark_touching(
    pieces: Pieces,
    pose: wp.array2d(dtype=wp.transform),
    pairs: wp.array(dtype=wp.vec2i),
    margin: wp.float32,
    # out
    touch_out: wp.array2d(dtype=wp.int32),
):
    """Pairs of pieces that are within ``margin`` [m] of each other; launched over (posture, pair).

    Args:
        pose: T_base_body, (N, B).
        pairs: two pieces each, (Q,).
        touch_out: set to 1 where they are, (N, Q).
    """
    row, k = wp.tid()
    i = pairs[k][0]
    j = pairs[k][1]
    T = wp.transform_inverse(pose[row, pieces.body[i]]) * pose[row, pieces.body[j]]
    if not pieces_clear(pieces, i, j, T, margin):
        touch_out[row, k] = 1


def pieces_touch(model: HandModel, q: np.ndarray, pairs: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """(N, Q) bool: are piece pairs (Q, 2) within ``margin`` [m] of each other at postures q (N, K)?"""
    hand = upload_hand(model, "cpu")
    return placed_pieces_touch(hand.struct.pieces, body_poses(hand, q), pairs, margin)


def placed_pieces_touch(pieces: Pieces, pose: np.ndarray, pairs: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """As :func:`pieces_touch`, of pieces on the CPU, with their bodies at device poses (N, B, 7)."""
    start()
    out = wp.zeros((len(pose), len(pairs)), dtype=wp.int32, device="cpu")
    inputs = [
        pieces,
        wp.array(pose, dtype=wp.transform, device="cpu"),
        wp.array(np.asarray(pairs, np.int32), dtype=wp.vec2i, device="cpu"),
        float(margin),
    ]
    wp.launch(mark_touching, dim=out.shape, inputs=inputs, outputs=[out], device="cpu")
    return to_numpy(out).astype(bool)


def separate_pairs(
    body: np.ndarray, link: np.ndarray, names: Sequence[str], joined: Iterable[tuple[str, str]]
) -> np.ndarray:
    """Piece pairs (Q, 2), i32, of different bodies and of links that no joint joins.

    Args:
        body, link: of each piece, (P,).
        names: of links.
        joined: two links each.
    """
    near = np.zeros((len(names), len(names)), bool)
    for a, b in joined:
        near[names.index(a), names.index(b)] = near[names.index(b), names.index(a)] = True
    i, j = np.triu_indices(len(body), 1)
    free = (body[i] != body[j]) & ~near[link[i], link[j]]
    return np.column_stack([i, j])[free].astype(np.int32)


def with_pairs(
    model: HandModel,
    adjacent: set[tuple[str, str]],
    meshes: Mapping[str, Sequence[trimesh.Trimesh]],
    dented: set[str],
) -> HandModel:
    """The model with its self-collision pairs, grouped by (group a, group b).

    Link pairs that touch in every posture are left out. Where a link is dented its pieces do not tell: pairs of which
    the pieces touch in nearly every posture are then decided, and tested ever after, on the true surfaces.

    Args:
        adjacent: (parent link, child link) of every joint of the URDF.
        meshes: solids of each link, body frame.
        dented: links with bodies that differ much from their hulls.
    """
    names, group = model.tree.link_names, model.tree.body_group + 1
    pairs = separate_pairs(model.piece_body, model.piece_link, names, adjacent)
    if not len(pairs):
        return model
    swapped = group[model.piece_body[pairs[:, 0]]] > group[model.piece_body[pairs[:, 1]]]
    pairs[swapped] = pairs[swapped, ::-1]
    q = model.random_postures(PAIR_POSTURES, 1)
    touch = pieces_touch(model, q, pairs)
    # links, not pieces, are what touches: a link pair is left out when some pieces of it touch in every posture
    links = np.sort(model.piece_link[pairs], axis=1)
    keep = np.ones(len(pairs), bool)
    notes, sides, keys = list(model.notes), [], []
    groups = model.groups + 1
    for pair in np.unique(links, axis=0):
        members = (links == pair).all(1)
        share = touch[:, members].any(1).mean()
        a, b = (names[k] for k in pair)
        if share > ALMOST_ALWAYS and (a in dented or b in dented):
            keep[members] = False
            found, note = _true_overlap(model, (a, b), meshes, q)
            sides += found
            body_a, body_b = sorted(int(group[model.tree.link_body[k]]) for k in pair)
            keys += [body_a * groups + body_b] * len(found)
            notes += [note] if note else []
        elif (
            share == 1.0
            and pieces_touch(model, model.random_postures(_CONFIRMING_POSTURES, 1), pairs[members]).any(1).all()
        ):
            keep[members] = False
    pairs = pairs[keep]
    key = group[model.piece_body[pairs[:, 0]]] * groups + group[model.piece_body[pairs[:, 1]]]
    order = np.argsort(key, kind="stable")
    first = np.searchsorted(key[order], np.arange(groups**2 + 1)).astype(np.int32)
    overlaps = overlap_arrays(sides, keys, groups**2)
    return replace(model, pair_first=first, pairs=np.ascontiguousarray(pairs[order]), notes=tuple(notes), **overlaps)


def _true_overlap(
    model: HandModel, pair: tuple[str, str], meshes: Mapping[str, Sequence[trimesh.Trimesh]], q: np.ndarray
) -> tuple[list[OverlapSide], str]:
    """Both sides of a link pair's test on the true surfaces, none when it is pointless, and what to tell the user."""
    bodies = (model.tree.body_of(pair[0]), model.tree.body_of(pair[1]))
    hand = upload_hand(model, "cpu")

    def placed(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        poses = body_poses(hand, q).astype(float)
        return device_matrix(poses[:, bodies[0]]), device_matrix(poses[:, bodies[1]])

    sides = overlap_sides(bodies, (meshes[pair[0]], meshes[pair[1]]), placed(q))
    if not sides:
        return [], ""
    depth = np.max([side.depth for side in sides], 0)
    note = f"links '{pair[0]}' and '{pair[1]}' overlap"
    if (depth > _GRID_ERROR).all():
        depth = overlap_depth(sides, bodies, placed(model.random_postures(_CONFIRMING_POSTURES, 1)))
        # a pair that comes apart in a few odd postures only could never be used if it were kept apart
        if (depth > _GRID_ERROR).all() or (depth > OVERLAP).mean() > _UNUSABLE_SHARE:
            return [], f"{note} in every posture; they are not kept apart"
    share = (depth > OVERLAP).mean()
    return sides, f"{note} by more than {1e3 * OVERLAP:.2g} mm in {100 * share:.0f} % of all postures" if share else ""
