"""The sample objects that ship with the package, built from primitives; ``write_samples`` fills ``objects/``.

Making them needs manifold3d (part of ``trimesh[easy]``); using the shipped files does not.
"""

import itertools
import os
from collections.abc import Callable, Iterable
from pathlib import Path

import manifold3d
import numpy as np
import trimesh
import yaml

_LICENCE = "Apache-2.0"
_DECIMALS = 6  # of a metre
_MERGE = 0.02  # [mm] detail that the boolean operations leave behind below this is simplified away


def _mug() -> trimesh.Trimesh:
    """Cup of 80 mm diameter and 95 mm height with 4 mm walls and an open handle."""
    body = _revolve([(0, 0), (37, 0), (40, 3), (40, 94), (39, 95), (37, 95), (36, 94), (36, 9), (32, 5), (0, 5)])
    ring = _tube(_ellipse(25.0, 29.0, 36), radius=6.5)
    ring.apply_transform(_frame((1, 0, 0), (0, -1, 0), (40, 0, 49)))
    hollow = _revolve([(0, 5), (38, 5), (38, 96), (0, 96)])
    return _union(body, _minus(ring, hollow))


def _bowl() -> trimesh.Trimesh:
    """Round bowl of 140 mm diameter and 58 mm height with 4 mm walls."""
    t = np.radians(np.linspace(0, 84, 13))
    outer = np.stack([22 + 48 * np.sin(t), 56 - 54 * np.cos(t)], axis=1)
    inner = np.stack([20 + 46 * np.sin(t), 56 - 50 * np.cos(t)], axis=1)[::-1]
    return _revolve([(0, 0), (21, 0), *outer, (68.6, 58), *inner, (0, 6)])


def _bottle() -> trimesh.Trimesh:
    """Filled and capped bottle of 64 mm diameter and 200 mm height."""
    s = np.linspace(0, 1, 14)
    shoulder = np.stack([32 - 19 * (3 * s**2 - 2 * s**3), 125 + 45 * s], axis=1)
    return _revolve([(0, 0), (29, 0), (32, 3), *shoulder, (13, 178), (15, 179), (15, 197), (12, 200), (0, 200)])


def _hammer() -> trimesh.Trimesh:
    """Hammer of 248 mm length: oval handle, round face and wedge peen."""
    handle = _hull(_ball((0, 0, 13), 11), _ball((0, 3, 13), 11), _ball((0, 0, 180), 8), _ball((0, 3, 180), 8))
    neck = _hull(_ball((0, 1.5, 175), 8), _ball((0, 1.5, 230), 7))
    head = _hull(_rounded_box((26, 24, 26), 3, (-2, 1.5, 235)))
    face = _hull(_disc((10, 1.5, 235), 12, 4), _disc((42, 1.5, 235), 15, 4), _disc((46, 1.5, 235), 13, 2))
    peen = _hull(_rounded_box((4, 24, 24), 2, (-12, 1.5, 235)), _rounded_box((4, 22, 5), 2, (-52, 1.5, 228)))
    return _union(handle, neck, head, face, peen)


def _screwdriver() -> trimesh.Trimesh:
    """Screwdriver of 210 mm length with a fluted handle and a flat tip."""
    handle = _revolve([(0, 0), (11, 0), (14, 3), (16, 20), (15.5, 60), (12, 78), (11, 84), (13, 92), (11, 98), (0, 98)])
    flutes = [_move(_hull(_ball((0, 0, 18), 5), _ball((0, 0, 66), 5)), _around(60 * k, 19.5)) for k in range(6)]
    shaft = _revolve([(0, 90), (3.2, 90), (3.2, 195), (0, 195)], sections=32)
    tip = _hull(_revolve([(0, 190), (3.2, 190), (3.2, 195), (0, 195)], sections=32), _slab((9, 1.4, 1), (0, 0, 209.5)))
    return _union(_minus(handle, *flutes), shaft, tip)


def _spoon() -> trimesh.Trimesh:
    """Spoon of 180 mm length with a 3 mm bowl wall and a flat curved handle."""
    outer = _move(_ball((0, 0, 0), 1, detail=3), np.diag([32.0, 21.0, 14.0, 1.0]))
    inner = _move(_ball((0, 0, 0), 1, detail=3), np.diag([29.0, 18.0, 11.0, 1.0]))
    shell = _minus(outer, inner, _slab((80, 60, 40), (0, 0, 20)))
    s = np.linspace(0, 1, 13)
    line = np.stack([30.5 + 117 * s, 0 * s, -1.6 + 16 * s - 10 * s**2], axis=1)
    half = 2.5 + 4.0 * s
    knots = [_hull(_ball((x, -w, z), 2), _ball((x, w, z), 2)) for (x, _, z), w in zip(line, half, strict=True)]
    return _union(shell, *(_hull(a, b) for a, b in itertools.pairwise(knots)))


def _capsule() -> trimesh.Trimesh:
    """Capsule of 50 mm diameter and 120 mm length."""
    t = np.radians(np.linspace(0, 90, 13))
    low = np.stack([25 * np.sin(t), 25 - 25 * np.cos(t)], axis=1)
    high = np.stack([25 * np.cos(t), 95 + 25 * np.sin(t)], axis=1)
    return _revolve([*low, *high])


def _box() -> trimesh.Trimesh:
    """Sharp box of 50 x 70 x 100 mm."""
    return _slab((50, 70, 100), (0, 0, 50))


def _sphere() -> trimesh.Trimesh:
    """Ball of 70 mm diameter."""
    return _ball((0, 0, 35), 35, detail=3)


def _plate() -> trimesh.Trimesh:
    """Thin plate of 120 x 80 x 5 mm with rounded edges."""
    return _rounded_box((120, 80, 5), 2.5, (0, 0, 2.5))


def _tiny() -> trimesh.Trimesh:
    """Coarse capsule of 50 mm diameter and 90 mm length, for smoke runs."""
    profile = [(0, 0), (13, 3), (22, 12), (25, 25), (25, 65), (22, 78), (13, 87), (0, 90)]
    return _revolve(profile, sections=14)


SAMPLES: dict[str, Callable[[], trimesh.Trimesh]] = {
    "mug": _mug,
    "bowl": _bowl,
    "bottle": _bottle,
    "hammer": _hammer,
    "screwdriver": _screwdriver,
    "spoon": _spoon,
    "capsule": _capsule,
    "box": _box,
    "sphere": _sphere,
    "plate": _plate,
    "tiny": _tiny,
}
"""Builders of the samples [mm] by name; their docstrings are the descriptions."""


def build_sample(name: str) -> trimesh.Trimesh:
    """Watertight sample mesh in metres, rounded as in its file; base centred on the origin of the xy plane."""
    mesh = SAMPLES[name]()
    vertices = mesh.vertices - [*mesh.bounds.mean(axis=0)[:2], mesh.bounds[0, 2]]
    return trimesh.Trimesh(np.round(vertices * 0.001, _DECIMALS) + 0.0, mesh.faces, process=False)


def write_samples(folder: str | os.PathLike[str]) -> list[Path]:
    """Write every sample as OBJ, and ``objects.yaml``, into a folder; the same bytes every time.

    Returns:
        The files written.
    """
    root = Path(folder)
    written, entries = [], {}
    for name, build in SAMPLES.items():
        mesh = build_sample(name)
        lines = [f"# lgrasp sample object: {name}, metres, {_LICENCE}"]
        lines += [f"v {x:.{_DECIMALS}f} {y:.{_DECIMALS}f} {z:.{_DECIMALS}f}" for x, y, z in mesh.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
        written.append(root / f"{name}.obj")
        written[-1].write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
        entries[name] = {
            "file": f"{name}.obj",
            "licence": _LICENCE,
            "faces": len(mesh.faces),
            "extents": [round(float(x), _DECIMALS) for x in mesh.extents],
            "description": (build.__doc__ or "").strip(),
        }
    written.append(root / "objects.yaml")
    text = yaml.safe_dump(entries, sort_keys=False, default_flow_style=None, width=120)
    written[-1].write_text(text, encoding="utf-8", newline="\n")
    return written


# Building blocks, in millimetres.


def _revolve(profile: Iterable[tuple[float, float]], *, sections: int = 64) -> trimesh.Trimesh:
    """Solid of revolution about z of an (r, z) line that starts and ends on the axis."""
    return trimesh.creation.revolve(np.array(list(profile), float), sections=sections)


def _ball(center: tuple[float, float, float], radius: float, *, detail: int = 2) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=detail, radius=radius)
    mesh.apply_translation(center)
    return mesh


def _slab(sides: tuple[float, float, float], center: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.box(extents=sides, transform=trimesh.transformations.translation_matrix(center))


def _rounded_box(
    sides: tuple[float, float, float], radius: float, center: tuple[float, float, float]
) -> trimesh.Trimesh:
    reach = 0.5 * np.array(sides) - radius
    corners = np.array(center) + reach * np.array(list(np.ndindex(2, 2, 2))) * 2.0 - reach
    return _hull(*(_ball(tuple(c), radius) for c in np.unique(corners, axis=0)))


def _disc(center: tuple[float, float, float], radius: float, length: float) -> trimesh.Trimesh:
    """Cylinder along x."""
    turn = _frame((0, 1, 0), (1, 0, 0), center)
    return trimesh.creation.cylinder(radius=radius, height=length, sections=48, transform=turn)


def _tube(line: list[tuple[float, float]], *, radius: float, sections: int = 48) -> trimesh.Trimesh:
    """Closed tube along a convex loop in the xy plane."""
    loop = np.array(line)
    ahead = np.roll(loop, -1, axis=0) - np.roll(loop, 1, axis=0)
    out = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1)[:, None]
    phi = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    flat = loop[:, None] + radius * np.cos(phi)[None, :, None] * out[:, None]  # (n, s, 2)
    height = np.broadcast_to(radius * np.sin(phi), flat.shape[:2])
    vertices = np.concatenate([flat, height[..., None]], axis=2).reshape(-1, 3)
    i, j = np.divmod(np.arange(len(vertices)), sections)
    right, up = (i + 1) % len(loop) * sections, (j + 1) % sections
    a, b, c, d = i * sections + j, right + j, right + up, i * sections + up
    mesh = trimesh.Trimesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), process=False)
    if mesh.volume < 0.0:
        mesh.invert()
    return mesh


def _ellipse(a: float, b: float, count: int) -> list[tuple[float, float]]:
    t = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return list(zip(a * np.cos(t), b * np.sin(t), strict=True))


def _frame(x: tuple, z: tuple, origin: tuple) -> np.ndarray:
    """Transform whose x and z axes point as given, shape (4, 4)."""
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = x, np.cross(z, x), z, origin
    return T


def _around(angle: float, radius: float) -> np.ndarray:
    """Shift by ``radius`` along x, then a turn about z by ``angle`` [deg], shape (4, 4)."""
    turn = trimesh.transformations.rotation_matrix(np.radians(angle), (0, 0, 1))
    return turn @ trimesh.transformations.translation_matrix((radius, 0, 0))


def _move(mesh: trimesh.Trimesh, transform: np.ndarray) -> trimesh.Trimesh:
    return mesh.copy().apply_transform(transform)


def _solid(mesh: trimesh.Trimesh) -> manifold3d.Manifold:
    return manifold3d.Manifold(manifold3d.Mesh64(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.uint64)))


def _mesh(solid: manifold3d.Manifold) -> trimesh.Trimesh:
    out = solid.simplify(_MERGE).to_mesh64()
    return trimesh.Trimesh(out.vert_properties[:, :3], out.tri_verts.astype(np.int64), process=False)


def _hull(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    return _mesh(manifold3d.Manifold.hull_points(np.concatenate([m.vertices for m in meshes])))


def _union(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    return _mesh(manifold3d.Manifold.batch_boolean([_solid(m) for m in meshes], manifold3d.OpType.Add))


def _minus(mesh: trimesh.Trimesh, *tools: trimesh.Trimesh) -> trimesh.Trimesh:
    return _mesh(manifold3d.Manifold.batch_boolean([_solid(m) for m in (mesh, *tools)], manifold3d.OpType.Subtract))
