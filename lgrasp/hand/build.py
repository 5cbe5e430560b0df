"""URDF and rules -> HandModel: solids, contact surface, pairs of parts that must stay apart."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import trimesh

from lgrasp.errors import HandError
from lgrasp.geometry.clusters import CLUSTER_SIZE, bounding_spheres, cluster_order
from lgrasp.geometry.decompose import Decompose
from lgrasp.hand.contacts import body_cones, link_points
from lgrasp.hand.digest import urdf_digest
from lgrasp.hand.geometry import convex_pieces, geometry_mesh, inner_spheres, one_solid, surface_samples
from lgrasp.hand.model import HandModel, csr, piece_arrays, stack_rows
from lgrasp.hand.overlap import overlap_arrays
from lgrasp.hand.pairs import with_pairs
from lgrasp.hand.piece import Piece
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.spec_check import check_contact_links, check_size, check_spaces
from lgrasp.hand.surface import ContactLink, contact_arrays
from lgrasp.hand.tree import Tree, build_tree
from lgrasp.hand.urdf import Urdf, read_urdf

_SPHERES_PER_PIECE = 12
_SAMPLE_SPACING = 4.0e-3  # [m]


def build_hand(
    urdf_path: Path,
    spec: HandSpec,
    *,
    decompose: Decompose | None = None,
    pieces_only: bool = False,
) -> HandModel:
    """Build a HandModel from a URDF and its rules.

    Args:
        decompose: cuts dented collision bodies into convex pieces; without it their hulls are taken.
        pieces_only: without spheres, surface samples and contact surface: what self-collision needs, in a fraction of
            the time.

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
    solids = _Solids(urdf, tree, None if pieces_only else rng, decompose)
    links = [] if pieces_only else _contact_links(spec, tree, solids.meshes, rng)
    contacts = contact_arrays(tree, links, solids.meshes, rng)
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
        **solids.arrays(),
        **contacts,
    )
    return with_pairs(model, {(j.parent, j.child) for j in urdf.joints}, solids.meshes, solids.dented)


class _Solids:
    """Per link: meshes in the body frame; per body: pieces with the index of their link, spheres, surface samples.

    Without ``rng`` there are no spheres and no samples.
    """

    def __init__(self, urdf: Urdf, tree: Tree, rng: np.random.Generator | None, decompose: Decompose | None) -> None:
        self.meshes: dict[str, list[trimesh.Trimesh]] = {}
        self.notes: list[str] = []
        self.dented: set[str] = set()
        bodies = range(len(tree.joint_dof) + 1)
        self._pieces: list[list[tuple[int, Piece]]] = [[] for _ in bodies]
        self._spheres: list[list[np.ndarray]] = [[] for _ in bodies]
        self._samples: list[list[np.ndarray]] = [[] for _ in bodies]
        for index, link in enumerate(tree.link_names):
            body = tree.link_body[index]
            for geometry in urdf.links[link]:
                T = tree.T_body_link[index] @ geometry.T_link_geometry
                mesh = geometry_mesh(urdf, geometry)
                pieces, note = convex_pieces(urdf, geometry, mesh, decompose)
                if note:
                    self.notes.append(f"link '{link}': {note}")
                    self.dented.add(link)
                mesh = one_solid(mesh).apply_transform(T)
                self.meshes.setdefault(link, []).append(mesh)
                for piece in pieces:
                    moved = piece.moved(T)
                    self._pieces[body].append((index, moved))
                    if rng:
                        self._spheres[body].append(inner_spheres(moved, _SPHERES_PER_PIECE, rng))
                if rng:
                    self._samples[body].append(surface_samples(mesh, _SAMPLE_SPACING, rng))
        if not self.meshes:
            raise HandError(f"URDF {urdf.path} has no collision geometry; a hand's solid is its collision geometry")

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays of a HandModel for its solids."""
        pieces = [piece for own in self._pieces for _, piece in own]
        spheres = [stack_rows(own, 4) for own in self._spheres]
        runs = [_runs(stack_rows(own, 3)) for own in self._samples]
        samples = np.vstack(runs)
        centre, radius = bounding_spheres(samples)
        return {
            "piece_first": csr([len(own) for own in self._pieces]),
            "body_sphere": np.array([_body_sphere([piece for _, piece in own]) for own in self._pieces], np.float32),
            **piece_arrays(pieces),
            "piece_body": np.repeat(np.arange(len(runs), dtype=np.int32), [len(own) for own in self._pieces]),
            "piece_link": np.array([index for own in self._pieces for index, _ in own], np.int32),
            "sphere_first": csr([len(own) for own in spheres]),
            "spheres": np.vstack(spheres),
            "cluster_first": csr([len(run) // CLUSTER_SIZE for run in runs]),
            "cluster_sphere": np.column_stack([centre, radius]).astype(np.float32),
            "samples": samples,
        }


def _runs(points: np.ndarray) -> np.ndarray:
    """Surface samples of a body in compact runs of CLUSTER_SIZE, the last one padded by repeats."""
    points = np.resize(points, (-(-len(points) // CLUSTER_SIZE) * CLUSTER_SIZE, 3))
    return points[cluster_order(points)] if len(points) else points


def _body_sphere(pieces: list[Piece]) -> np.ndarray:
    if not pieces:
        return np.array([0, 0, 0, -1.0])
    spheres = np.array([p.sphere for p in pieces])
    c = ((spheres[:, :3] - spheres[:, 3:]).min(0) + (spheres[:, :3] + spheres[:, 3:]).max(0)) / 2
    return np.append(c, max(np.linalg.norm(p.vertices - c, axis=1).max() + p.radius for p in pieces))


def _contact_links(
    spec: HandSpec,
    tree: Tree,
    meshes: Mapping[str, Sequence[trimesh.Trimesh]],
    rng: np.random.Generator,
) -> list[ContactLink]:
    """Contact surface of the links that the rules name, palm links last."""
    out = []
    named = [(link, rule.forbidden, False) for rule in spec.contact for link in rule.links]
    for link, cones, palm in named + [(link, spec.palm.allowed, True) for link in spec.palm.links]:
        if (group := tree.group_of(link)) >= 0 and palm:
            raise HandError(f"hand '{spec.name}': palm link '{link}' moves; list it under contact")
        if group < 0 and not palm:
            raise HandError(f"hand '{spec.name}': contact link '{link}' does not move; list it under palm")
        T = tree.T_body_link[tree.link_names.index(link)]
        points, normals = link_points(meshes[link], T, cones, rng, palm=palm)
        if len(points) == 0 and not palm:
            raise HandError(f"hand '{spec.name}': the forbidden cones leave no surface on contact link '{link}'")
        rules = body_cones(() if palm else cones, T)
        out.append(ContactLink(link, tree.groups if palm else group, points, normals, rules))
    return out
