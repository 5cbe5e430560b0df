"""Which way the faces of a mesh are wound: a closed body outward, a cavity in it inward."""

import numpy as np
import trimesh

from lgrasp.geometry.edges import bodies, open_edges, winding_number
from lgrasp.geometry.quiet import quiet_parsers


def outward(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> np.ndarray:
    """Faces wound consistently and outward, body by body; cavities stay inward.

    Args:
        vertices: shape (v, 3).
        faces: shape (f, 3).
        notes: gets what was turned, one sentence each.
    """
    if len(open_edges(faces)):
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        if not mesh.is_winding_consistent:
            with quiet_parsers():
                trimesh.repair.fix_winding(mesh)
            turned = int((mesh.faces != faces).any(axis=1).sum())
            if turned:
                notes.append(f"turned {turned} faces to a consistent winding")
            faces = np.asarray(mesh.faces, np.int64)
    body = bodies(faces)
    count = int(body.max()) + 1
    corners = vertices[faces] - vertices.mean(axis=0)
    volume = np.bincount(body, np.linalg.det(corners) / 6.0, count)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, body, corners.min(axis=1))
    np.maximum.at(high, body, corners.max(axis=1))
    flip = volume < -1e-9 * np.ptp(vertices, axis=0).max() ** 3
    outermost = np.arange(count)
    for k in range(count if flip.any() else 0):  # a body in another is turned as that is
        about = np.flatnonzero(((low < low[k]) & (high > high[k])).all(axis=1))
        point = corners[np.argmax(body == k), 0]
        within = [o for o in about if abs(winding_number(corners[body == o], point)) > 0.5]
        outermost[k] = max(within, key=lambda o: abs(volume[o]), default=k)
    flip = flip[outermost]
    if flip.any():
        notes.append(f"turned {int(flip.sum())} of {count} bodies that were inside out")
        faces = np.where(flip[body][:, None], faces[:, ::-1], faces)
    return faces
