"""Which vehicles are flown, by the MAV_TYPE in their HEARTBEAT: by `fly` and by the service."""

from __future__ import annotations

import pytest
from faults import heartbeats, stop
from pair import STEP_S, Bytes, Pair, in_phase
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from serving import serve
from watch import Vehicle, copter, flown, px4, refused

from offboard.flight.phases import Phase
from offboard.mavlink.session import Session, SessionSettings

FIXED_WING, HELICOPTER, HEXAROTOR, TRACKER = 1, 4, 13, 5
NOT_FLOWN = "the vehicle is a FIXED_WING; offboard flies multirotors"


@pytest.mark.parametrize(
    ("kind", "airframe", "says"),
    [
        (FIXED_WING, "", NOT_FLOWN),
        (HELICOPTER, "", r".*\(airframe: helicopter in its vehicle file flies it\)"),
        (HEXAROTOR, "helicopter", "the vehicle is a HEXAROTOR; its vehicle file says airframe"),
        (HELICOPTER, "helicopter", ""),
    ],
)
def test_only_multirotors_are_flown(kind: int, airframe: str, says: str) -> None:
    file = px4.hop().companion.model
    pair = px4.hop(
        down=heartbeats(type=kind),
        believed=file.model_copy(update={"airframe": airframe}) if airframe else None,
        at=[(in_phase(Phase.STREAM, 0.1), stop)],
    )
    refused(pair, says)
    assert pair.went_through(Phase.STREAM) is not bool(says)
    if says:
        assert pair.modes == pair.armings == pair.setpoints == []


def test_a_heartbeat_with_the_vehicles_ids_that_is_no_autopilots_counts_for_nothing() -> None:
    """A gimbal that is set to component 1. Its mode was taken for the pilot's."""
    gimbal = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    beat = mavlink.MAVLink_heartbeat_message(26, 8, 0, 0, 4, 3).pack(gimbal)

    def spoil(flying: Pair) -> None:
        flying.down = lambda time_s, datagrams: [*datagrams, beat]

    flown(px4.hover(at=[(in_phase(Phase.TRACK, 0.5), spoil)]))


def test_the_service_leaves_another_vehicle_alone() -> None:
    """The modes of a plane have other numbers: what looks like OFFBOARD or GUIDED is none."""
    pair, plane = serve(on="ardupilot", aloft=True), heartbeats(type=FIXED_WING)
    pair.until(lambda: pair.phase is Phase.STANDBY)
    pair.down = lambda time_s, datagrams: plane(time_s, pair.deliver(time_s, datagrams))
    pair.restart()
    pair.run(5.0)
    pair.switch("engage")
    pair.run(3.0)
    assert pair.phase is Phase.HEALTH
    assert pair.said(f"waiting: {NOT_FLOWN}")
    assert pair.mode == "GUIDED"


def test_what_is_no_vehicle_is_never_taken_for_one() -> None:
    """Also where it names an autopilot and has its component id."""
    for kind in (TRACKER, 6, 18, 26, 27, 30):
        codec = mavlink.MAVLink(None, srcSystem=2, srcComponent=1)
        session = Session(SessionSettings())
        frame = mavlink.MAVLink_heartbeat_message(kind, 3, 0, 0, 4, 3).pack(codec)
        assert session.receive(frame, "link", 0.0).events == ()
        assert session.senders.systems == {}


@pytest.mark.parametrize("on", [px4, copter], ids=str)
def test_of_two_vehicles_with_the_same_ids_on_one_radio_none_is_armed(on: Vehicle) -> None:
    """Both obey: the other one was flown too, by setpoints that were not made for it."""
    pair, twin = on.hop(), on.hop(seed=8).instance
    for _ in range(int(5.0 / STEP_S)):  # it was switched on earlier
        twin.step()

    def obeyed_by_both(_: float, frames: Bytes) -> Bytes:
        for frame in frames:
            twin.feed(frame)
        return frames

    pair.down, pair.up = lambda _, datagrams: [*datagrams, *twin.step()], obeyed_by_both
    refused(pair, "two vehicles with the same system id send on this link")
    assert not pair.armed
    assert not twin.autopilot.commander.armed
