"""Options by their names of the release before, which work for one more, with a notice."""

from itertools import zip_longest

from lgrasp.notices import notice

_NEW = {
    "--always": ("--keep-invalid",),
    "--force": ("--overwrite", "--rebuild"),
    "--no-resume": ("--overwrite",),
    "--physics": ("--simulate",),
    "--resume": (),  # the default
    "--reuse": ("--passes=8",),
    "--threads": ("--workers",),
}
_PREPARE = ("build-field", "preprocess", "place", "domain", "ik", "search", "filter")
_OF_COMMANDS = {name: {"--force": ("--rebuild",), "--shard-index": ("--shard",)} for name in _PREPARE} | {
    "hands": {"--force": ("--overwrite",)},
    "bench": {"--resume": ("--resume",)},
}


def renew(arguments: list[str]) -> list[str]:
    """The words of a command line, options by their names of this release."""
    names = _NEW | _OF_COMMANDS.get(next(iter(arguments), ""), {})
    out = []
    for word, after in zip_longest(arguments, arguments[1:]):
        old, sign, value = word.partition("=")
        new = names.get(old, (old,))
        if new and old not in new:
            notice(f"{old} is now {' and '.join(new)}; the old name works in this release only")
        out += [name + sign + value for name in new]
        if word == "--json" and (after is None or (after.startswith("-") and after != "-")):
            notice("--json takes a path; - is standard output (without one it works in this release only)")
            out.append("-")
    return out
