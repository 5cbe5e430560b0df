"""Conditions on the columns of shards, as users write them."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lgrasp.dataset.reader import ShardReader
from lgrasp.errors import ConfigError, ShardError

OBJECTS_HELD = "objects"
"""The number of objects in the hand, as if it were a column."""

_VALID = "metrics/valid"
ALL = f"{_VALID} >= 0"
"""A condition that all rows satisfy, also those that fail a bound."""

_OPERATORS: dict[str, np.ufunc] = {">=": np.greater_equal, "<=": np.less_equal, "==": np.equal, "!=": np.not_equal}
_OPERATORS |= {">": np.greater, "<": np.less}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_INTEGER = re.compile(r"[-+]?\d{1,20}", re.ASCII)
"""Compared as such: float64 cannot tell large ones apart."""
_PATTERN = re.compile(rf"\s*([\w/.-]+?)\s*(?:({'|'.join(_OPERATORS)})\s*({_NUMBER})\s*)?", re.ASCII)


class Condition(NamedTuple):
    """A column of one number per row, compared with a number; without an operator it must be true (not 0)."""

    column: str
    operator: str = "!="
    value: float = 0.0

    def __str__(self) -> str:
        if self[1:] == ("!=", 0.0):
            return self.column
        short = f"{self.value:g}"
        return f"{self.column} {self.operator} {short if float(short) == self.value else repr(self.value)}"

    def holds(self, reader: ShardReader) -> np.ndarray:
        """Which rows satisfy it, bool, shape [N]; a NaN satisfies nothing.

        Raises:
            ShardError: The shard has no such column, or not one number per row.
        """
        if self.column == _VALID and _VALID not in reader.columns:  # nothing fails a bound
            return np.full(len(reader), bool(_OPERATORS[self.operator](1, self.value)))
        single = [OBJECTS_HELD, *(name for name, (shape, _) in reader.columns.items() if len(shape) == 1)]
        if self.column not in single:
            known = f"with one number per row it has {', '.join(single)}"
            if self.column in reader.columns:
                raise ShardError(f"{reader.path}: column {self.column!r} has several numbers per row; {known}")
            maker = "reach" if self.column.startswith("physics/reach_") else "simulate"
            hint = f" (lgrasp {maker} adds physics columns)" if self.column.startswith("physics/") else ""
            raise ShardError(f"{reader.path}: no column {self.column!r}{hint}; {known}")
        held = self.column == OBJECTS_HELD
        values = (reader.column("object_index") >= 0).sum(1) if held else reader.column(self.column)
        return _OPERATORS[self.operator](values, self.value) & ~np.isnan(values.astype(np.float64))


def satisfied(reader: ShardReader, where: Sequence[Condition]) -> np.ndarray:
    """Rows of which all conditions hold, bool, shape [N]; rows with metric ``valid`` 0 only if a condition names it.

    Raises:
        ShardError: As of :meth:`Condition.holds`.
    """
    return satisfied_or_invalid(reader, where)[0]


def satisfied_or_invalid(reader: ShardReader, where: Sequence[Condition]) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`satisfied`, and the rows that only their metric ``valid`` leaves out, each shape [N]."""
    good = np.ones(len(reader), bool)
    for condition in where:
        good &= condition.holds(reader)
    if _VALID not in reader.columns or any(condition.column == _VALID for condition in where):
        return good, np.zeros(len(reader), bool)
    valid = reader.column(_VALID) != 0
    return good & valid, good & ~valid


def parse_condition(text: str) -> Condition:
    """Read ``COLUMN`` or ``COLUMN OP NUMBER`` with OP one of ``> >= < <= == !=``.

    Raises:
        ConfigError: It is neither.
    """
    match = _PATTERN.fullmatch(text)
    if match is None:
        raise ConfigError(f"--where '{text}': expected COLUMN or COLUMN OP NUMBER, such as 'metrics/epsilon > 0.01'")
    column, sign, number = match.groups()
    if not sign:
        return Condition(column)
    return Condition(column, sign, int(number) if _INTEGER.fullmatch(number) else float(number))
