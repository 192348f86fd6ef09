"""The vehicle's parameters: a typed table, its values, and their form on the wire.

Knows names, kinds and ranges from the firmware's data; knows no socket.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping

from simulator.firmware.base import Firmware, ParameterSpec, Role

HASH = "_HASH_CHECK"  # a parameter that is none: what all values come to
MAV_PARAM_TYPE_UINT32 = 5
MAV_PARAM_TYPE = {"int8": 2, "int16": 4, "int32": 6, "real32": 9}
WHOLE = {"int8": (-128, 127), "int16": (-32768, 32767), "int32": (-(2**31), 2**31 - 1)}
_FLOAT, _INT = struct.Struct("<f"), struct.Struct("<i")


class ParameterTable:
    """Values by name, in the firmware's order. `role` reads one by what it is for."""

    def __init__(self, firmware: Firmware) -> None:
        self._specs = {spec.name: spec for spec in firmware.parameters}
        self._values = {spec.name: spec.default for spec in firmware.parameters}
        self._roles: Mapping[str, Role] = firmware.parameter_roles
        self._bytewise = firmware.link.parameters_bytewise
        self.names = tuple(self._specs)
        self.changes = 0

    def __contains__(self, name: object) -> bool:
        return name in self._specs

    def __getitem__(self, name: str) -> float:
        """What the vehicle obeys: the value, brought into its range."""
        spec, value = self._specs[name], self._values[name]
        if value != value:  # not a number
            return spec.default
        return min(spec.maximum, max(spec.minimum, value))

    def role(self, role: str) -> float:
        """What this firmware has for `role`, in SI units."""
        filler = self._roles[role]
        if isinstance(filler, str):
            return self[filler]
        if isinstance(filler, tuple):
            return self[filler[0]] * filler[1]
        return filler

    def _takes(self, spec: ParameterSpec | None, value: float) -> bool:
        return spec is not None and spec.minimum <= value <= spec.maximum

    def set(self, name: str, value: float) -> bool:
        """Set one; False (and unchanged) when unknown, not finite or out of range."""
        spec = self._specs.get(name)
        if spec is None or not self._takes(spec, value):
            return False
        self._keep(spec, value)
        return True

    def _keep(self, spec: ParameterSpec, value: float) -> None:
        self.changes += 1
        if spec.kind == "real32":
            self._values[spec.name] = value
        elif math.isfinite(value):
            low, high = WHOLE[spec.kind]
            self._values[spec.name] = float(min(high, max(low, int(value))))

    def takes(self, name: str, wire: float) -> bool:
        """Whether `set_from_wire` would set it."""
        return self._takes(self._specs.get(name), self._from_wire(name, wire))

    def set_from_wire(self, name: str, wire: float, kind: int) -> bool:
        """Set from PARAM_SET, out of range too; False when it is not taken, and not answered.

        An integer comes as its bytes, and then its type must fit, or as its value, and then no
        type matters but what is not a number is not taken.
        """
        spec = self._specs.get(name)
        if spec is None or (self._bytewise and kind != MAV_PARAM_TYPE[spec.kind]):
            return False
        if not self._bytewise and wire != wire:
            return False
        self._keep(spec, self._from_wire(name, wire))
        return True

    def _from_wire(self, name: str, wire: float) -> float:
        spec = self._specs.get(name)
        if spec is not None and self._is_bytewise(spec):
            return float(_INT.unpack(_FLOAT.pack(wire))[0])
        return wire

    def to_wire(self, name: str) -> tuple[float, int]:
        """(param_value, param_type) of PARAM_VALUE."""
        spec, value = self._specs[name], self._values[name]
        if self._is_bytewise(spec):
            value = _FLOAT.unpack(_INT.pack(int(value)))[0]
        return value, MAV_PARAM_TYPE[spec.kind]

    @property
    def hash_on_wire(self) -> float:
        """CRC-32 (no inversion) of names and values, by which clients know a table again."""
        crc = 0
        for name, spec in self._specs.items():
            value = self._values[name]
            data = _FLOAT.pack(value) if spec.kind == "real32" else _INT.pack(int(value))
            crc = zlib.crc32(name.encode() + data, crc ^ 0xFFFFFFFF) ^ 0xFFFFFFFF
        number: float = _FLOAT.unpack(struct.pack("<I", crc))[0]
        return number

    def _is_bytewise(self, spec: ParameterSpec) -> bool:
        return self._bytewise and spec.kind != "real32"
