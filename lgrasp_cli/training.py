"""``lgrasp dataset split`` and ``normalisation``: what training needs beside the shards."""

from pathlib import Path
from typing import Annotated

from typer import Option

from lgrasp.choices import GroupName
from lgrasp.words import listed
from lgrasp_cli.names import one_of
from lgrasp_cli.options import Shards, split
from lgrasp_cli.tables import Answer, TextTable, reporting

Negatives = Annotated[bool, Option("--negatives", help="Include rows with metric 'valid' 0.")]


@reporting
def split_rows(
    paths: Shards,
    by: Annotated[str, Option(**one_of(GroupName, "GROUP", "What no two parts share."))],
    out: Annotated[Path, Option("--out", "-o", help="JSON file to write.")] = Path("split.json"),
    shares: Annotated[
        str, Option(metavar="PART=SHARE,...", help="Parts, and shares of the rows: up to 1 together, or whole numbers.")
    ] = "train=0.8,val=0.1,test=0.1",
    seed: Annotated[int, Option(help="Decides which groups go where.")] = 0,
    negatives: Negatives = False,
) -> Answer:
    """Write which objects (hands, object poses) are for training, validation and test.

    GraspDataset, GraspIterableDataset and dataset normalisation read the file.

    Example: lgrasp dataset split grasps --by object -o split.json
    """
    parts = _shares(shares)
    from lgrasp.dataset.split import Split, make_split

    Split.check_place(out)
    made = make_split(paths, by=by, shares=parts, seed=seed, negatives=negatives)  # ty: ignore[invalid-argument-type]
    made.write(out)
    rows = [(name, f"{part.rows:,}", listed([*dict.fromkeys(part.names)], 4)) for name, part in made.parts.items()]
    return Answer(
        made.model_dump(mode="json"), [TextTable(("part", "rows", by), rows, right=("rows",)), [("where", str(out))]]
    )


@reporting
def normalisation(
    paths: Shards,
    out: Annotated[Path, Option("--out", "-o", help="JSON file to write.")] = Path("normalisation.json"),
    split_file: Annotated[
        Path | None, Option("--split", help="File written by dataset split; only rows of --part are measured.")
    ] = None,
    part: Annotated[str | None, Option(help="Part of the split; default: train.")] = None,
    negatives: Negatives = False,
) -> Answer:
    """Write mean and deviation of hand position, 6D rotation (in the object's frame) and joints over all rows.

    Example: lgrasp dataset normalisation grasps --split split.json -o normalisation.json
    """
    from lgrasp.dataset.normalisation import Normalisation

    Normalisation.check_place(out)
    made = Normalisation.of(paths, split=split_file, part=part, negatives=negatives)
    made.write(out)
    numbers = zip(made.names, made.mean, made.std, strict=True)
    rows = [(name, f"{mean:.4f}", f"{std:.4f}") for name, mean, std in numbers]
    table = TextTable(("number", "mean", "std"), rows, right=("mean", "std"))
    return Answer(made.model_dump(mode="json"), [table, "", [("rows", f"{made.rows:,}"), ("where", str(out))]])


def _shares(text: str) -> dict[str, float]:
    """Shares by the names of parts."""
    from lgrasp.errors import ConfigError

    found: dict[str, float] = {}
    for entry in split(text):
        name, _, share = entry.partition("=")
        if (name := name.strip()) in found:
            raise ConfigError(f"--shares {text}: part '{name}' is named twice")
        try:
            found[name] = float(share)
        except ValueError:
            found[name] = -1.0
    if not all(name and 0 < share < float("inf") for name, share in found.items()):
        raise ConfigError(f"--shares {text}: expected PART=SHARE,... with positive shares, such as train=0.9,test=0.1")
    total = sum(found.values())
    if total > 1 + 1e-6 and any(share % 1 for share in found.values()):
        raise ConfigError(f"--shares {text}: their sum is {total:g}; up to 1 is accepted, or whole numbers")
    return found
