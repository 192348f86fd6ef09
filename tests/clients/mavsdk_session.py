"""A pilot's session by MAVSDK: connects, flies twice, and prints one line of JSON per step.

It does not depend on the simulator: `python mavsdk_session.py udpin://127.0.0.1:14540` flies a real
PX4 SITL too. With `--short` it only takes off and lands.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncGenerator, Callable
from typing import Any

from mavsdk import ComponentType
from mavsdk.asyncio import Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.mission import MissionAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.mission import MissionItem, MissionPlan
from mavsdk.plugins.offboard import Attitude, PositionNedYaw, VelocityNedYaw
from mavsdk.plugins.telemetry import FlightMode, LandedState

HOVER = 0.4895


def say(step: str, *values: Any) -> None:
    print(json.dumps({"step": step, "values": values}), flush=True)


async def until(updates: AsyncGenerator[Any, None], holds: Callable[[Any], bool], s: float) -> Any:
    """Return the first update for which `holds` is true, within `s` seconds."""

    async def first() -> Any:
        async for update in updates:
            if holds(update):
                return update
        raise AssertionError("the updates ended")

    return await asyncio.wait_for(first(), s)


class Session:
    def __init__(self, system: Any) -> None:
        self.action = ActionAsync(system)
        self.info = InfoAsync(system)
        self.mission = MissionAsync(system)
        self.offboard = OffboardAsync(system)
        self.param = ParamAsync(system)
        self.telemetry = TelemetryAsync(system)

    async def mode(self, mode: FlightMode, limit_s: float) -> None:
        await until(self.telemetry.subscribe_flight_mode(), lambda now: now == mode, limit_s)
        say("mode", mode.name)

    async def become_healthy(self) -> None:
        await until(self.telemetry.subscribe_health(), lambda health: health.is_armable, 60.0)
        await until(self.telemetry.subscribe_health_all_ok(), bool, 20.0)
        version = await self.info.get_version()
        say("healthy", version.flight_sw_major, version.flight_sw_minor, version.flight_sw_patch)

    async def parameters(self) -> None:
        param = self.param
        timeout_s = await param.get_param_float("COM_OF_LOSS_T")
        action = await param.get_param_int("COM_OBL_RC_ACT")
        await param.set_param_float("COM_OF_LOSS_T", 1.5)
        await param.set_param_int("COM_OBL_RC_ACT", 5)
        changed = (
            await param.get_param_float("COM_OF_LOSS_T"),
            await param.get_param_int("COM_OBL_RC_ACT"),
        )
        await param.set_param_float("COM_OF_LOSS_T", timeout_s)
        await param.set_param_int("COM_OBL_RC_ACT", action)
        say("parameters", timeout_s, action, *changed, await self.action.get_takeoff_altitude())
        assert len((await param.get_all_params()).float_params) > 10

    async def take_off(self) -> None:
        await self.action.arm()
        await until(self.telemetry.subscribe_armed(), bool, 5.0)
        await self.action.takeoff()
        await until(self.telemetry.subscribe_in_air(), bool, 15.0)
        say("in the air")
        await self.mode(FlightMode.HOLD, 30.0)
        say("took off", (await self.telemetry.position()).relative_altitude_m)

    async def fly_offboard(self) -> None:
        offboard, telemetry = self.offboard, self.telemetry
        await telemetry.set_rate_position_velocity_ned(20.0)
        await offboard.set_attitude(Attitude(0.0, 0.0, 0.0, HOVER))
        await offboard.start()
        await self.mode(FlightMode.OFFBOARD, 5.0)
        await offboard.set_attitude(Attitude(5.0, 0.0, 0.0, HOVER))
        await asyncio.sleep(1.0)
        say("attitude", (await telemetry.attitude_euler()).roll_deg)
        await offboard.set_velocity_ned(VelocityNedYaw(1.0, 0.0, 0.0, 0.0))
        await asyncio.sleep(2.5)
        say("velocity", (await telemetry.velocity_ned()).north_m_s)
        await offboard.set_position_ned(PositionNedYaw(1.0, 2.0, -4.0, 90.0))
        await asyncio.sleep(6.0)
        position = (await telemetry.position_velocity_ned()).position
        say("position", position.north_m, position.east_m, position.down_m)
        await offboard.stop()
        await self.mode(FlightMode.HOLD, 5.0)

    async def land(self) -> None:
        await self.action.land()
        await self.mode(FlightMode.LAND, 5.0)
        await self.down()

    async def down(self) -> None:
        state = LandedState.ON_GROUND
        await until(self.telemetry.subscribe_landed_state(), lambda now: now == state, 60.0)
        await until(self.telemetry.subscribe_armed(), lambda armed: not armed, 10.0)
        say("landed and disarmed")

    async def fly_mission(self) -> None:
        """Fly again in the same process: upload and download a mission, fly two points, return."""
        home = await self.telemetry.home()
        items = [
            MissionItem(
                latitude_deg=home.latitude_deg + north * 1e-5,
                longitude_deg=home.longitude_deg,
                relative_altitude_m=5.0,
                speed_m_s=4.0,
                is_fly_through=True,
                camera_action=MissionItem.CameraAction.NONE,
                vehicle_action=MissionItem.VehicleAction.NONE,
                acceptance_radius_m=1.0,
            )
            for north in (0.0, 9.0)
        ]
        await self.mission.set_return_to_launch_after_mission(True)
        await self.mission.upload_mission(MissionPlan(items))
        say("mission", len((await self.mission.download_mission()).mission_items))
        await self.action.arm()
        await self.mission.start_mission()
        await self.mode(FlightMode.MISSION, 5.0)
        progress = self.mission.subscribe_mission_progress()
        done = await until(progress, lambda now: now.current == now.total, 60.0)
        say("progress", done.current, done.total)
        await self.mode(FlightMode.RETURN_TO_LAUNCH, 20.0)
        position = (await self.telemetry.position_velocity_ned()).position
        say("far end", position.north_m)
        await self.down()


async def main(url: str, *, short: bool) -> None:
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    async with Mavsdk(configuration) as mavsdk:
        await mavsdk.add_any_connection(url)
        session = Session(await mavsdk.first_autopilot(timeout_s=20.0))
        say("found")
        await session.become_healthy()
        await session.parameters()
        await session.take_off()
        if not short:
            await session.fly_offboard()
        await session.land()
        if not short:
            await session.fly_mission()


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], short="--short" in sys.argv))
