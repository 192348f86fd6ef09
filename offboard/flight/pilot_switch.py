"""Whether the pilot has engaged us: switched the vehicle, in the air, to the mode of setpoints.

From a mode that was shown without a failsafe. For the service, which does not ask for that mode.

After a failsafe PX4 returns to OFFBOARD by itself as soon as setpoints arrive: that is no switch.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class PilotSwitch:
    """The reported modes of one vehicle while it is not ours.

    `elsewhere`: a HEARTBEAT has shown another mode than that of setpoints, without a failsafe.
    `engaged`: from there it was switched to the mode of setpoints, in the air. `unclaimed`: since
    the service began, or the vehicle rebooted, it has shown the mode of setpoints only, in the air.
    `hasty`: it left that mode and returned, in the air, before a HEARTBEAT could show the other one
    without a failsafe. `showed_ours`: whether the previous report showed the mode of setpoints;
    None after a failsafe, which may have changed it.
    """

    elsewhere: bool = False
    engaged: bool = False
    unclaimed: bool = False
    hasty: bool = False
    showed_ours: bool | None = None

    def on_heartbeat(self, *, ours: bool, failsafe: bool) -> None:
        """A HEARTBEAT shows the mode of setpoints (`ours`) or another one."""
        if failsafe:
            self.elsewhere = self.engaged = self.hasty = False
            self.showed_ours = None
        elif not ours:
            self.elsewhere = True

    def on_mode(self, *, ours: bool, in_the_air: bool, flies: bool) -> None:
        """Any report of the mode, before `on_heartbeat` of the same message. Only a vehicle that
        `flies` by every sign (`GroundContact.flies`) is engaged."""
        if not (ours and in_the_air):
            self.unclaimed = False
        if not ours:
            self.engaged = self.hasty = False
        elif self.elsewhere:
            self.elsewhere, self.engaged = False, flies
        elif self.showed_ours is False:
            self.hasty = in_the_air
        self.showed_ours = ours
