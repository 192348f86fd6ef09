"""Parameter protocol of one link: read, list, set.

Knows messages; values and their ranges are in `simulator.autopilot.parameters`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from simulator.autopilot.parameters import HASH, MAV_PARAM_TYPE_UINT32
from simulator.mavlink.codec import Message
from simulator.mavlink.outbox import Outbox

PER_STEP = 4  # parameters of a list
NO_INDEX = 65535  # PARAM_VALUE.param_index of an answer without one


@dataclass(slots=True)
class ParameterTransfer:
    """Parameter transfers of one link."""

    outbox: Outbox
    _due: list[str] = field(default_factory=list)

    def handle(self, message: Message) -> None:
        """Handle one message of the parameter protocol addressed to this vehicle."""
        HANDLERS[message.get_type()](self, message)

    def step(self) -> None:
        """Queue the next parameters of a requested list."""
        if not self._due:
            return
        for name in self._due[:PER_STEP]:
            self._answer(name, listed=True)
        del self._due[:PER_STEP]

    def _answer(self, name: str, *, listed: bool = False) -> None:
        """Queue PARAM_VALUE; `listed`: as part of a list or requested by index."""
        autopilot = self.outbox.view.autopilot
        if name == HASH:
            head = (HASH.encode(), autopilot.parameters.hash_on_wire, MAV_PARAM_TYPE_UINT32)
            self.outbox.send("PARAM_VALUE", *head, len(autopilot.parameters.names), NO_INDEX)
            return
        value, kind = autopilot.parameters.to_wire(name)
        names = autopilot.parameters.names
        numbered = listed or autopilot.firmware.parameters_numbered
        index = names.index(name) if numbered else NO_INDEX
        self.outbox.send("PARAM_VALUE", name.encode(), value, kind, len(names), index)

    def _read(self, message: Message) -> None:
        names = self.outbox.view.autopilot.parameters.names
        if message.param_index >= 0:
            if message.param_index < len(names):
                self._answer(names[message.param_index], listed=True)
        elif message.param_id in names or self._is_hash(message.param_id):
            self._answer(message.param_id)

    def _is_hash(self, name: str) -> bool:
        return name == HASH and self.outbox.view.autopilot.firmware.parameters_hashed

    def _list(self, _: Message) -> None:
        hashed = (HASH,) if self._is_hash(HASH) and not self._due else ()
        self._due = [*hashed, *self.outbox.view.autopilot.parameters.names]

    def _set(self, message: Message) -> None:
        table = self.outbox.view.autopilot.parameters
        if self._is_hash(message.param_id):  # the client has the whole list already
            self._due = []
        if table.set_from_wire(message.param_id, message.param_value, message.param_type):
            self._answer(message.param_id)


HANDLERS: dict[str, Callable[[ParameterTransfer, Message], None]] = {
    "PARAM_REQUEST_READ": ParameterTransfer._read,
    "PARAM_REQUEST_LIST": ParameterTransfer._list,
    "PARAM_SET": ParameterTransfer._set,
}
