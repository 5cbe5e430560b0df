"""A hand by name, with rules drafted for those of installed packages, and its description."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lgrasp.engine.pipeline import Pipeline
from lgrasp.hand.find import HandSource, find_hand
from lgrasp.hand.spec_check import check_spaces
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf
from lgrasp.notices import notice
from lgrasp.policy.model import read_policy
from lgrasp.policy.names import SHIPPED, shipped_policy
from lgrasp.steer.typed import Anatomy, asked_sides, asked_thumb, made_types, typed

FEWEST_CONTACTS = 2
"""Contacts that any grasp has."""


def hand_source(name: str) -> HandSource:
    """A hand by the user's name for it; see :func:`lgrasp.hand.find.find_hand`.

    Raises:
        HandError: nothing of that name, or a URDF that no rules can be drafted for.
    """

    def draft(urdf: Path, name: str) -> Path:
        from lgrasp.hand.drafting.import_urdf import drafted_folder  # needed by few hands, and slow to load

        return drafted_folder(urdf, name)

    return find_hand(name, draft)


def for_hand(pipeline: Pipeline, hand: str) -> Pipeline:
    """A pipeline whose grasp type, sides of links, thumb and pose policy, if asked for, are those of a hand, with the
    one of stages ik, adjust and close that suits its fingers; one line tells where it asks for more contacts than the
    hand has fingers and palm, and it then asks for so many.

    Raises:
        HandError: no such hand.
        ConfigError: see :func:`~lgrasp.steer.typed.typed`, :func:`~lgrasp.steer.typed.asked_sides` and
            :func:`~lgrasp.steer.typed.asked_thumb`; a policy that is none, or of another hand.
    """
    policy, steer, search = pipeline.params("place").policy, pipeline.steer, pipeline.params("search")
    steered = steer.grasp_type is not None or steer.thumb is not None or any(steer.sides.values())
    contacts = max(pipeline.bounds.min_contacts, 0 if search.usual_contacts else max(search.contacts))
    if not (pipeline.open_to_hands or policy or steered or contacts > FEWEST_CONTACTS):
        return pipeline  # of any hand: it need not be read
    source = hand_source(hand)
    urdf = read_urdf(source.urdf)
    tree = build_tree(urdf, source.spec)
    pipeline = pipeline.suited(float(tree.dof_free.mean()))
    if policy == SHIPPED:
        shipped = own_policy(pipeline, source)
        pipeline = pipeline.with_params("place", policy=str(shipped) if shipped else None)
    elif policy is not None:
        read_policy(policy).check_hand(source.name, tree.joint_names, policy)
    if steered:
        anatomy = Anatomy(source.spec, urdf, tree)
        steer = typed(steer, anatomy)
        asked = {"sides": asked_sides(steer, anatomy), "thumb": asked_thumb(steer, anatomy)}
        pipeline = pipeline.model_copy(update={"steer": steer, "hand": pipeline.hand.model_copy(update=asked)})
    return _within_reach(pipeline, source, tree.groups)


def own_policy(pipeline: Pipeline, hand: HandSource) -> Path | None:
    """The pose policy that is shipped with a hand, or with the known one that a file is of, for pipelines that ask for
    nothing and have nothing in the way."""
    if pipeline.steer.asks or pipeline.on_table:
        return None
    return shipped_policy(hand.known or hand.name, pipeline.hand.contact_links)


def _within_reach(pipeline: Pipeline, source: HandSource, fingers: int) -> Pipeline:
    search, palm = pipeline.params("search"), bool(source.spec.palm.links)
    name, asked = ("contacts", source.spec.contacts) if search.usual_contacts else ("search.contacts", search.contacts)
    most = max(FEWEST_CONTACTS, fingers)
    lowered = sorted({str(k) for k in asked or () if k > most})
    if lowered and "close" not in pipeline.order:  # there each finger touches where it does
        notice(f"hand '{source.name}': {name} is {most}, not {' or '.join(lowered)}: its fingers")
    if "close" in pipeline.order:  # each finger touches once
        fingers, palm = len(pipeline.steer.fingers) or fingers, palm and pipeline.steer.palm != "no"
    least, most = pipeline.bounds.min_contacts, max(FEWEST_CONTACTS, fingers + palm)
    if least <= most:
        return pipeline
    notice(f"hand '{source.name}': bounds.min_contacts is {most}, not {least}: its fingers{' and palm' * palm}")
    return pipeline.with_bounds(min_contacts=most)


def hand_types(source: HandSource) -> dict[str, list[str]]:
    """Grasp types that a hand makes, each with others that ask for the same contacts of it."""
    urdf = read_urdf(source.urdf)
    made = made_types(Anatomy(source.spec, urdf, build_tree(urdf, source.spec)))
    return {name: list(alike) for name, alike in made.makes.items()}


def types_text(makes: Mapping[str, Sequence[str]]) -> str:
    """Grasp types of a hand in one line, those that ask for the same contacts joined by ``=``."""
    return "; ".join(" = ".join((name, *alike)) for name, alike in makes.items()) or "none"


def describe_hand(name: str) -> dict[str, Any]:
    """A hand's source, rules, and joints by finger (0 is the first dependency group, None for shared joints).

    Raises:
        HandError: no such hand, or one that cannot be used.
    """
    source = hand_source(name)
    spec = source.spec
    urdf = read_urdf(source.urdf)
    tree = build_tree(urdf, spec)
    check_spaces(spec, tree, dict(urdf.links))
    finger = dict(zip(tree.joint_column.tolist(), tree.body_group[1:].tolist(), strict=True))
    efforts = [effort if math.isfinite(effort) else None for effort in tree.joint_effort.tolist()]
    limits = zip(tree.joint_names, tree.joint_lower.tolist(), tree.joint_upper.tolist(), efforts, strict=True)
    return {
        "name": source.name,
        "description": spec.description,
        "urdf": str(source.urdf),
        "note": source.note,
        "approximation": spec.approximation,
        "base_link": tree.base_link,
        "locked": dict(spec.locked),
        "shared": {name: list(values) for name, values in spec.shared.items()},
        "contact_links": [link for rule in spec.contact for link in rule.links],
        "palm_links": list(spec.palm.links),
        "canonical_box": spec.canonical_box.model_dump(),
        "opposition_spaces": {name: list(space.joints) for name, space in spec.opposition_spaces.items()},
        "grasp_types": made_types(Anatomy(spec, urdf, tree))._asdict(),
        "licence": spec.licence,
        "source": spec.source,
        "notes": [spec.notes] if isinstance(spec.notes, str) and spec.notes else list(spec.notes),
        "joints": [
            {"name": joint, "finger": None if joint in tree.shared_names else finger[k]}
            | {"lower": lower, "upper": upper, "effort": effort}
            for k, (joint, lower, upper, effort) in enumerate(limits)
        ],
    }
