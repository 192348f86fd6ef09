"""The vehicle's parameters: values, ranges, and their encoding in PARAM_VALUE and PARAM_SET.

The firmware defines names, types and ranges. Knows no socket.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping

from simulator.autopilot.firmware import RANGES, Firmware, ParameterSpec, Role

HASH = "_HASH_CHECK"  # pseudo-parameter of PX4: checksum of all names and values
MAV_PARAM_TYPE_UINT32 = 5
MAV_PARAM_TYPE = {"int8": 2, "int16": 4, "int32": 6, "real32": 9}
_FLOAT, _INT, _UNSIGNED = struct.Struct("<f"), struct.Struct("<i"), struct.Struct("<I")


class ParameterTable:
    """Parameter values by name, in the firmware's order."""

    def __init__(self, firmware: Firmware) -> None:
        self._specs = {spec.name: spec for spec in firmware.parameters}
        self._values = {spec.name: spec.default for spec in firmware.parameters}
        self._sources: Mapping[str, Role] = firmware.parameter_roles
        self._bytewise = firmware.px4_parameters
        self.names = tuple(self._specs)
        self._take_roles()

    def __contains__(self, name: object) -> bool:
        return name in self._specs

    def __getitem__(self, name: str) -> float:
        """The value that the vehicle uses: limited to its range; the default in place of NaN."""
        spec, value = self._specs[name], self._values[name]
        if math.isnan(value):
            return spec.default
        return min(spec.maximum, max(spec.minimum, value))

    def role(self, role: str) -> float:
        """The value of `role` in this firmware, in SI units."""
        return self._roles[role]

    def _take_roles(self) -> None:
        """Compute the values of all roles; they are stored because each step reads many of them."""
        self._roles = {role: self._read(source) for role, source in self._sources.items()}

    def _read(self, source: Role) -> float:
        if isinstance(source, str):
            return self[source]
        if isinstance(source, tuple):
            return self[source[0]] * source[1]
        return source(self) if callable(source) else source

    def set(self, name: str, value: float) -> bool:
        """Set a parameter. Return False, without a change, if the name is unknown or the value is
        not finite or out of range."""
        spec = self._specs.get(name)
        if spec is None or not spec.minimum <= value <= spec.maximum:
            return False
        self._store(spec, value)
        return True

    def set_from_wire(self, name: str, wire: float, kind: int) -> bool:
        """Set a parameter from PARAM_SET, also out of range. Return False if the message is ignored
        without an answer.

        Where integers are sent as their bytes (PX4), a wrong type is ignored; where they are sent
        as values (ArduPilot), any type is accepted and NaN is ignored.
        """
        spec = self._specs.get(name)
        if spec is None or (self._bytewise and kind != MAV_PARAM_TYPE[spec.kind]):
            return False
        if not self._bytewise and math.isnan(wire):
            return False
        if self._is_bytewise(spec):
            wire = float(_INT.unpack(_FLOAT.pack(wire))[0])
        self._store(spec, wire)
        return True

    def to_wire(self, name: str) -> tuple[float, int]:
        """Return param_value and param_type of PARAM_VALUE."""
        spec, value = self._specs[name], self._values[name]
        if self._is_bytewise(spec):
            value = _FLOAT.unpack(_INT.pack(int(value)))[0]
        return value, MAV_PARAM_TYPE[spec.kind]

    @property
    def hash_on_wire(self) -> float:
        """CRC-32 (without inversion) of names and values, by which a client recognises a table that
        it has stored."""
        crc = 0
        for name, spec in self._specs.items():
            value = self._values[name]
            data = _FLOAT.pack(value) if spec.kind == "real32" else _INT.pack(int(value))
            crc = zlib.crc32(name.encode() + data, crc ^ 0xFFFFFFFF) ^ 0xFFFFFFFF
        number: float = _FLOAT.unpack(_UNSIGNED.pack(crc))[0]
        return number

    def _store(self, spec: ParameterSpec, value: float) -> None:
        if spec.kind == "real32":
            self._values[spec.name] = value
        elif math.isfinite(value):
            low, high = RANGES[spec.kind]
            self._values[spec.name] = float(min(high, max(low, int(value))))
        self._take_roles()

    def _is_bytewise(self, spec: ParameterSpec) -> bool:
        return self._bytewise and spec.kind != "real32"
