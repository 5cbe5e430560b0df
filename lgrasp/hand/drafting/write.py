"""HandSpec -> hand.yaml that explains itself."""

from importlib.resources import files
from pathlib import Path

import yaml

from lgrasp.hand.spec import Cone, HandSpec, OppositionSpace, Surface


def write_spec(spec: HandSpec, path: Path, decisions: list[str]) -> None:
    """Write a hand.yaml with a comment on every key and the decisions at the top."""
    data = {name: _plain(value) for name, value in spec.model_dump(mode="json").items()}
    contact = []
    for rule in spec.contact:
        contact.append(f"  - links: {_plain(list(rule.links))}")
        contact += ["    forbidden:", *(f"      - {_cone(c)}" for c in rule.forbidden)] if rule.forbidden else []
    palm = ["palm:", f"  links: {_plain(list(spec.palm.links))}", "  allowed:"]
    palm += [f"    - {_cone(c)}" for c in spec.palm.allowed]
    blocks = {
        "decisions": [f"# - {' '.join(line.split())}" for line in decisions],
        "locked": _mapping("locked", {n: _plain(v) for n, v in spec.locked.items()}),
        "shared": _mapping("shared", {n: _plain(list(v)) for n, v in spec.shared.items()}),
        "mimic": _mapping("mimic", {n: _plain(c.model_dump()) for n, c in spec.mimic.items()}),
        "contact": contact,
        "palm": palm if spec.palm.links else ["palm: {}"],
        "open_posture": _mapping("open_posture", {n: f"{v:g}" for n, v in spec.open_posture.items()}),
        "fingers": ["fingers:", *(f"  {_plain(n)}: {_plain(list(links))}" for n, links in spec.fingers.items())],
        "roles": _mapping("roles", dict(spec.roles)),
        "opposition_spaces": space_lines(spec.opposition_spaces),
    }
    template = files("lgrasp.hand.drafting").joinpath("hand.yaml.in").read_text(encoding="utf-8")
    text = template.format(**data | {name: "\n".join(lines) for name, lines in blocks.items()})
    path.write_text(text, encoding="utf-8")


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
        for first, *others in space.sides:
            lines.append(f"      - {'- ' if others else ''}{_surface(first)}")
            lines += [f"        - {_surface(part)}" for part in others]
    return lines


def _surface(part: Surface) -> str:
    box = f", box: {{min: {_numbers(part.box.min)}, max: {_numbers(part.box.max)}}}" if part.box else ""
    return f"{{links: {_plain(list(part.links))}, axis: {_numbers(part.axis)}, angle: {part.angle:g}{box}}}"


def _numbers(values: tuple[float, ...]) -> str:
    return f"[{', '.join(f'{v:g}' for v in values)}]"


def _mapping(key: str, values: dict[str, str]) -> list[str]:
    return [f"{key}:", *(f"  {_plain(n)}: {text}" for n, text in values.items())] if values else [f"{key}: {{}}"]
