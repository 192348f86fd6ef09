"""Running a command, `offboard` or `simulator`: what ends it is one sentence and an exit code.

The console scripts import this first, and it imports the command: an interrupt meanwhile is
answered, too.
"""

from __future__ import annotations

import errno
import logging
import os
import shutil
import sys
import textwrap
from importlib import import_module
from typing import NoReturn, TextIO

from offboard.documents.errors import UserError, abridged

USAGE, INTERRUPT, CLOSED_PIPE = 2, 130, 141  # exit codes; the last two as of SIGINT and SIGPIPE
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def run(module: str, arguments: list[str] | None = None) -> NoReturn:
    """Import the `app` of a module, call it with these arguments, by default those of this process,
    and exit.

    A UserError is printed without a traceback and exits with its `code`; wrong options, a lack of
    memory, and an error of a file or of the output, with 2; an interrupt with 130. Where nobody
    reads the output any more (`| head -1`), the exit code is 141 without a sentence.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # whoever started it has closed it
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    # python-control imports it; it would warn of a HOME that cannot be written
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    # text that the encoding of the output does not have is escaped
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    sentence, code = "", 0
    try:
        _call(module, sys.argv[1:] if arguments is None else arguments)
    except BaseException as error:
        sentence, code = _told(error)
    try:
        sys.stdout.flush()
    except OSError as error:
        drop(sys.stdout)
        told, failed = _told(error)
        sentence, code = sentence or told, code or failed
    if sentence:
        complain(sentence)
    raise SystemExit(code)


def _call(module: str, arguments: list[str]) -> None:
    """Not by the `app` itself, which would print errors of its own and exit."""
    from typer.main import get_command

    command = get_command(import_module(module).app)
    with command.make_context(module.partition(".")[0], list(arguments)) as context:
        command.invoke(context)


def _told(error: BaseException) -> tuple[str, int]:
    """Sentence and exit code of what ended a command; a bug is raised again."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", INTERRUPT
    if isinstance(error, BrokenPipeError):
        return "", CLOSED_PIPE
    if isinstance(error, MemoryError):
        return "not enough memory", USAGE
    if isinstance(error, OSError):
        return explained(error), USAGE
    if isinstance(error, UserError):
        return str(error), error.code
    from typer import Exit

    from offboard.documents.arguments import USAGE_ERROR

    if isinstance(error, Exit):
        return "", error.exit_code
    if isinstance(error, USAGE_ERROR):
        words = error.format_message().replace("Value error, ", "").split()
        sentence = " ".join(words).rstrip(".")
        return f"{sentence}; see `{error.ctx.command_path} --help`", USAGE
    raise error


def complain(text: str) -> None:
    """Print to stderr at once; on a terminal each line is wrapped at words to its width. If nobody
    can read it, exit codes stay as they are."""
    try:
        tell(text, sys.stderr)
    except OSError:
        drop(sys.stderr)


def tell(text: str, file: TextIO) -> None:
    """Print to a file at once; on a terminal each line is wrapped at words to its width."""
    if file.isatty():
        width = shutil.get_terminal_size().columns
        text = "\n".join(wrapped(line, width, 2) for line in text.splitlines())
    print(text, file=file, flush=True)


def wrapped(text: str, width: int, indent: int) -> str:
    """A line wrapped at words, further lines indented. Paths and other long words stay whole, so
    that they can be copied."""
    return textwrap.fill(
        text,
        max(width, 1),  # COLUMNS=0
        subsequent_indent=indent * " ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def explained(error: OSError) -> str:
    """A sentence for an error of the operating system."""
    reason = error.strerror or str(error)
    if error.filename is not None:
        return f"{abridged(error.filename)}: {reason}"
    if error.errno in DISK_ERRORS:
        return f"the output cannot be written: {reason}"
    return f"refused by the operating system: {reason}"


def drop(output: TextIO) -> None:
    """Send what is printed there to /dev/null from now on, after an error of it."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), output.fileno())
