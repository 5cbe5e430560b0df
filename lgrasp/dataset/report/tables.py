"""The report's tables."""

import json
from collections.abc import Iterable, Sequence
from typing import Any

from lgrasp.words import number, plural

Block = dict[str, Any]
"""A part of the page, as page.html takes it."""


def table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    groups: Sequence[tuple[str, int]] = (),
    caption: str = "",
    text: Sequence[int] = (),
    total: bool = False,
) -> Block:
    """A table.

    Args:
        rows: Cells as texts; one that begins with ``!`` is marked as bad.
        groups: Heads above the columns, each with how many it spans.
        text: Columns of words besides the first.
        total: Whether the last row sums up.
    """
    return {"columns": columns, "rows": rows, "groups": groups, "caption": caption, "text": text, "total": total}


_METRIC_COLUMNS = (  # metric, head, format
    ("penetration", "penetration [mm]", ".2f"),
    ("self_penetration", "self-pen. [mm]", ".2f"),
    ("gap", "gap [mm]", ".2f"),
    ("normal_error", "normals [deg]", ".1f"),
    ("gswo", "gswo", ".3f"),
    ("epsilon", "epsilon", ".3f"),
)

_NEAR_SHARE = 0.01  # most near-duplicates of a good data set
_VERDICT_COLUMNS = (  # column, head, factor, format
    ("share", "draws [%]", 100, ".1f"),
    ("contact_at_q", "links at q", 1, ".1f"),
    ("contact_at_grasp", "links at grasp", 1, ".1f"),
    ("slip", "slip [mm]", 1e3, ".1f"),
    ("settled", "settled [%]", 100, ".0f"),
    ("diverged", "diverged [%]", 100, ".1f"),
)


def run_tables(data: dict[str, Any]) -> list[Block]:
    """The origin of a hand's rows, and the survivors of each stage."""
    about = [
        ("hand", f"{data['hand']} ({data['sha256'][:12]}…), {len(data['joints'])} joints"),
        ("rows", f"{number(data['rows'])} in {plural(data['shards'], 'shard')}"),
        ("made", " to ".join(dict.fromkeys(data["created"])) + f", lgrasp {', '.join(data['lgrasp_versions'])}"),
    ]
    if types := data["grasp_types"]:
        about.append(("grasp types", ", ".join(f"{name or 'none asked'} {number(n)}" for name, n in types.items())))
    out = []
    for run in data["runs"]:
        seeds = ", ".join(map(str, run["seeds"][:8])) + ("…" if len(run["seeds"]) > 8 else "")
        wall = run["seconds"].get("wall")
        told = f"{number(run['rows'])} rows, seed {seeds}" + (f", on {run['device']}" if run["device"] else "")
        about.append((f"pipeline {run['pipeline']}", told + (f", {run['rows'] / wall:,.0f} rows/s" if wall else "")))
        rows = []
        for name, left in run["survivors"].items():
            counts = sorted(run["counts"][name].items(), key=lambda c: -c[1])
            told = ", ".join(f"{what} {number(n)}" for what, n in counts)
            rows.append([name, number(left), number(run["seconds"].get(name), ",.1f"), told])
        if rows:
            caption = f"Survivors per stage of {run['pipeline']}, all shards together"
            out.append(table(("stage", "survivors", "seconds", "counts"), rows, caption=caption, text=(3,)))
    return [table(("", ""), about, text=(1,)), *out]


def validity_table(data: dict[str, Any]) -> Block:
    """Median and worst of each metric, a row per object (or set of objects held at once) and one for all."""
    shown = [s for s in _METRIC_COLUMNS if s[0] in data["metrics"]]
    columns = ["object", "rows", *(w for s in shown for w in ("median", "best" if s[0] == "epsilon" else "worst"))]
    groups = [("", 2), *((head, 2) for _, head, _ in shown)]
    rows = [[" + ".join(group["objects"]), *_metrics(group, shown)] for group in data["objects"]]
    if len(rows) > 1:
        rows.append(["all", *_metrics(data, shown)])
    caption = "Metrics as stored, of each grasp its worst contact. Orange: above the bound of strict validity."
    return table(columns, rows, groups=groups, caption=caption, total=len(rows) > 1)


def _metrics(of: dict[str, Any], shown: list[tuple[str, str, str]]) -> list[str]:
    cells = [number(of["rows"])]
    for name, _, style in shown:
        found = of["metrics"].get(name)
        for what in ("median", "max"):
            bad = "!" if found and what == "max" and found["over_bound"] else ""
            cells.append(f"{bad}{found[what]:{style}}" if found else "-")
    return cells


def diversity_table(data: dict[str, Any]) -> Block:
    """Poses, near-duplicates and coverage, a row per object; of a set held at once a row for each of its objects."""
    columns = ["object", "rows", "poses", "near-dup.", "contacts", "approach", "if uniform", "rotation", "if uniform"]
    columns += ["surface", "PCA 1", "PCA 5", "entropy", "std"]
    rows = []
    for group in data["objects"]:
        near = group["near_duplicates"]
        contacts = sum(int(n) * rows for n, rows in group["contacts"].items()) / max(group["rows"], 1)
        cells = [number(group["rows"]), number(group["distinct_poses"])]
        cells += [f"{'!' * (near['share'] > _NEAR_SHARE)}{near['share']:.2%}", f"{contacts:.2f}"]
        name = " + ".join(group["objects"])
        for k, (one, cover) in enumerate(group["coverage"].items()):
            hit = [
                f"{cover[what][share]:.0%}"
                for what in ("directions", "rotations")
                for share in ("share", "share_if_uniform")
            ]
            told = [name if one == name else f"{name}: {one}", *(cells if k == 0 else [""] * len(cells))]
            rows.append([*told, *hit, f"{cover['surface']['share']:.0%}", *_spread(group["diversity"].get(one))])
    if len(data["objects"]) > 1:
        rows.append(["all", number(data["rows"]), *[""] * 8, *_spread(data["diversity"])])
    caption = (
        "Poses: distinct object poses. Near-dup.: object within 5 mm and 5 deg and every joint within 0.1 rad of a row "
        "before; orange: over 1 %. Contacts: mean. Approach and rotation: share hit of equal-area bins of approach "
        "directions and of equal-volume bins of rotations, and what as many uniform draws as there are poses would "
        "hit. Surface: share within 5 mm of a contact. PCA: variance of poses and joints that the first 1 and 5 "
        "principal components explain (DexGraspBench; less is more diverse). Entropy of the joints, mean and std "
        "(DexGraspNet)."
    )
    return table(columns, rows, caption=caption, total=len(data["objects"]) > 1)


def _spread(found: dict[str, Any] | None) -> list[str]:
    """Cells of the PCA ratios and of the joints' entropy."""
    ratio, entropy = (found["pca_ratio"], found["joint_entropy"]) if found else (None, None)
    cells = [f"{ratio[0]:.0%}", f"{ratio[-1]:.0%}"] if ratio else ["-", "-"]
    return cells + ([f"{entropy['mean']:.2f}", f"{entropy['std']:.2f}"] if entropy else ["-", "-"])


def held_tables(data: dict[str, Any]) -> list[Block]:
    """Rows by the number of objects in the hand, and by the opposition space of the last step; none if all hold one."""
    held, counts = data["held"], list(data["held"])
    spaces = list(dict.fromkeys(name for group in held.values() for name in group["spaces"]))
    if counts in ([], ["1"]) and not spaces:
        return []
    protocols = sorted({name for group in held.values() for name in group["physics"]})
    holds = [f"hold ({name})" for name in protocols]

    def shares(group: dict[str, Any]) -> list[str]:
        return [number(group["physics"].get(name, {}).get("share"), ".1%") for name in protocols]

    rows = []
    for n, group in held.items():
        deep = group["penetration"]
        depth = [f"{deep['median']:.2f}", f"{'!' * bool(deep['over_bound'])}{deep['max']:.2f}"] if deep else ["-", "-"]
        rows.append([n, number(group["rows"]), *depth, *shares(group)])
    caption = "By the number of objects in the hand. Orange: above the strict bound."
    out = [table(["objects", "rows", "penetration [mm]: median", "max", *holds], rows, caption=caption)]
    if spaces:
        rows = []
        for name in spaces:
            found = [held[n]["spaces"].get(name, {"rows": 0, "physics": {}}) for n in counts]
            rows.append([name, *(cell for part in found for cell in (number(part["rows"]), *shares(part)))])
        groups = [("", 1), *((f"as object {n}", 1 + len(holds)) for n in counts)]
        caption = "Rows by the opposition space that took their last object, by which object it is."
        out.append(table(["space", *["rows", *holds] * len(counts)], rows, groups=groups, caption=caption))
    return out


def physics_table(data: dict[str, Any]) -> Block:
    """Verdicts of each protocol for each object: share that holds, the object's mass, means of other verdicts."""
    rows = []
    drawn = any("share" in found["means"] for group in data["objects"] for found in group["physics"].values())
    more = [entry for entry in _VERDICT_COLUMNS if drawn or entry[0] != "share"]
    columns = ["object", "protocol", "run", "holds", "mass [g]", *(head for _, head, _, _ in more)]
    for group in data["objects"]:
        for name, found in sorted(group["physics"].items()):
            cells = [" + ".join(group["objects"]), name, number(found["run"]), number(found["share"], ".1%")]
            cells.append(_mass(found["protocols"]))
            for column, _, factor, style in more:
                mean = found["means"].get(column)
                cells.append(number(None if mean is None else factor * mean, style))
            rows.append(cells)
    caption = "Means over the grasps that were run; links: of the hand, in contact with the object."
    if drawn:
        caption += " Draws: share of a grasp's draws in which it holds; a grasp holds if it holds in all."
    return table(columns, rows, caption=caption, text=(1,))


def _mass(protocols: list[Any]) -> str:
    """Mass of the object [g], if the protocols say one."""
    masses: dict[str, None] = {}
    for protocol in protocols:
        said = protocol if isinstance(protocol, dict) else {}
        resolved = said.get("resolved")
        mass = (said | resolved if isinstance(resolved, dict) else said).get("mass")
        if said.get("draws"):
            masses["drawn"] = None
        elif isinstance(mass, int | float):
            masses[f"{1000 * mass:.0f}"] = None
    return ", ".join(masses) or "-"


def protocol_list(data: dict[str, Any]) -> list[Block]:
    """What the protocols of the verdicts say, each text once, with its objects."""
    found: dict[tuple[str, str], list[str]] = {}
    for group in data["objects"]:
        for name, verdicts in group["physics"].items():
            for text in verdicts["protocols"]:
                shown = text if isinstance(text, str) else json.dumps(text, indent=1)
                found.setdefault((name, shown), []).append(" + ".join(group["objects"]))
    return [
        {"summary": f"Protocol {name}: {', '.join(objects)}", "text": shown} for (name, shown), objects in found.items()
    ]
