"""The arguments of a command, checked before they are converted."""

from __future__ import annotations

import re
from typing import Any

from typer import BadParameter
from typer.core import TyperCommand

from offboard.documents.command_line import INTERRUPT, INTERRUPTED
from offboard.documents.errors import UserError, shown

UsageError: Any = BadParameter.__base__  # an unknown option, too; typer does not export it
LIVE_PAGE = "127.0.0.1:8014"
# options whose value may be omitted, and what they then have
OPTIONAL_VALUES = {"--live": LIVE_PAGE}
PORT_MAX = 65535
LOCAL = "127.0.0.1"
_ADDRESS = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([^:\[\]]*)):(\d{1,9})", re.ASCII)


def split_address(option: str, address: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, the value of `option`; an IPv6 address stands in brackets, no
    host means this computer. Raises UserError."""
    matched = _ADDRESS.fullmatch(address)
    if matched is None or int(matched[3]) > PORT_MAX or not _is_host(matched[2] or LOCAL):
        example = f"give HOST:PORT, for example {LIVE_PAGE}"
        raise UserError(f"{option} {shown(address)}: {example}")
    return matched[1] or matched[2] or LOCAL, int(matched[3])


def _is_host(name: str) -> bool:
    """Whether the name service takes it: no part of it is empty or too long."""
    try:
        return bool(name.encode("idna"))
    except UnicodeError:
        return False


def join_address(host: str, port: int) -> str:
    """HOST:PORT, as a URL has it."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


class Command(TyperCommand):
    """A command whose values are neither empty nor options nor bytes that are no text.

    `--connect "$LINK"` of an unset variable is empty, `--out $DIR --sitl` of one takes the next
    option as its value: neither may mean something else.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        try:
            return self._parsed(ctx, _completed(args))
        except UsageError as error:
            words = error.format_message().replace("Value error, ", "").split()
            sentence = " ".join(words).rstrip(".")
            raise UserError(f"{sentence}; see `{ctx.command_path} --help`") from None

    def _parsed(self, ctx: Any, args: list[str]) -> list[str]:
        given, _, parameters = self.make_parser(ctx).parse_args(list(args))
        for parameter in parameters:
            values = given.get(parameter.name)
            for value in values if isinstance(values, (list, tuple)) else [values]:
                if isinstance(value, str):
                    _check(_label(parameter), value)
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise UserError(INTERRUPTED, INTERRUPT) from None


def _completed(args: list[str]) -> list[str]:
    """The arguments with the values that were omitted."""
    completed: list[str] = []
    for arg, following in zip(args, [*args, "-"][1:], strict=True):
        completed.append(arg)
        if arg in OPTIONAL_VALUES and following.startswith("-"):
            completed.append(OPTIONAL_VALUES[arg])
    return completed


def _label(parameter: Any) -> str:
    """`--connect`, `FLIGHT`."""
    return str(parameter.opts[-1] if parameter.param_type_name == "option" else parameter.metavar)


def _check(label: str, value: str) -> None:
    if not value.strip():
        raise UserError(f"{label}: the value is empty; is a variable unset?")
    if value.startswith("--"):
        raise UserError(f"{label}: {shown(value)} is an option, not a value; is a variable unset?")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise UserError(f"{label}: {shown(value)} is not UTF-8") from None
