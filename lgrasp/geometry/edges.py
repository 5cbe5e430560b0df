"""Faces of triangle meshes and their edges: normals, which edges are open, neighbours, points along creases."""

import numpy as np


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directed edges of faces, three each, (3 f, 2), and a number of each that does not depend on its direction."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    return edges, edges.min(axis=1) * (int(faces.max()) + 1) + edges.max(axis=1)


def open_edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges, shape (n, 2), that no opposite edge matches; empty for a closed, consistently wound mesh."""
    edges, key = _edges(faces)
    forward = edges[:, 0] < edges[:, 1]
    unique, group = np.unique(key, return_inverse=True)
    balance = np.bincount(group, weights=np.where(forward, 1.0, -1.0), minlength=len(unique))
    return edges[(balance[group] != 0.0) & ((balance[group] > 0.0) == forward)]


def bodies(faces: np.ndarray) -> np.ndarray:
    """Number of the body that each face is of, shape (f,): faces that vertices join, from 0 on."""
    from trimesh.graph import connected_component_labels

    label = connected_component_labels(faces[:, [0, 1, 1, 2]].reshape(-1, 2), int(faces.max()) + 1)
    return np.unique(label[faces[:, 0]], return_inverse=True)[1]


def winding_number(corners: np.ndarray, point: np.ndarray) -> float:
    """How often faces with corners (f, 3, 3) go around a point (3,): 1 inside a closed body, 0 outside."""
    a, b, c = (corners - point).transpose(1, 0, 2)
    x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    over = np.einsum("fd,fd->f", a, np.cross(b, c))
    under = x * y * z + (a * b).sum(1) * z + (b * c).sum(1) * x + (c * a).sum(1) * y
    return float(np.arctan2(over, under).sum() / (2.0 * np.pi))


def face_neighbours(faces: np.ndarray) -> np.ndarray:
    """Face across the edge from corner e to e + 1, shape (f, 3), int32; -1 across an open edge.

    Edges shared by more than two faces are paired in the order of the faces.
    """
    key = _edges(faces)[1]
    order = np.argsort(key, kind="stable")
    key = key[order]
    new = np.r_[True, key[1:] != key[:-1]]
    rank = np.arange(len(key)) - np.flatnonzero(new)[np.cumsum(new) - 1]
    first = np.flatnonzero((rank[:-1] % 2 == 0) & (key[1:] == key[:-1]))
    out = np.full(len(key), -1, np.int32)
    out[order[first]] = order[first + 1] // 3
    out[order[first + 1]] = order[first] // 3
    return out.reshape(-1, 3)


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals, shape (f, 3), zero for a degenerate face, and areas [m²], shape (f,)."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    double = np.linalg.norm(cross, axis=1)
    return cross / np.where(double > 0.0, double, 1.0)[:, None], 0.5 * double


def sample_creases(
    vertices: np.ndarray, faces: np.ndarray, angle: float, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points along edges that turn by more than ``angle`` [deg], their corners first.

    Returns:
        Points [m], shape (n, 3), and the mean normals of the two faces, shape (n, 3).
    """
    normals, _ = face_normals(vertices, faces)
    neighbour = face_neighbours(faces)
    f, e = np.nonzero(neighbour > np.arange(len(faces))[:, None])
    g = neighbour[f, e]
    turned = np.einsum("nd,nd->n", normals[f], normals[g]) < np.cos(np.radians(angle))
    f, e, g = f[turned], e[turned], g[turned]
    start, end = vertices[faces[f, e]], vertices[faces[f, (e + 1) % 3]]
    mean = normals[f] + normals[g]
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    pieces = np.maximum(np.ceil(np.linalg.norm(end - start, axis=1) / spacing).astype(int), 1)
    row = np.repeat(np.arange(len(f)), pieces)
    t = (np.arange(len(row)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[row]
    points = np.concatenate([start, end, start[row] + t[:, None] * (end - start)[row]])
    return points, np.concatenate([mean, mean, mean[row]])
