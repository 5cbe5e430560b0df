"""Random solids to learn from: single ones, joined ones, cups, rings and tools, 2 to 22 cm long."""

from typing import Any

import numpy as np
import trimesh
from trimesh.creation import box, capsule, cone, cylinder, icosphere, torus
from trimesh.transformations import random_rotation_matrix, rotation_matrix

_LARGEST = 0.22  # [m]
_KINDS = {"single": 0.25, "joined": 0.3, "cup": 0.15, "ring": 0.05, "tool": 0.25}


def random_shape(seed: int, number: int) -> trimesh.Trimesh:
    """A watertight solid [m]; the same numbers give the same one."""
    rng = np.random.default_rng([seed, number])
    make = {"single": _single, "joined": _joined, "cup": _cup, "ring": _ring, "tool": _tool}
    while True:
        parts = make[str(rng.choice(list(_KINDS), p=list(_KINDS.values())))](rng)
        mesh: Any = parts[0] if len(parts) == 1 else trimesh.boolean.union(parts, engine="manifold")
        if mesh.is_watertight and mesh.body_count == 1:
            mesh.apply_scale(min(1.0, _LARGEST / mesh.extents.max()))
            mesh.metadata["name"] = f"shape-{seed}-{number}"
            return mesh


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Evenly by ratio."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _solid(rng: np.random.Generator, *size: float) -> Any:
    """A convex solid about the origin in a box of a size (3,) [m]."""
    kind = rng.integers(6)
    if kind == 2 or kind == 3:
        mesh = icosphere(3, 0.5) if kind == 2 else capsule(1.0, 0.5, count=(32, 32))
    elif kind == 4:
        mesh = cone(0.5, 1.0, sections=48)
    else:
        mesh = (
            box((1, 1, 1)) if kind == 0 else cylinder(0.5, 1.0, sections=48 if kind == 1 else int(rng.integers(3, 9)))
        )
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


def _cup(rng: np.random.Generator) -> list[Any]:
    radius, height, wall = _between(rng, 0.025, 0.06), _between(rng, 0.04, 0.12), rng.uniform(0.003, 0.006)
    hollow = cylinder(radius - wall, height, sections=64).apply_translation((0, 0, wall))
    parts: list[Any] = [trimesh.boolean.difference([cylinder(radius, height, sections=64), hollow], engine="manifold")]
    if rng.random() < 0.6:
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
