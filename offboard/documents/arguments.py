"""Options and arguments of a command, checked before typer converts them; HOST:PORT addresses."""

from __future__ import annotations

from typing import Any
from urllib.parse import urlsplit

import typer
from typer.core import TyperCommand

from offboard.documents.errors import UserError, shown

FILE = "NAME|FILE"  # the name of a shipped file, or a path
LIVE_PAGE = "127.0.0.1:8014"  # HOST:PORT for --live without a value
LOCAL = "127.0.0.1"
USAGE_ERROR: Any = typer.BadParameter.__base__  # base of all usage errors; typer does not export it


def option(metavar: str, text: str, *names: str, **more: Any) -> Any:
    """Declare a command-line option that has a value. Without `names` it is named as its
    parameter."""
    return typer.Option(*names, metavar=metavar, help=text, **more)


def split_address(name: str, address: str) -> tuple[str, int]:
    """Host and port of `address`, HOST:PORT, which is the value of the option `name`. An IPv6
    address is in brackets; without a host it is this computer. Raises UserError."""
    try:
        parts = urlsplit(f"//{address}")
        host, port = parts.hostname or LOCAL, parts.port
        host.encode("idna")  # fails if a label of the host name is empty or too long
    except ValueError:
        port = None
    if port is None or parts.netloc != address:
        example = f"give HOST:PORT, for example {LIVE_PAGE}"
        raise UserError(f"{name} {shown(address)}: {example}")
    return host, port


class Command(TyperCommand):
    """A command that refuses values which are empty, begin with `--`, or are not UTF-8.

    If a shell variable is unset, `--connect "$LINK"` has an empty value, and `--out $DIR --sitl`
    takes the next option as its value: both must be errors.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        following = [*args[1:], "-"]
        args = [  # typer does not support an option whose value may be omitted
            f"--live={LIVE_PAGE}" if arg == "--live" and after.startswith("-") else arg
            for arg, after in zip(args, following, strict=False)
        ]
        try:
            given, _, parameters = self.make_parser(ctx).parse_args(list(args))
        except USAGE_ERROR as error:  # if the last option lacks its value, the error has no context
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
