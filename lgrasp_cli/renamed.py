"""Options by their names of the release before, which work for one more, with a notice."""

from collections.abc import Set
from itertools import zip_longest

from lgrasp.notices import notice

NEW = {
    "--always": ("--keep-invalid",),
    "--force": ("--overwrite", "--rebuild"),
    "--no-resume": ("--overwrite",),
    "--physics": ("--simulate",),
    "--reuse": ("--passes=8",),
    "--shard-index": ("--shard",),
    "--threads": ("--workers",),
}
"""Old name -> new ones; of these a command is given those that it has."""
_NEEDLESS = {"--resume": "--overwrite"}  # what commands with another option do by default


def renew(arguments: list[str], options: Set[str]) -> list[str]:
    """The words of a command line, options by their names of this release, of those that the command has."""
    out = []
    for word, after in zip_longest(arguments, arguments[1:]):
        old, sign, value = word.partition("=")
        new = [name for name in NEW.get(old, ()) if name.partition("=")[0] in options]
        if old in options or not (new or _NEEDLESS.get(old) in options):
            out.append(word)
        elif new:
            notice(f"{old} is now {' and '.join(new)}; the old name works in this release only")
            out += [name + sign + value for name in new]
        if word == "--json" and word in options and (after is None or (after.startswith("-") and after != "-")):
            notice("--json takes a path; - is standard output (without one it works in this release only)")
            out.append("-")
    return out
