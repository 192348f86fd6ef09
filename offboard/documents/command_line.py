"""Runs the command `offboard` or `simulator`, and prints the error that ends it as one sentence.

The console scripts import this module first, and this module imports the command. So an interrupt
during that import is handled, too.
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

USAGE, INTERRUPT, CLOSED_PIPE = 2, 130, 141  # exit codes; the last two are 128 + the signal
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def run(module: str, arguments: list[str] | None = None) -> NoReturn:
    """Import `app` from `module`, call it with `arguments` (default: those of this process), and
    exit.

    An error is printed as a sentence without a traceback. The exit code is `code` for a UserError;
    2 for wrong options, a lack of memory, and errors of files or of the output; 130 for an
    interrupt. If the reader of the output has closed the pipe (`| head -1`), the exit code is 141
    and nothing is printed.
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:  # the parent process has closed it
            setattr(sys, name, open(os.devnull, "r+"))  # noqa: SIM115
    # python-control imports matplotlib, which would warn about a HOME that cannot be written
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    # escape characters that the encoding of the output does not have
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    sentence, code = "", 0
    try:
        _call(module, sys.argv[1:] if arguments is None else arguments)
    except BaseException as error:
        sentence, code = told(error)
    try:
        sys.stdout.flush()
    except OSError as error:
        drop(sys.stdout)
        said, failed = told(error)
        sentence, code = sentence or said, code or failed
    if sentence:
        complain(sentence)
    raise SystemExit(code)


def _call(module: str, arguments: list[str]) -> None:
    """Invoke the command, but not by calling `app`, which would print errors itself and exit."""
    from typer.main import get_command

    command = get_command(import_module(module).app)
    with command.make_context(module.partition(".")[0], list(arguments)) as context:
        command.invoke(context)


def told(error: BaseException) -> tuple[str, int]:
    """Sentence and exit code for the error that ended a command. Any other exception is a bug and
    is raised again."""
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
    """Print `text` to stderr, as `tell` does. An error of stderr is ignored, so that it does not
    change the exit code."""
    try:
        tell(text, sys.stderr)
    except OSError:
        drop(sys.stderr)


def tell(text: str, file: TextIO) -> None:
    """Print `text` to `file` and flush. On a terminal, lines are wrapped between words."""
    if file.isatty():
        width = shutil.get_terminal_size().columns
        text = "\n".join(wrapped(line, width, 2) for line in text.splitlines())
    print(text, file=file, flush=True)


def wrapped(text: str, width: int, indent: int) -> str:
    """`text` wrapped between words to `width` columns; continuation lines are indented by `indent`.
    Paths and other long words are not broken, so that they can be copied."""
    return textwrap.fill(
        text,
        max(width, 1),  # COLUMNS=0
        subsequent_indent=indent * " ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def explained(error: OSError) -> str:
    """The sentence for an error of the operating system."""
    reason = error.strerror or str(error)
    if error.filename is not None:
        return f"{abridged(error.filename)}: {reason}"
    if error.errno in DISK_ERRORS:
        return f"the output cannot be written: {reason}"
    return f"refused by the operating system: {reason}"


def drop(output: TextIO) -> None:
    """Redirect `output`, on which an error has occurred, to /dev/null."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), output.fileno())
