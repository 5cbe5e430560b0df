"""Edges of triangle meshes: which are open, and the faces on their other side."""

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
