"""Small JSON files that say what they are."""

import json
import os
import re
from pathlib import Path
from typing import ClassVar, Self

from lgrasp.config import Params, parse_model
from lgrasp.errors import ConfigError
from lgrasp.files import write_file
from lgrasp.outputs import check_file, check_kind


class JsonFile(Params):
    """What a JSON file holds beside ``format``, which says which kind it is, and ``version``."""

    FORMAT: ClassVar[str]
    VERSION: ClassVar[int]
    MADE_BY: ClassVar[str]
    """Command that writes such files."""

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read what :meth:`write` wrote.

        Raises:
            ConfigError: there is no such file, or it is of another kind.
        """
        kind = cls.__name__.lower()
        try:
            data = json.loads(Path(path).read_bytes())
        except OSError as error:
            raise ConfigError(f"{kind} {path}: {error.strerror or error}") from None
        except (ValueError, RecursionError):
            data = None
        if not isinstance(data, dict) or data.pop("format", None) != cls.FORMAT:
            raise ConfigError(f"{path}: no {kind}; {cls.MADE_BY} writes one")
        if (version := data.pop("version", None)) != cls.VERSION:
            raise ConfigError(f"{kind} {path}: version {version}; {cls.VERSION} is read")
        return parse_model(cls, data, f"{kind} {path}")

    @classmethod
    def check_place(cls, path: str | os.PathLike[str]) -> None:
        """Check that a file can be written there, and that none of another kind is there.

        Raises:
            OutputError: one is, or none can.
        """
        check_file(path)
        check_kind(path, cls.__name__.lower(), rf'\{{\s*"format":\s*"{re.escape(cls.FORMAT)}"')

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write it.

        Raises:
            OutputError: as of :meth:`check_place`.
        """
        self.check_place(path)
        data = {"format": self.FORMAT, "version": self.VERSION, **self.model_dump(mode="json", exclude_defaults=True)}
        write_file(path, json.dumps(data, indent=1) + "\n")
