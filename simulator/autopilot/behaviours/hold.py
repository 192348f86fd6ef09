"""Hold: stay at the place to hold, or fly to the one that a client named."""

from __future__ import annotations

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.firmware.values import Behaviour


class Hold(ActiveBehaviour):
    """PX4 AUTO.LOITER; ArduCopter BRAKE and CIRCLE."""

    def keeps_place(self, following: Behaviour) -> bool:
        """A repeated request does not stop a vehicle that flies to a named place."""
        return following is Behaviour.HOLD and self.guidance.hold.faces_way
