"""The wire, both ways: the only place that converts units, frames, quaternions and thrust.

`decode` (inbound.py) turns the payload of a verified frame into an event or says why not; `encode`
(outbound.py) turns a value of outgoing.py into a message id and payload. Import from here.
"""

from offboard.mavlink.decode import Address, decode
from offboard.mavlink.encode import Packed, encode, normalised_thrust
from offboard.mavlink.outgoing import (
    AttitudeTarget,
    CommandLong,
    Heartbeat,
    Outgoing,
    ParamRead,
    ParamSet,
    PositionTarget,
    Record,
    ReferenceRecord,
    SolverRecord,
    StatusTextOut,
    Timesync,
)

__all__ = [
    "Address",
    "AttitudeTarget",
    "CommandLong",
    "Heartbeat",
    "Outgoing",
    "Packed",
    "ParamRead",
    "ParamSet",
    "PositionTarget",
    "Record",
    "ReferenceRecord",
    "SolverRecord",
    "StatusTextOut",
    "Timesync",
    "decode",
    "encode",
    "normalised_thrust",
]
