"""Options of exports that not every format has. Light to import."""

import os
import re

from lgrasp.errors import ConfigError

IN_PARTS = ("webdataset",)
"""Formats whose files hold rows of one part of a split each."""


def check_options(to: str, split: str | os.PathLike[str] | None, licence: str) -> None:
    """Check the split and the licence of an export.

    Raises:
        ConfigError: A split for a format without parts, or a licence that is no identifier.
    """
    if split is not None and to not in IN_PARTS:
        raise ConfigError(f"--split: {to} has no parts; choose --to {' or '.join(IN_PARTS)}")
    if licence and not re.fullmatch(r"[A-Za-z0-9.+-]+", licence):
        raise ConfigError(f"--licence '{licence}': an identifier of SPDX is accepted, such as CC-BY-4.0 or Apache-2.0")
