"""What compiled code reads, beside the plant's record, to write messages; kept up to date here.

Knows the view of one vehicle; how the messages lie in their frames is
`simulator.mavlink.payloads`'.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from offboard.model.kernel import address
from simulator.firmware.setpoints import MotionSetpoint
from simulator.mavlink.fields import motion_fields
from simulator.mavlink.view import View
from simulator.vehicle.attitude import Demand

# What changes now and then; `sensors`: MAV_SYS_STATUS_SENSOR bits, present, enabled, healthy
_STATE = [
    ("clock_offset_us", "i8"),
    ("resets", "i8"),
    ("home_down_m", "f8"),
    ("sensors", "i8", 3),
    ("has_fix", "i8"),
    ("landed_state", "i8"),
]
_NAMES = tuple(field[0] for field in _STATE)
RECORD = np.dtype(
    [
        ("system", "i8"),
        ("origin", "f8", 3),
        ("east_degrees_per_m", "f8"),
        # cells, capacity A s, share at boot, resistance, current and thrust in hover
        ("battery", "f8", 6),
        *_STATE,
        # what is demanded of the attitude loop and of the position loop
        ("attitude", "f8", 4),
        ("rates_radps", "f8", 3),
        ("thrust", "f8"),  # before it is raised for the tilt
        ("throttle", "f8"),
        ("motion", "f8", 11),
    ],
    align=True,
)


class Seen:
    """The record of one view."""

    def __init__(self, view: View) -> None:
        self._view = view
        self._record = record = np.zeros(1, RECORD)
        self.address = address(record)
        record["system"] = view.system
        record["origin"] = view.autopilot.firmware.origin
        record["east_degrees_per_m"] = view.east_degrees_per_m
        record["battery"] = view.autopilot.plant.pack.constants
        self._state: tuple[Any, ...] = ()
        self._motion: MotionSetpoint | None = None
        self._demand: Demand | None = None

    def note(self) -> None:
        """Bring the record up to date."""
        view, record = self._view, self._record
        pilot, navigator = view.autopilot.pilot, view.autopilot.navigator
        state = (
            view.clock_offset_us,
            view.autopilot.plant.reset_counter,
            navigator.home_ned_m[2],
            view.sensor_bits,
            view.has_fix,
            view.landed_state,
        )
        if state != self._state:
            self._state = state
            for name, value in zip(_NAMES, state, strict=True):
                record[name] = value
        if pilot.motion is not self._motion:
            self._motion = pilot.motion
            record["motion"] = motion_fields(pilot.motion)
        record["thrust"] = pilot.thrust_demanded
        if pilot.demand is not self._demand:
            self._demand = demand = pilot.demand
            record["throttle"] = demand.thrust
            record["attitude"] = demand.attitude or (1.0, 0.0, 0.0, 0.0)
            record["rates_radps"] = demand.rates_frd_radps or (0.0, 0.0, 0.0)
