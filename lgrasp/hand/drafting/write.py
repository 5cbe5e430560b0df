"""HandSpec -> hand.yaml that explains itself."""

from pathlib import Path

import yaml

from lgrasp.hand.spec import Cone, HandSpec, OppositionSpace, Surface


def write_spec(spec: HandSpec, path: Path, decisions: list[str]) -> None:
    """Write a hand.yaml with a comment on every key and the decisions at the top."""
    lines = [
        "# Drafted by 'lgrasp hands add'. Every key may be changed; 'lgrasp hands check' says what a change does.",
        "#",
    ]
    lines += [f"# - {' '.join(line.split())}" for line in decisions]
    lines += ["", f"name: {_plain(spec.name)}", f"urdf: {_plain(spec.urdf)}"]
    lines += ["", "# Poses are given in the frame of this link; it must not move with any finger."]
    lines += [f"base_link: {_plain(spec.base_link)}"]
    lines += [
        "",
        "# Joints held at a value [rad or m]; lgrasp does not move them. Free one by deleting its line.",
    ]
    lines += _mapping("locked", spec.locked)
    lines += ["", "# Joints that move several fingers: every pose of the object takes one of these values [rad or m]."]
    lines += (
        ["shared:", *(f"  {_plain(n)}: {_plain(list(v))}" for n, v in spec.shared.items())]
        if spec.shared
        else ["shared: {}"]
    )
    lines += [
        "",
        "# Couplings that the URDF does not state: `joint: {joint: its source, multiplier: 1.0, offset: 0.0}`.",
    ]
    lines += (
        ["mimic:", *(f"  {_plain(n)}: {_plain(c.model_dump())}" for n, c in spec.mimic.items())]
        if spec.mimic
        else ["mimic: {}"]
    )
    lines += ["", "# Links that do not move with any finger."]
    lines += [f"static_links: {_plain(list(spec.static_links))}"]
    lines += [
        "",
        "# Links that may touch an object, save surface whose normal (link frame) is within `angle` degrees of `axis`:",
    ]
    lines += [
        "# the axis points away from the palmar side. Delete a link to keep it off objects; smaller angles allow more."
    ]
    lines += ["contact:"]
    for rule in spec.contact:
        lines += [f"  - links: {_plain(list(rule.links))}"]
        lines += ["    forbidden:", *(f"      - {_cone(c)}" for c in rule.forbidden)] if rule.forbidden else []
    lines += ["", "# Static links that may touch an object, where their normal lies within `angle` degrees of `axis`."]
    lines += ["# `palm: {}` keeps objects off the palm."]
    if spec.palm.links:
        lines += ["palm:", f"  links: {_plain(list(spec.palm.links))}", "  allowed:"]
        lines += [f"    - {_cone(c)}" for c in spec.palm.allowed]
    else:
        lines += ["palm: {}"]
    lines += ["", "# Numbers of fingers that touch, drawn evenly; [] leaves it to the pipeline (3, 4)."]
    lines += [f"contacts: {_plain(list(spec.contacts))}"]
    lines += ["", "# Distance from base to surface at which lgrasp plan begins [m]; null: as far as for most hands."]
    lines += [f"stand_off: {_plain(spec.stand_off)}"]
    box = spec.canonical_box
    lines += [
        "",
        "# Where an object's surface is put first (base_link frame, metres): between the fingertips, off the palm.",
    ]
    lines += [f"canonical_box: {{min: {_plain(list(box.min))}, max: {_plain(list(box.max))}}}"]
    lines += ["", "# Where unused fingers go: free of self-collision, away from the canonical box."]
    lines += _mapping("open_posture", spec.open_posture)
    lines += ["", "# Names of the fingers, for reports."]
    lines += ["fingers:", *(f"  {_plain(name)}: {_plain(list(links))}" for name, links in spec.fingers.items())]
    lines += [
        "",
        "# For sequences of grasps: joints, and two sides that they press towards each other. A side is the surface of",
        "# `links` whose normal lies within `angle` degrees of `axis`, inside `box` (link frame, metres).",
    ]
    lines += space_lines(spec.opposition_spaces)
    lines += ["", "# Yours to fill in: the licence and the source of the model."]
    lines += [f"licence: {_plain(spec.licence)}", f"source: {_plain(spec.source)}", ""]
    path.write_text("\n".join(lines), encoding="utf-8")


def _plain(value: object) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, allow_unicode=True, sort_keys=False)
    return text.removesuffix("...\n").strip()


def _cone(cone: Cone) -> str:
    return f"{{axis: {_plain(list(cone.axis))}, angle: {cone.angle:g}}}"


def space_lines(spaces: dict[str, OppositionSpace]) -> list[str]:
    """Opposition spaces as lines of hand.yaml."""
    if not spaces:
        return ["opposition_spaces: {}"]
    lines = ["opposition_spaces:"]
    for name, space in spaces.items():
        lines += [f"  {_plain(name)}:", f"    joints: {_plain(list(space.joints))}", "    sides:"]
        for side in space.sides:
            if len(side) == 1:
                lines += [f"      - {_surface(side[0])}"]
            else:
                lines += [f"      {'-' if i == 0 else ' '} - {_surface(part)}" for i, part in enumerate(side)]
    return lines


def _surface(part: Surface) -> str:
    box = f", box: {{min: {_numbers(part.box.min)}, max: {_numbers(part.box.max)}}}" if part.box else ""
    return f"{{links: {_plain(list(part.links))}, axis: {_numbers(part.axis)}, angle: {part.angle:g}{box}}}"


def _numbers(values: tuple[float, ...]) -> str:
    return f"[{', '.join(f'{v:g}' for v in values)}]"


def _mapping(key: str, values: dict[str, float]) -> list[str]:
    return [f"{key}:", *(f"  {_plain(n)}: {v:g}" for n, v in values.items())] if values else [f"{key}: {{}}"]
