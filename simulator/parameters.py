"""The vehicle's parameters: a typed table, its values, and their form on the wire.

Knows names, kinds and ranges from the firmware's data; knows no socket.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

from simulator.firmware.base import Firmware, ParameterSpec

MAV_PARAM_TYPE = {"int32": 6, "real32": 9}
_FLOAT, _INT = struct.Struct("<f"), struct.Struct("<i")


class ParameterTable:
    """Values by name, in the firmware's order. `role` reads one by what it is for."""

    def __init__(self, firmware: Firmware) -> None:
        self._specs = {spec.name: spec for spec in firmware.parameters}
        self._values = {spec.name: spec.default for spec in firmware.parameters}
        self._roles: Mapping[str, str] = firmware.parameter_roles
        self._bytewise = firmware.parameters_bytewise
        self.names = tuple(self._specs)

    def __contains__(self, name: object) -> bool:
        return name in self._specs

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def role(self, role: str) -> float:
        """Value of the parameter that plays `role` in this firmware."""
        return self._values[self._roles[role]]

    def set(self, name: str, value: float) -> bool:
        """Set one; False (and unchanged) when unknown, not finite or out of range."""
        spec = self._specs.get(name)
        if spec is None or not math.isfinite(value):
            return False
        if not spec.minimum <= value <= spec.maximum:
            return False
        self._values[name] = float(round(value)) if spec.kind == "int32" else value
        return True

    def set_from_wire(self, name: str, wire: float) -> bool:
        """Set from PARAM_SET.param_value, which carries an integer as its bytes or its value."""
        spec = self._specs.get(name)
        if spec is not None and self._is_bytewise(spec):
            return self.set(name, float(_INT.unpack(_FLOAT.pack(wire))[0]))
        return self.set(name, wire)

    def to_wire(self, name: str) -> tuple[float, int]:
        """(param_value, param_type) of PARAM_VALUE."""
        spec, value = self._specs[name], self._values[name]
        if self._is_bytewise(spec):
            value = _FLOAT.unpack(_INT.pack(int(value)))[0]
        return value, MAV_PARAM_TYPE[spec.kind]

    def _is_bytewise(self, spec: ParameterSpec) -> bool:
        return self._bytewise and spec.kind == "int32"
