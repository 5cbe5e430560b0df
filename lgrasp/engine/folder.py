"""The output folder of a job: paths of its shards, and what those that are there say of themselves."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from lgrasp.choices import VERDICTS
from lgrasp.dataset.files import check_heaps
from lgrasp.errors import ConfigError
from lgrasp.files import remove_leftovers

MOST_PARTS = 100_000
"""Files of a job."""
_MAX_NAME_BYTES = 120  # of a name; file systems allow 255


class Found(NamedTuple):
    """What a whole file says of itself."""

    key: str | None
    rows: int
    tried: int = 0
    """Candidates (or rounds), when they were all that the file may try; else 0."""
    protocols: tuple[str, ...] = ()
    """Those of ``lgrasp simulate`` that the rows have verdicts of."""
    shard: int = -1
    """Index of the shard in its run; -1 where the key tells."""


def shard_path(out: Path, hand: str, name: str, shard: int) -> Path:
    """File of a shard."""
    return out / f"{_safe(f'{hand}-{name}')}-{shard:05d}.h5"


def run_folder(top: Path, hand: str, name: str, pipeline: str, protocol: str | None = None) -> Path:
    """``TOP/HAND-NAME/PIPELINE[-PROTOCOL]``: the folder of a run's shards, whose rows hold under the protocol."""
    return top / _safe(f"{hand}-{name}") / _safe(f"{pipeline}-{protocol}" if protocol else pipeline)


def _safe(name: str) -> str:
    """A name without characters that a file's name had better not have; letters of any script stay."""
    return re.sub(r"[^\w.-]+", "_", name).encode()[:_MAX_NAME_BYTES].decode(errors="ignore")


def check_number(parts: int, what: str) -> None:
    """Check that a folder can hold so many files of a job: their names have five digits.

    Raises:
        ConfigError: it cannot.
    """
    if parts > MOST_PARTS:
        raise ConfigError(f"{parts:,} {what}; a folder holds at most {MOST_PARTS:,}")


def clean_folder(files: Sequence[Path]) -> None:
    """Remove leftovers of killed processes that wrote files like these; files being written stay."""
    for folder, stem in {(path.parent, _stem(path)) for path in files}:
        remove_leftovers(folder, f"{stem}-*.tmp")


def neighbours(files: Sequence[Path]) -> list[Path]:
    """Shards with other numbers beside files of one job."""
    beside = (set(file.parent.glob(f"{_stem(file)}-[0-9][0-9][0-9][0-9][0-9].h5")) for file in files[:1])
    return sorted(set().union(*beside) - set(files))


def found_shard(path: Path) -> Found:
    """What a shard says of itself.

    Raises:
        ShardError: it is no whole shard.
    """
    from lgrasp.dataset.reader import ShardReader  # slow to load
    from lgrasp.grasp.schema import MADE_FROM

    check_heaps(path)
    with ShardReader(path, invalid=False) as reader:
        config, statistics = reader.header.config, reader.statistics
        if MADE_FROM in statistics:
            return Found(str(statistics[MADE_FROM]), reader.columns["q"][0][0])
        # of a file with sequences only the whole ones count, and rounds are tried
        rows = int(statistics.get("sequences", len(reader)))
        tried = statistics.get("rounds" if "sequences" in statistics else "candidates", 0)
        simulated = tuple(name for name in VERDICTS if f"{name}_tried" in statistics)
        tried = int(tried) if statistics.get("exhausted") else 0
        return Found(config.get("run_key"), rows, tried, simulated, reader.header.shard_index)


def _stem(path: Path) -> str:
    """Name of a shard's file without its number."""
    return path.stem.rpartition("-")[0]
