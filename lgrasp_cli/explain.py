"""A failure in one line for the user, with its exit code."""

import errno
import os
import re
import sys

import typer


def explain(error: BaseException) -> tuple[str, int]:
    """One line for the user and the exit code of a failure."""
    from lgrasp.errors import LgraspError, is_out_of_memory

    if isinstance(error, LgraspError):
        return f"error: {error}", error.exit_code
    if type(error).__name__ == "NoArgsIsHelpError":  # no command: its message, the help, is printed already
        return "", 2
    if isinstance(error, typer.TyperException):
        return f"error: {_message(error)}{_extra_word(error)}", error.exit_code
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        return "interrupted", 130
    if isinstance(error, BrokenPipeError) or isinstance(error.__context__, BrokenPipeError):  # nobody reads
        return "", 141
    if isinstance(error, SystemExit):
        return "", error.code if isinstance(error.code, int) else 1
    if is_out_of_memory(error):
        return "error: out of memory; lower --workers, or --batch or --shard-rows if the command has them", 2
    if "can't start new thread" in str(error) or getattr(error, "errno", None) == errno.EAGAIN:
        return "error: no more threads or processes are allowed here (ulimit -u or -v, or a container's limit)", 2
    said = f"{error}: {error.__cause__}" if error.__cause__ else str(error)
    if "failed to map segment" in said:
        return "error: no room for a library in virtual memory (ulimit -v, or a batch system's limit)", 2
    if "cannot open shared object" in said or "Failed to load the shared library" in said:
        return f"error: {said}", 2
    if isinstance(error, FileNotFoundError) and not error.filename and not _has_folder():
        return "error: the current folder is not there any more; change to another one", 2
    if isinstance(error, OSError) and error.errno is not None:
        where = f"{error.filename}: " if error.filename else ""
        if not where and error.strerror == os.strerror(errno.ENOSPC):
            where = "what is printed, or a file in TMPDIR or /dev/shm: "
        hint = "; set TMPDIR to one that can be written" if "temporary directory" in str(error.strerror) else ""
        return f"error: {where}{error.strerror}{hint}", 2
    return f"error: unexpected {type(error).__name__}: {error} (set LGRASP_DEBUG=1 for the traceback)", 1


def _has_folder() -> bool:
    try:
        return bool(os.getcwd())
    except OSError:
        return False


def _message(error: typer.TyperException) -> str:
    """What typer says, with the value that was given."""
    message, cause = error.format_message(), error.__cause__
    if cause is None:
        return message
    from pydantic import ValidationError

    from lgrasp.config import plain_reason

    if not isinstance(cause, ValidationError):
        return message
    (first, *_) = cause.errors()
    return message.replace(error.message, f"{first['input']}: {plain_reason(first)}")


def _extra_word(error: typer.TyperException) -> str:
    """How to give an option several values, for a word too many after one."""
    found = re.search(r"unexpected extra argument\S* \((\S+)", error.format_message())
    context, words = getattr(error, "ctx", None), sys.argv[1:]
    if not found or not context or found[1].rstrip(")") not in words[2:]:
        return ""
    extra = found[1].rstrip(")")
    option, value = words[words.index(extra) - 2 : words.index(extra)]
    known = [each for each in context.command.params if option in each.opts]
    if not known:
        return ""
    several = f": {option} {value} {option} {extra}" if getattr(known[0], "multiple", False) else ""
    return f"; {option} takes one value{several and ', and may be repeated'}{several}"
