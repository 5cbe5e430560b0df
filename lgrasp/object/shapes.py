"""Random solids to learn from: household things with drawn sizes and free forms, 2 to 22 cm long."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import trimesh
from trimesh.creation import box, capsule, cone, cylinder, icosphere, revolve, torus
from trimesh.transformations import random_rotation_matrix, rotation_matrix

from lgrasp.choices import ShapeKind

_LARGEST = 0.22  # [m]
_MOST_FACES = 40_000  # of a solid that is deformed
_MIX: dict[ShapeKind, float] = {"single": 0.25, "joined": 0.3, "cup": 0.15, "ring": 0.05, "tool": 0.25}


def random_shape(
    seed: int, number: int, kind: ShapeKind | None = None, size: tuple[float, float] | None = None
) -> trimesh.Trimesh:
    """A watertight solid of one body [m], ``KIND-SEED-NUMBER`` by name; the same arguments give the same one.

    Args:
        kind: none: drawn, mostly of the free forms (what pose policies learn from).
        size: bounds of the longest side, drawn evenly [m]; none: that of the kind.
    """
    rng = np.random.default_rng([seed, number, *(kind or "").encode()])
    while True:
        drawn = kind or rng.choice(list(_MIX), p=list(_MIX.values()))
        parts = _MAKERS[drawn](rng)
        mesh: Any = parts[0] if len(parts) == 1 else trimesh.boolean.union(parts, engine="manifold")
        if mesh.is_watertight and mesh.body_count == 1:
            longest = mesh.extents.max()
            mesh.apply_scale(rng.uniform(*size) / longest if size else min(1.0, _LARGEST / longest))
            mesh.metadata["name"] = f"{kind or 'shape'}-{seed}-{number}"
            return mesh


def deformed_shape(mesh: trimesh.Trimesh, rng: np.random.Generator) -> trimesh.Trimesh:
    """The same solid stretched along its axes, tapered and waved along the longest of them, and bent across that."""
    mesh = mesh.copy()
    thin, middle, along = np.argsort(mesh.extents)
    while len(mesh.faces) * 4 <= _MOST_FACES and mesh.edges_unique_length.max() > mesh.extents[along] / 16:
        mesh = mesh.subdivide()
    x = np.array(mesh.vertices - mesh.bounds.mean(0)) * np.exp(rng.uniform(-0.3, 0.3, 3))
    length = np.ptp(x[:, along])
    share = x[:, along] / length
    taper = 1 + rng.uniform(-0.8, 0.8) * share
    wave = 1 + rng.uniform(-0.15, 0.15) * np.sin(2 * np.pi * (rng.uniform(0.7, 2) * share + rng.random()))
    x[:, [thin, middle]] *= (taper * wave)[:, None]
    across = thin if rng.random() < 0.7 else middle
    bend = rng.uniform(-1.4, 1.4) * min(1.0, length / (4 * np.ptp(x[:, across])))
    radius = length / bend
    out = radius - x[:, across]
    x[:, across], x[:, along] = radius - out * np.cos(bend * share), out * np.sin(bend * share)
    mesh.vertices = x
    mesh.apply_scale(min(1.0, _LARGEST / mesh.extents.max()))
    return mesh


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Evenly by ratio."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _solid(rng: np.random.Generator, *size: float) -> Any:
    """A convex solid about the origin in a box of a size (3,) [m]."""
    kind = rng.integers(6)
    if kind == 0:
        mesh = box((1, 1, 1))
    elif kind == 2:
        mesh = icosphere(3, 0.5)
    elif kind == 3:
        mesh = capsule(1.0, 0.5, count=(32, 32))
    elif kind == 4:
        mesh = cone(0.5, 1.0, sections=48)
    else:
        mesh = cylinder(0.5, 1.0, sections=48 if kind == 1 else int(rng.integers(3, 9)))
    mesh.apply_translation(-mesh.bounds.mean(0))
    mesh.apply_scale(np.array(size) / mesh.extents)
    return mesh


def _single(rng: np.random.Generator) -> list[Any]:
    return [_solid(rng, _between(rng, 0.015, 0.1), _between(rng, 0.015, 0.1), _between(rng, 0.02, 0.2))]


def _joined(rng: np.random.Generator) -> list[Any]:
    parts: list[Any] = []
    for _ in range(int(rng.choice([2, 2, 3, 4]))):
        part = _solid(rng, _between(rng, 0.012, 0.08), _between(rng, 0.012, 0.08), _between(rng, 0.015, 0.12))
        turn = random_rotation_matrix(rng.random(3))
        if rng.random() < 0.7:
            turn = rotation_matrix(np.pi / 2 * rng.integers(2), np.eye(3)[rng.integers(3)])
        part.apply_transform(turn)
        if parts:
            corners = parts[-1].triangles[rng.integers(len(parts[-1].faces))]
            part.apply_translation(rng.dirichlet(np.ones(3)) @ corners)
        parts.append(part)
    return parts


def _cup(rng: np.random.Generator, handle_share: float = 0.6) -> list[Any]:
    radius, height, wall = _between(rng, 0.025, 0.06), _between(rng, 0.04, 0.12), rng.uniform(0.003, 0.006)
    hollow = cylinder(radius - wall, height, sections=64).apply_translation((0, 0, wall))
    parts: list[Any] = [trimesh.boolean.difference([cylinder(radius, height, sections=64), hollow], engine="manifold")]
    if rng.random() < handle_share:
        handle = torus(_between(rng, 0.015, 0.03), _between(rng, 0.004, 0.008), major_sections=48, minor_sections=24)
        handle.apply_transform(rotation_matrix(np.pi / 2, (1, 0, 0)))
        handle.apply_scale((1, 1, 0.8 * height / handle.extents[2]))
        handle.apply_translation((radius + 0.002, 0, 0))
        inside = cylinder(radius - wall / 2, 2 * height, sections=64)
        parts.append(trimesh.boolean.difference([handle, inside], engine="manifold"))
    return parts


def _ring(rng: np.random.Generator) -> list[Any]:
    return [torus(_between(rng, 0.02, 0.05), _between(rng, 0.006, 0.015), major_sections=64, minor_sections=24)]


def _tool(rng: np.random.Generator) -> list[Any]:
    """A handle with a head, perhaps with a second handle that crosses it."""
    length, width = _between(rng, 0.08, 0.2), _between(rng, 0.012, 0.04)
    parts = [_solid(rng, width, width * rng.uniform(0.6, 1), length)]
    head = _solid(rng, _between(rng, 0.006, 0.04), _between(rng, 0.006, 0.05), _between(rng, 0.02, 0.1))
    if rng.random() < 0.5:
        head.apply_transform(rotation_matrix(np.pi / 2, (0, 1, 0)))
    head.apply_translation((rng.uniform(-0.3, 0.3) * head.extents[0], 0, length / 2))
    parts.append(head)
    if rng.random() < 0.3:
        other = _solid(rng, width, 0.8 * width, length)
        other.apply_transform(rotation_matrix(rng.uniform(0.2, 0.6), (0, 1, 0), (0, 0, 0.4 * length)))
        parts.append(other)
    return parts


def _turned(*profile: tuple[float, float]) -> list[Any]:
    """The solid of revolution about z through (radius, height) [m], from axis to axis, counterclockwise."""
    return [revolve(np.array(profile), sections=64)]


def _bottle(rng: np.random.Generator) -> list[Any]:
    """A body, a shoulder and a neck."""
    radius, height = _between(rng, 0.02, 0.045), _between(rng, 0.09, 0.22)
    neck = radius * rng.uniform(0.25, 0.6)
    body, shoulder = height * rng.uniform(0.4, 0.7), height * rng.uniform(0.1, 0.2)
    bend = np.linspace(0, np.pi, 9)
    curve = zip(neck + (radius - neck) * (1 + np.cos(bend)) / 2, body + shoulder * bend / np.pi, strict=True)
    return _turned((0, 0), (radius, 0), *curve, (neck, height), (0, height))


def _bowl(rng: np.random.Generator, low: float = 0.5, high: float = 1.0) -> list[Any]:
    """A shell whose height is ``low`` to ``high`` of its radius, on a flat foot."""
    radius, wall = _between(rng, 0.035, 0.09), rng.uniform(0.003, 0.006)
    height, foot = radius * rng.uniform(low, high), radius * rng.uniform(0.3, 0.6)
    turn = np.linspace(0, np.pi / 2, 13)
    outer = np.stack([foot + (radius - foot) * np.sin(turn), height * (1 - np.cos(turn))], 1)
    inner = np.stack([foot + (radius - wall - foot) * np.sin(turn), wall + (height - wall) * (1 - np.cos(turn))], 1)
    return _turned((0, 0), *map(tuple, outer), *map(tuple, inner[::-1]), (0, wall))


def _box(rng: np.random.Generator) -> list[Any]:
    return [box([_between(rng, 0.015, 0.09), _between(rng, 0.02, 0.1), _between(rng, 0.03, 0.16)])]


def _can(rng: np.random.Generator) -> list[Any]:
    return [cylinder(_between(rng, 0.012, 0.045), _between(rng, 0.02, 0.18), sections=64)]


def _ball(rng: np.random.Generator) -> list[Any]:
    """A sphere, or an ellipsoid."""
    mesh = icosphere(4, _between(rng, 0.015, 0.05))
    if rng.random() < 0.6:
        mesh.apply_scale([rng.uniform(0.6, 1.0), rng.uniform(0.8, 1.0), rng.uniform(1.0, 1.8)])
    return [mesh]


def _hammer(rng: np.random.Generator) -> list[Any]:
    """A round handle across a head."""
    length, radius = _between(rng, 0.12, 0.22), rng.uniform(0.008, 0.015)
    width = radius * rng.uniform(2.2, 3.2)
    head = [rng.uniform(0.05, 0.11), width, width * rng.uniform(0.8, 1.2)]
    mesh = box(head) if rng.random() < 0.5 else cylinder(width / 2, head[0], sections=48)
    if len(mesh.vertices) > 8:
        mesh.apply_transform(rotation_matrix(np.pi / 2, (0, 1, 0)))
    mesh.apply_translation((rng.uniform(-0.25, 0.25) * head[0], 0, length / 2))
    return [cylinder(radius, length, sections=48), mesh]


def _screwdriver(rng: np.random.Generator) -> list[Any]:
    """A thick handle and a thin shaft."""
    radius, length, shaft = rng.uniform(0.01, 0.018), _between(rng, 0.06, 0.11), _between(rng, 0.05, 0.11)
    handle = cylinder(radius, length, sections=int(rng.choice([6, 8, 48])))
    blade = cylinder(radius * rng.uniform(0.2, 0.35), shaft + 0.01, sections=32)
    blade.apply_translation((0, 0, (length + shaft) / 2 - 0.005))
    return [handle, blade]


_MAKERS: dict[ShapeKind, Callable[[np.random.Generator], list[Any]]] = {
    "mug": partial(_cup, handle_share=1.0),
    "bottle": _bottle,
    "bowl": _bowl,
    "plate": partial(_bowl, low=0.12, high=0.3),
    "box": _box,
    "can": _can,
    "ball": _ball,
    "hammer": _hammer,
    "screwdriver": _screwdriver,
    "single": _single,
    "joined": _joined,
    "cup": _cup,
    "ring": _ring,
    "tool": _tool,
}
