"""Parsers of files that keep silent."""

import contextlib
import logging
import warnings
from collections.abc import Iterator

import numpy as np


@contextlib.contextmanager
def quiet_parsers(logger: str = "trimesh") -> Iterator[None]:
    """Keep the parsers of files from warning or logging: whatever matters is checked on their result."""
    log = logging.getLogger(logger)
    before, log.disabled = log.disabled, True
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    finally:
        log.disabled = before
