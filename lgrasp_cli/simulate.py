"""``lgrasp simulate`` and ``reach``: does each grasp hold its object in a physics simulation, can an arm make it?"""

from pathlib import Path
from typing import Annotated, Any

from typer import Option

from lgrasp.choices import EngineName, ProtocolName
from lgrasp.words import number
from lgrasp_cli.names import one_of
from lgrasp_cli.options import Copies, Shards
from lgrasp_cli.tables import Block, TextTable, ending, share
from lgrasp_cli.working import How, working


@working
def simulate(
    shards: Shards,
    how: How,
    protocol: Annotated[
        str, Option("--protocol", "-p", **one_of(ProtocolName, "PROTOCOL", "What a grasp must withstand."))
    ] = "fc",
    engine: Annotated[str | None, Option(**one_of(EngineName, "ENGINE", "Simulator; default mujoco."))] = None,
    out: Copies = None,
    all_directions: Annotated[
        bool, Option("--all-directions", help="Continue after the first direction in which an object is lost.")
    ] = False,
) -> None:
    """Simulate grasps and add the verdicts to the shards, as columns physics/PROTOCOL_...

    The hand closes on the objects, which move freely and are then pulled in six directions; a grasp holds if they stay.
    docs/guides/physics.md describes each protocol. Shards with the verdicts stay as they are.

    PhysX (extra physx) has hard contacts, Drake (extra drake) contact patches; columns are physics/ENGINE_PROTOCOL_...

    Example: lgrasp simulate grasps/allegro-mug/robust --protocol fc
    """
    from lgrasp.jobs.requests.shards import SimulateRequest

    what = {"shards": shards, "protocol": protocol, "engine": engine, "out": out, "all_directions": all_directions}
    how.run(how.job(SimulateRequest, "simulate", **what), _show, _profile)


def _show(data: dict[str, Any]) -> list[Block]:
    entries = data["results"]
    stay = ("stay",) if any(entry["stay"] is not None for entry in entries) else ()
    drawn = data["protocol"]["draws"]
    names = ("hand", "object", "grasps", *(("hold in all", "hold, mean") if drawn else ("hold",)), *stay, "/s")
    rows = [
        (
            entry["hand"],
            entry["object"],
            f"{entry['rows']:,}",
            share(entry["held"], entry["rows"]),
            *((f"{entry['share']:.1%}",) if drawn else ()),
            *(share(entry[name], entry["rows"]) for name in stay),
            number(entry["per_s"], ".1f"),
        )
        for entry in entries
    ]
    name, start = data["protocol"]["name"], "q" if data["protocol"]["start"] == "grasp" else "q_pregrasp"
    lost = {name: sum(entry[name] for entry in entries) for name in ("pregrasp_too_deep", "diverged")}
    told = {"pregrasp_too_deep": f"penetrate too deeply at {start} and are not simulated", "diverged": "count as lost"}
    pairs = [
        ("protocol", f"{name}, {_friction(data['protocol'])}"),
        *((cause.split("_", 1)[-1].replace("_", " "), f"{n:,} {told[cause]}") for cause, n in lost.items() if n),
        *ending(data, "grasps", "dataset report"),
    ]
    return [TextTable(names, rows, right=names[2:]), pairs]


def _friction(protocol: dict[str, Any]) -> str:
    if not protocol["draws"]:
        return f"friction {protocol['friction']:g}"
    count, (low, high) = protocol["draws"]["count"], protocol["draws"]["friction"]
    return f"{count} draws of each grasp, friction {low:g} to {high:g}"


def _profile(data: dict[str, Any]) -> list[Block]:
    from lgrasp.simulate.protocol import DIRECTIONS

    lift, title = data["protocol"]["lift"], "shares of the grasps"
    if lift is None:
        title, ways, at = f"{title} run in a direction", DIRECTIONS, ("at q", "at grasp")
    elif "way" in lift:
        title, ways, at = (
            f"{title}; how far the object moved as the hand came, median",
            ("on table", "pushed"),
            ("at q",),
        )
    else:
        ways, at = (), ("at q",)
    names = ("hand", "object", *ways, *at, "mass", "stiffness")
    rows = [
        (
            entry["hand"],
            entry["object"],
            *_ways(entry),
            *(share(entry[f"contact_{name.replace(' ', '_')}"], entry["rows"]) for name in at),
            "drawn" if entry["mass"] is None else f"{1e3 * entry['mass']:.0f} g",
            "drawn" if entry["stiffness"] is None else f"{entry['stiffness']:.3g}",
        )
        for entry in data["results"]
    ]
    compiling = f"{data['seconds_compile']:.1f} s for models and kernels, not part of /s"
    return [title, TextTable(names, rows, right=names[2:]), [("compiling", compiling)]]


def _ways(entry: dict[str, Any]) -> tuple[str, ...]:
    if entry["directions_held"] is not None:
        return tuple(map(share, entry["directions_held"], entry["directions_run"]))
    if entry["on_table"] is None:
        return ()
    pushed = None if entry["pushed"] is None else 1e3 * entry["pushed"]
    return share(entry["on_table"], entry["rows"]), number(pushed, ".1f", " mm")


@working
def reach(
    shards: Shards,
    how: How,
    arm: Annotated[Path, Option(help="URDF of the arm.")],
    at: Annotated[
        str,
        Option(
            metavar="X,Y,Z[:YAW]",
            help="Pose of the object in the arm's root frame, metres and degrees; also X,Y,Z:ROLL,PITCH,YAW.",
        ),
    ],
    mount: Annotated[
        str | None, Option(metavar="X,Y,Z[:R,P,Y]", help="Pose of the hand's base link in the tip's frame.")
    ] = None,
    tip: Annotated[str | None, Option(metavar="LINK", help="Link that carries the hand; default: the last.")] = None,
    tries: Annotated[int | None, Option(min=1, help="Starting postures per pose.")] = None,
    out: Copies = None,
) -> None:
    """Find which grasps an arm can make, and add its joints to the shards, as columns physics/reach_...

    Example: lgrasp reach grasps/allegro-mug/robust-table --arm arm.urdf --at 0.5,0,0
    """
    from lgrasp.jobs.requests.shards import ReachRequest

    what = {"shards": shards, "arm": arm, "at": at, "mount": mount, "tip": tip, "tries": tries, "out": out}
    how.run(how.job(ReachRequest, "reach", **what), _show_reach)


def _show_reach(data: dict[str, Any]) -> list[Block]:
    from lgrasp.reach.targets import CODES

    rows = [
        (entry["hand"], entry["object"], f"{entry['rows']:,}", *(share(entry[name], entry["rows"]) for name in CODES))
        for entry in data["results"]
    ]
    columns = ("hand", "object", "grasps", *(name.replace("_", " ") for name in CODES))
    pairs = [
        ("arm", f"{data['arm']}, {len(data['joints'])} joints, hand on {data['tip']}"),
        *ending(data, "grasps", "dataset report"),
    ]
    return [TextTable(columns, rows, right=columns[2:]), pairs]
