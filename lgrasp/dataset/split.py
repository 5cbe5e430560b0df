"""Splits of data sets: which objects, hands or object poses are for training, and which for other parts."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from lgrasp.choices import GroupName
from lgrasp.config import Params
from lgrasp.dataset.files import Paths
from lgrasp.dataset.gather import gather
from lgrasp.dataset.json_file import JsonFile
from lgrasp.dataset.reader import ShardReader
from lgrasp.errors import ConfigError, ShardError
from lgrasp.grasp.pose_numbers import pose_numbers
from lgrasp.seeding import mixed

SHARES = {"train": 0.8, "val": 0.1, "test": 0.1}
"""Parts by default, and their shares of the rows."""
_MOST = 2**64 - 1


class SplitPart(Params):
    """One part."""

    rows: int = Field(ge=0, description="Rows when the split was made.")
    names: tuple[str, ...] = Field(default=(), description="Ids of the objects, or names of the hands.")
    sha256: tuple[str, ...] = Field(default=(), description="Their hashes, which decide.")
    upto: int = Field(default=0, ge=0, le=_MOST, description="by pose: largest number of a pose; the parts rise.")


class Split(JsonFile):
    """A split of rows by the object that they hold, by their hand, or by the object pose that they were made from."""

    FORMAT: ClassVar[str] = "lgrasp split"
    VERSION: ClassVar[int] = 1
    MADE_BY: ClassVar[str] = "lgrasp dataset split"

    by: GroupName = Field(description="What is in one part only.")
    seed: int = Field(default=0, description="What the parts were drawn with.")
    parts: dict[str, SplitPart] = Field(min_length=1, description="By name.")

    def holds(self, part: str, reader: ShardReader) -> np.ndarray:
        """Rows of a shard that are in a part, bool, shape [N].

        Raises:
            ConfigError: there is no such part.
            ShardError: the split does not know an object, or the hand.
        """
        if part not in self.parts:
            raise ConfigError(f"no part '{part}' in the split; it has {', '.join(self.parts)}")
        return self.numbers(reader) == list(self.parts).index(part)

    def numbers(self, reader: ShardReader) -> np.ndarray:
        """The part that each row of a shard is in, counted in ``parts``, shape [N]; -1 for a row without an object.

        Raises:
            ShardError: the split does not know an object, or the hand.
        """
        if self.by == "pose":
            ends = np.array([told.upto for told in self.parts.values()], np.uint64)
            return np.searchsorted(ends, _pose_numbers(reader, self.seed))
        of = {sha256: number for number, told in enumerate(self.parts.values()) for sha256 in told.sha256}
        if self.by == "hand":
            attributes, place = reader.attributes, np.zeros(len(reader), int)
            groups = [(str(attributes["hand"]), str(attributes["hand_sha256"]))]
        else:
            groups, place = [key[:2] for key in reader.object_keys], _first(reader)
        for k in np.unique(place[place >= 0]):
            if groups[k][1] not in of:
                raise ShardError(f"{reader.path}: {self.by} '{groups[k][0]}' is in no part of the split")
        return np.array([*(of.get(sha256, -1) for _, sha256 in groups), -1])[place]


class Groups(NamedTuple):
    """What a split keeps together, of one shard: G groups."""

    keys: list[tuple[str, ...]] | np.ndarray
    """Hashes that each group has; by pose numbers of the poses, shape [G], uint64."""
    rows: np.ndarray
    """Of each group, shape [G]."""
    names: dict[str, str]
    """Names of hashes."""


def read_groups(reader: ShardReader, by: GroupName, seed: int) -> Groups:
    """The groups of a shard."""
    if by == "pose":
        return Groups(*np.unique(_pose_numbers(reader, seed), return_counts=True), {})
    if by == "hand":
        sha256 = str(reader.attributes["hand_sha256"])
        return Groups([(sha256,)], np.array([len(reader)]), {sha256: str(reader.attributes["hand"])})
    kinds, rows = np.unique(reader.column("object_index"), axis=0, return_counts=True)
    known = reader.object_keys
    sets = [tuple(known[i][1] for i in kind if i >= 0) for kind in kinds]
    return Groups(sets, rows, {sha256: name for name, sha256, _ in known})


def make_split(
    paths: Paths, *, by: GroupName, shares: Mapping[str, float] = SHARES, seed: int = 0, negatives: bool = False
) -> Split:
    """Draw a split of the rows of shards.

    Args:
        paths: Shard files, or folders of any depth.
        by: as of :func:`draw_split`, as ``shares`` and ``seed``.
        negatives: count rows with metric ``valid`` 0 too.

    Raises:
        ShardError: No shard is found, or one cannot be read, or there are fewer groups than parts.
    """
    found = gather(paths, lambda reader: read_groups(reader, by, seed), invalid=negatives)
    return draw_split([shard.value for shard in found], by=by, shares=shares, seed=seed)


def draw_split(
    shards: Sequence[Groups], *, by: GroupName, shares: Mapping[str, float] = SHARES, seed: int = 0
) -> Split:
    """Parts of about some shares of the rows, such that no group is in two of them.

    Grasps of one object pose are much alike: a split row by row has siblings on both sides. Which groups a part gets
    depends on the seed and the groups alone.

    Args:
        by: ``object``: source meshes, whatever their scale; objects held at once stay together. ``hand``: hands.
            ``pose``: rows made from one object pose, so all objects are in every part.
        shares: of the rows, by the names of the parts; positive, they are divided by their sum.

    Raises:
        ShardError: There are fewer groups than parts.
    """
    if by == "pose":
        keys, at = np.unique(np.concatenate([g.keys for g in shards]), return_inverse=True)
        members: list[list[str]] = []
    else:
        roots = _joined([group for g in shards for group in g.keys])
        members = sorted({root: sorted(s for s in roots if roots[s] == root) for root in roots.values()}.values())
        place = {name: k for k, group in enumerate(members) for name in group}
        at = np.array([place[group[0]] for g in shards for group in g.keys])
        keys = np.array([_number(f"{seed}/{group[0]}") for group in members], np.uint64)
    if len(keys) < len(shares):
        raise ShardError(f"rows of {len(keys)} {by}(s) cannot be split into {len(shares)} parts by {by}")
    sizes = np.bincount(at, np.concatenate([g.rows for g in shards]), len(keys))
    order = np.argsort(keys)
    cuts = _cuts(sizes[order], [*shares.values()])
    names = {sha256: name for g in shards for sha256, name in g.names.items()}
    parts = {}
    for (name, _), some, last in zip(shares.items(), np.split(order, cuts), [*(cuts - 1), None], strict=True):
        own = sorted(sha256 for k in some for sha256 in members[k]) if members else []
        upto = 0 if members else (_MOST if last is None else int(keys[order[last]]))
        told = {"names": tuple(names[sha256] for sha256 in own), "sha256": tuple(own), "upto": upto}
        parts[name] = SplitPart(rows=int(sizes[some].sum()), **told)
    return Split(by=by, seed=seed, parts=parts)


def _cuts(sizes: np.ndarray, shares: Sequence[float]) -> np.ndarray:
    """Where groups in their order are cut so that parts have about some shares, and every part a group."""
    middle = np.cumsum(sizes) - sizes / 2  # the row that says where its group goes
    number = np.arange(1, len(shares))
    cuts = np.searchsorted(middle, np.cumsum(shares)[:-1] / sum(shares) * sizes.sum())
    cuts = np.maximum.accumulate(np.maximum(cuts - number, 0)) + number
    return np.minimum(cuts, len(sizes) - len(shares) + number)


def _joined(sets: Sequence[tuple[str, ...]]) -> dict[str, str]:
    """For every name one of those that are joined with it by some set."""
    joined: dict[str, str] = {}

    def root(name: str) -> str:
        while joined.setdefault(name, name) != name:
            name = joined[name]
        return name

    for held in sets:
        for name in held:
            joined[root(name)] = root(held[0])
    return {name: root(name) for name in joined}


def _first(reader: ShardReader) -> np.ndarray:
    """The first object that each row holds, -1 none, shape [N]."""
    index = reader.column("object_index")
    return np.take_along_axis(index, np.argmax(index >= 0, 1)[:, None], 1)[:, 0]


def _pose_numbers(reader: ShardReader, seed: int) -> np.ndarray:
    """A random number for the object of each row and the pose that it was made from, shape [N], uint64."""
    objects = np.array([*(_number(f"{seed}/{sha256}") for _, sha256, _ in reader.object_keys), 0], np.uint64)
    candidate = reader.column("candidate")
    if "sequence/parent" in reader.columns:  # the pose of a chain is that of its first object
        root, parent = np.arange(len(candidate)), reader.column("sequence/parent")
        for _ in range(reader.column("object_index", 0, 0).shape[1]):
            before = parent[root]
            root = np.where((before >= 0) & (before < len(root)), before, root)
        candidate = candidate[root]
    return mixed(objects[_first(reader)] + mixed(pose_numbers(candidate, reader.header.config)))


def _number(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")
