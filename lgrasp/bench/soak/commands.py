"""Every command that writes, made small."""

from typing import NamedTuple


class Command(NamedTuple):
    """A command that writes, made small; {inputs} is the folder of its inputs, {out} of what it writes."""

    arguments: str
    cold: bool = False
    """It begins with an empty cache, which is where its results go."""
    compiles: bool = False
    """It begins without compiled kernels."""
    once: bool = False
    """A second run refuses to replace what a first one made."""
    changes: bool = False
    """It changes the shards in {out}, which begin as those of ``generate``."""
    gives: str = ""
    """Folder of {inputs} that takes what it writes, for other commands."""

    def needs(self) -> list[str]:
        """Commands that make its inputs."""
        return [name for name, made in COMMANDS.items() if made.gives and self._reads(made.gives)]

    def _reads(self, folder: str) -> bool:
        return f"{{inputs}}/{folder}" in self.arguments.split() or (self.changes and f"{{inputs}}/{folder}" == _SHARDS)


_SMALL, _QUICK = "--device cpu", "-p swift --set field.records=20000"
_SHARDS = "{inputs}/grasps"
COMMANDS = {
    "generate": Command(f"generate --object tiny -n 24 --shard-rows 8 {_QUICK} --out {{out}} {_SMALL}", gives="grasps"),
    "generate --table": Command(
        f"generate --object mug -n 4 --shard-rows 2 --table {_QUICK} --out {{out}} {_SMALL}", gives="on-table"
    ),
    "generate -p robust-hold": Command(
        f"generate --object tiny -n 4 --shard-rows 2 -p robust-hold --set field.records=20000 --out {{out}} {_SMALL}"
    ),
    "generate --simulate": Command(
        f"generate --object mug -n 4 --shard-rows 2 --simulate fc {_QUICK} --out {{out}} {_SMALL}",
        cold=True,  # the mug is cut into convex pieces, by a process of its own
    ),
    "simulate": Command(f"simulate {{out}} {_SMALL}", changes=True),
    "simulate --out": Command(f"simulate {_SHARDS} --out {{out}} {_SMALL}"),
    "simulate --protocol lift": Command(f"simulate {{inputs}}/on-table --protocol lift --out {{out}} {_SMALL}"),
    "sequence": Command(
        f"sequence tiny sphere -n 2 --set sequence.width=8 --set sequence.wave=64 --out {{out}} {_SMALL}"
    ),
    "refine": Command(f"refine {_SHARDS} --matching-rounds 2 --out {{out}} {_SMALL}"),
    "plan": Command(f"plan --object tiny -n 4 --out {{out}} {_SMALL}"),
    "scenes make": Command(f"scenes make --grasps {_SHARDS} -n 3 --views 1 --on-table 2 --out {{out}} {_SMALL}"),
    "learn fit": Command(
        f"learn fit {_SHARDS} --steps 3 --joint-steps 1 --unrolled 1 --batch 2 --out {{out}}/coarse.pt {_SMALL}"
    ),
    "dataset merge": Command(f"dataset merge {_SHARDS} -o {{out}}/all.h5"),
    "dataset metrics": Command(f"dataset metrics {_SHARDS} --add volume,epsilon_exact --workers 2 -o {{out}}"),
    "dataset metrics --add hold": Command(f"dataset metrics {_SHARDS} --add hold -o {{out}} {_SMALL}"),
    "dataset report": Command(f"dataset report {_SHARDS} --out {{out}}/page.html --json {{out}}/page.json"),
    **{
        f"export --to {form}": Command(f"export {_SHARDS} --to {form} --out {{out}}/{form}")
        for form in ("dexgraspnet", "dexgraspbench", "isaac-grasp", "mjcf")
    },
    "render": Command(f"render {_SHARDS} -n 2 --size 64 --out {{out}}/rows.png"),
    "judge": Command(f"judge {_SHARDS} --json {{out}}/verdict.json"),
    "hands check": Command(f"hands check barrett -n 4 -p swift --out {{out}}/check {_SMALL}"),
    "build-field": Command("build-field barrett --device cpu", cold=True),
    "hold": Command(f"hold --object mug --hand barrett --candidates 512 {_SMALL}", cold=True),
    "preprocess": Command("preprocess tiny", cold=True, compiles=True),
    "hands add": Command("hands add {inputs}/hand.urdf --name added --out {out}/added", once=True),
}
"""Every command that writes."""
