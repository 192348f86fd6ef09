"""What the vehicle does in its modes: one module per behaviour, and the table of them.

To add one: a member of `simulator.firmware.values.Behaviour`, a module here with a subclass of
`ActiveBehaviour`, a row below, and a row in the mode table of a firmware.
"""

from __future__ import annotations

from collections.abc import Mapping

from simulator.autopilot.behaviours.base import ActiveBehaviour, Control
from simulator.autopilot.behaviours.hold import Hold
from simulator.autopilot.behaviours.land import Land
from simulator.autopilot.behaviours.manual import LastDemand, LevelAtLeastThrottle
from simulator.autopilot.behaviours.mission import FlyMission
from simulator.autopilot.behaviours.return_ import Return
from simulator.autopilot.behaviours.setpoint import FollowSetpoint
from simulator.autopilot.behaviours.sticks import FlyBySticks
from simulator.autopilot.behaviours.takeoff import Takeoff
from simulator.firmware.values import Behaviour

__all__ = ["BEHAVIOURS", "ActiveBehaviour", "Control"]

BEHAVIOURS: Mapping[Behaviour, type[ActiveBehaviour]] = {
    Behaviour.HOLD: Hold,
    Behaviour.TAKEOFF: Takeoff,
    Behaviour.LAND: Land,
    Behaviour.RETURN: Return,
    Behaviour.MISSION: FlyMission,
    Behaviour.DESCEND: FlyBySticks,
    Behaviour.LEVEL: LevelAtLeastThrottle,
    Behaviour.COAST: LastDemand,
    Behaviour.SETPOINT: FollowSetpoint,
}
