"""URDF and rules -> HandModel: solids, contact surface, pairs of parts that must stay apart."""

from pathlib import Path

import numpy as np
import trimesh

from lgrasp.errors import HandError
from lgrasp.geometry.clusters import CLUSTER_SIZE, bounding_spheres, cluster_order
from lgrasp.geometry.decompose import Decompose
from lgrasp.hand.contacts import body_cones, finger_points, palm_points
from lgrasp.hand.geometry import Piece, convex_pieces, geometry_mesh, inner_spheres, surface_samples
from lgrasp.hand.model import HandModel
from lgrasp.hand.overlap import overlap_arrays
from lgrasp.hand.pairs import with_pairs
from lgrasp.hand.spec import HandSpec, urdf_digest
from lgrasp.hand.spec_check import check_contact_links, check_size, check_spaces
from lgrasp.hand.surface import ContactLink, contact_arrays, csr, stack_rows
from lgrasp.hand.tree import Tree, build_tree
from lgrasp.hand.urdf import Urdf, read_urdf

_SPHERES_PER_PIECE = 12
_SAMPLE_SPACING = 4.0e-3  # [m]


def build_hand(
    urdf_path: Path, spec: HandSpec, device: str = "cpu", *, decompose: Decompose | None = None
) -> HandModel:
    """Build a HandModel from a URDF and its rules; ``device`` answers the geometric queries.

    Dented collision bodies are cut into convex pieces by ``decompose``; without it their hulls are taken.

    Raises:
        HandError: see :func:`read_urdf`, :func:`build_tree`; also a hand without collision geometry, or with a group of
            more joints than the kernels hold.
    """
    urdf = read_urdf(urdf_path)
    tree = build_tree(urdf, spec)
    check_size(spec, tree)
    check_contact_links(spec, tree.link_names, dict(urdf.links))
    check_spaces(spec, tree, dict(urdf.links))
    rng = np.random.default_rng(0)
    solids = _Solids(urdf, tree, rng, decompose, device)
    contacts = contact_arrays(tree, _contact_links(spec, tree, solids, rng, device), solids.meshes, rng, device)
    bodies = len(tree.joint_dof) + 1
    order = np.argsort([p[0] for p in solids.pieces], kind="stable")
    pieces = [solids.pieces[i] for i in order]
    per_body = [[p for p in pieces if p[0] == b] for b in range(bodies)]
    arrays = {
        "piece_first": csr([len(p) for p in per_body]),
        "body_sphere": np.array([_body_sphere([p[2] for p in group]) for group in per_body], np.float32),
        "vertex_first": csr([len(p[2].vertices) for p in pieces]),
        "vertices": stack_rows([p[2].vertices for p in pieces], 3),
        "plane_first": csr([len(p[2].planes) for p in pieces]),
        "planes": stack_rows([p[2].planes for p in pieces], 4),
        "piece_sphere": stack_rows([p[2].sphere[None] for p in pieces], 4),
        "piece_radius": np.array([p[2].radius for p in pieces], np.float32),
        "piece_body": np.array([p[0] for p in pieces], np.int32),
        "piece_link": np.array([p[1] for p in pieces], np.int32),
        "sphere_first": csr([sum(len(s) for b, s in solids.spheres if b == body) for body in range(bodies)]),
        "spheres": stack_rows([s for body in range(bodies) for b, s in solids.spheres if b == body], 4),
        **_clusters([stack_rows([s for b, s in solids.samples if b == body], 3) for body in range(bodies)]),
    }
    model = HandModel(
        name=spec.name,
        sha256=urdf_digest(urdf, spec),
        urdf_text=urdf.text,
        notes=tuple(solids.notes),
        contacts=spec.contacts,
        tree=tree,
        canonical_box=np.array([spec.canonical_box.min, spec.canonical_box.max], np.float32),
        pair_first=np.zeros((tree.groups + 1) ** 2 + 1, np.int32),
        pairs=np.zeros((0, 2), np.int32),
        **overlap_arrays([], [], (tree.groups + 1) ** 2),
        **arrays,
        **contacts,
    )
    return with_pairs(model, {(j.parent, j.child) for j in urdf.joints}, solids.meshes, solids.dented, device)


def _clusters(samples: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Surface samples of each body in compact runs of CLUSTER_SIZE (last one padded by repeats), with their balls."""
    runs = []
    for points in samples:
        points = np.resize(points, (-(-len(points) // CLUSTER_SIZE) * CLUSTER_SIZE, 3))
        runs.append(points[cluster_order(points)] if len(points) else points)
    flat = stack_rows(runs, 3)
    centre, radius = bounding_spheres(flat)
    return {
        "cluster_first": csr([len(r) // CLUSTER_SIZE for r in runs]),
        "cluster_sphere": np.column_stack([centre, radius]).astype(np.float32),
        "samples": flat,
    }


def _body_sphere(pieces: list[Piece]) -> np.ndarray:
    if not pieces:
        return np.array([0, 0, 0, -1.0])
    spheres = np.array([p.sphere for p in pieces])
    low = (spheres[:, :3] - spheres[:, 3:]).min(0)
    high = (spheres[:, :3] + spheres[:, 3:]).max(0)
    c = (low + high) / 2
    far = [np.linalg.norm(p.vertices - c, axis=1).max() + p.radius for p in pieces]
    return np.append(c, max(far))


class _Solids:
    """Per link: meshes in the body frame; flat lists of pieces, spheres and samples tagged with their body."""

    def __init__(
        self, urdf: Urdf, tree: Tree, rng: np.random.Generator, decompose: Decompose | None, device: str
    ) -> None:
        self.meshes: dict[str, list[trimesh.Trimesh]] = {}
        self.pieces: list[tuple[int, int, Piece]] = []
        self.spheres: list[tuple[int, np.ndarray]] = []
        self.samples: list[tuple[int, np.ndarray]] = []
        self.notes: list[str] = []
        self.dented: set[str] = set()
        for index, link in enumerate(tree.link_names):
            body, T_body_link = int(tree.link_body[index]), tree.T_body_link[index]
            for geometry in urdf.links[link]:
                T = T_body_link @ geometry.T_link_geometry
                mesh = geometry_mesh(urdf, geometry)
                pieces, note = convex_pieces(urdf, geometry, mesh, decompose, device)
                if note:
                    self.notes.append(f"link '{link}': {note}")
                    self.dented.add(link)
                mesh.apply_transform(T)
                self.meshes.setdefault(link, []).append(mesh)
                for piece in pieces:
                    moved = piece.moved(T)
                    self.pieces.append((body, index, moved))
                    self.spheres.append((body, inner_spheres(moved, _SPHERES_PER_PIECE, rng)))
                self.samples.append((body, surface_samples(mesh, _SAMPLE_SPACING, rng)))
        if not self.pieces:
            raise HandError(f"URDF {urdf.path} has no collision geometry; a hand's solid is its collision geometry")


def _contact_links(
    spec: HandSpec, tree: Tree, solids: _Solids, rng: np.random.Generator, device: str
) -> list[ContactLink]:
    """Contact surface of the links that the rules name, palm links last."""
    out = []
    for rule in spec.contact:
        for link in rule.links:
            index = tree.link_names.index(link)
            group = int(tree.body_group[tree.link_body[index]])
            if group < 0:
                raise HandError(f"hand '{spec.name}': contact link '{link}' does not move; list it under palm")
            T = tree.T_body_link[index]
            points, normals = finger_points(solids.meshes[link], T, rule.forbidden, rng, device)
            if len(points) == 0:
                raise HandError(f"hand '{spec.name}': the forbidden cones leave no surface on contact link '{link}'")
            out.append(ContactLink(link, group, points, normals, body_cones(rule.forbidden, T)))
    for link in spec.palm.links:
        index = tree.link_names.index(link)
        if tree.body_group[tree.link_body[index]] >= 0:
            raise HandError(f"hand '{spec.name}': palm link '{link}' moves; list it under contact")
        points, normals = palm_points(solids.meshes[link], tree.T_body_link[index], spec.palm.allowed, rng, device)
        out.append(ContactLink(link, tree.groups, points, normals, np.zeros((0, 4))))
    return out
