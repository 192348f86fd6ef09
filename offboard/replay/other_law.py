"""Another control law on the states of a recorded flight: how its commands differ, as figures."""

from __future__ import annotations

import numpy as np

from offboard.replay.difference import compare
from offboard.replay.recording import Recording, ReplayError
from offboard.replay.replaying import Replay
from offboard.replay.shadow import Figures, shadow
from offboard.run.configuration import build_controller, flown


def other_law(recording: Recording, name: str) -> list[str]:
    """Fly the recorded flight again while the controller `name` decides beside it, open loop: the
    vehicle follows the flight's own commands, and the other law has no deadline.

    Returns one line for each figure. Raises ReplayError if there is nothing to compare, and
    DocumentError for a controller that does not exist or cannot be built.
    """
    config = flown(recording.configuration, name)
    other, figures = build_controller(config), Figures()
    replay = Replay(recording, lambda own: shadow(own, other, figures))
    for _ in replay.turns():
        pass
    lines = []
    differences = compare(replay.recorded, replay.replayed).significant
    if differences:
        lines.append(
            f"the replay itself differs from {differences[0].time_s:.3f} s on: see `replay`"
        )
    if figures.failures:
        lines.append(f"{len(figures.failures)} decisions failed, the first: {figures.failures[0]}")
    if figures.others:
        lines.append(f"{figures.others} decisions are no attitude commands, and are not compared")
    if not figures.angle_rad:
        raise ReplayError("; ".join(["nothing to compare", *lines]))
    law, own = config.controller.law, replay.config.controller.law
    return [
        f"{law} beside {own} in {len(figures.angle_rad)} decisions, on the states of the flight",
        _line("thrust direction", np.degrees(figures.angle_rad), "deg"),
        _line("thrust", np.array(figures.thrust_mps2), "m/s2"),
        *lines,
    ]


def _line(name: str, values: np.ndarray[tuple[int], np.dtype[np.float64]], unit: str) -> str:
    rms, most = float(np.sqrt(np.mean(values**2))), float(np.abs(values).max())
    median, high = np.percentile(np.abs(values), (50, 95))
    return (
        f"difference of {name}: rms {rms:.3g}, median {median:.3g}, 95 % {high:.3g}, "
        f"largest {most:.3g} {unit}"
    )
