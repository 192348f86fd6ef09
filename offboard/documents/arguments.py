"""The options and arguments of a command, checked before they are converted; HOST:PORT."""

from __future__ import annotations

from typing import Any
from urllib.parse import urlsplit

import typer
from typer.core import TyperCommand

from offboard.documents.errors import UserError, shown

FILE = "NAME|FILE"  # the name of a shipped file, or a path
LIVE_PAGE = "127.0.0.1:8014"  # of --live without a value
LOCAL = "127.0.0.1"
USAGE_ERROR: Any = typer.BadParameter.__base__  # an unknown option, too; typer does not export it


def option(metavar: str, text: str, *names: str, **more: Any) -> Any:
    """A command-line option with a value, by default named as its parameter."""
    return typer.Option(*names, metavar=metavar, help=text, **more)


def split_address(name: str, address: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, the value of the option `name`; an IPv6 address stands in
    brackets, no host means this computer. Raises UserError."""
    try:
        parts = urlsplit(f"//{address}")
        host, port = parts.hostname or LOCAL, parts.port
        host.encode("idna")  # no part of it is empty or too long
    except ValueError:
        port = None
    if port is None or parts.netloc != address:
        example = f"give HOST:PORT, for example {LIVE_PAGE}"
        raise UserError(f"{name} {shown(address)}: {example}")
    return host, port


class Command(TyperCommand):
    """A command whose values are neither empty nor options nor bytes that are no text.

    `--connect "$LINK"` of an unset variable is empty, `--out $DIR --sitl` of one takes the next
    option as its value: neither may mean something else.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        following = [*args[1:], "-"]
        args = [  # typer has no option whose value may be omitted
            f"--live={LIVE_PAGE}" if arg == "--live" and after.startswith("-") else arg
            for arg, after in zip(args, following, strict=False)
        ]
        try:
            given, _, parameters = self.make_parser(ctx).parse_args(list(args))
        except USAGE_ERROR as error:  # of the last option without its value: it names no command
            error.ctx = error.ctx or ctx
            raise
        for parameter in parameters:
            is_option = parameter.param_type_name == "option"
            values = given.get(parameter.name)
            for value in values if isinstance(values, list | tuple) else [values]:
                if isinstance(value, str):
                    _check(str(parameter.opts[-1] if is_option else parameter.metavar), value)
        return super().parse_args(ctx, args)


def _check(label: str, value: str) -> None:
    if not value.strip():
        raise UserError(f"{label}: the value is empty; is a variable unset?")
    if value.startswith("--"):
        raise UserError(f"{label}: {shown(value)} is an option, not a value; is a variable unset?")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise UserError(f"{label}: {shown(value)} is not UTF-8") from None
