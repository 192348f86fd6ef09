"""The file of a campaign: which flights are flown, as a grid, a sample of ranges, or both.

    controllers: [pso, lqr]
    references: [lemniscate]
    scenarios: [calm, px4_like]
    seeds: 5

Keys of `parameters` and ranges are those of `--set`; `scenario.KEY` is a key of the scenario.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from offboard.analysis.score import Requirement
from offboard.documents.errors import UserError
from offboard.documents.parameters import Parameters

CASES_MOST, SEEDS_MOST = 1_000_000, 100_000


def _key(text: str) -> str:
    if not all(part.strip() for part in text.split(".")):
        raise ValueError(f"{text!r} is no key.path")
    return text


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] < ends[1]:
        raise ValueError(f"the range [{ends[0]:g}, {ends[1]:g}] is empty; give [lowest, highest]")
    return ends


def _requirement(text: str) -> str:
    try:
        Requirement.parse(text)
    except UserError as error:
        raise ValueError(str(error)) from None
    return text


def _counted(seeds: Any) -> Any:
    """Return the seeds 1 to N for a number N; a list as it is."""
    if type(seeds) is not int:
        return tuple(seeds) if isinstance(seeds, list) else seeds
    if not 1 <= seeds <= SEEDS_MOST:
        raise ValueError(f"the number of seeds is {seeds}; it must be 1 to {SEEDS_MOST}")
    return tuple(range(1, seeds + 1))


Name = Annotated[str, Field(min_length=1)]
Firmware = Literal["px4", "ardupilot"]
Names = Annotated[tuple[Name, ...], Field(min_length=1)]
Key = Annotated[str, AfterValidator(_key)]
Ends = Annotated[tuple[float, float], AfterValidator(_ordered)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Seeds = Annotated[tuple[Seed, ...], Field(min_length=1), BeforeValidator(_counted)]  # or a number
Ranges = Annotated[dict[Key, Ends], Field(min_length=1)]


class Promises(Parameters):
    """Limits that a flight must keep. `campaign.flight` defines the margin to each of them."""

    error_m: float = Field(default=0.5, gt=0, le=100)
    tilt_deg: float = Field(default=60.0, gt=0, le=90)
    clearance_m: float = Field(default=0.1, gt=0, le=100)
    age_s: float = Field(default=0.5, gt=0, le=10)
    at_bound: float = Field(default=0.5, gt=0, le=1)
    touchdown_mps: float = Field(default=2.0, gt=0, le=20)


class Sample(Parameters):
    """A sample of `draws` points within `ranges`, drawn as a Latin hypercube with `seed`."""

    draws: int = Field(ge=1, le=100_000)
    seed: Seed = 1
    ranges: Ranges


class Search(Parameters):
    """A search for failures (`--worst`) within `ranges`, with `flights` flights and `seed`.

    `defaults` are the values of an undisturbed flight, to which the values of a failure are reset
    one by one. A default that is not given is 0 if that is within the range, else the middle of the
    range. A range named `seed` is a range of the flight's seed, which decides noise and the phase
    of gusts. Each failure is flown again with `seeds` other seeds.
    """

    ranges: Ranges
    defaults: dict[Key, float] = Field(default_factory=dict)
    flights: int = Field(default=500, ge=80, le=100_000)
    seed: Seed = 1
    seeds: int = Field(default=5, ge=1, le=100)

    @model_validator(mode="after")
    def _known(self) -> Self:
        for key, value in self.defaults.items():
            if key not in self.ranges:
                raise ValueError(f"defaults.{key} has no range")
            low, high = self.ranges[key]
            if not low <= value <= high:
                raise ValueError(f"defaults.{key}: {value:g} is not within [{low:g}, {high:g}]")
        return self


class CampaignFile(Parameters):
    """A campaign. It flies every combination of the lists with every draw and every seed.

    Without controllers, references or vehicles, those of `config` are flown; without scenarios, the
    firmware's own. `require` are the requirements that a completed flight must meet, `promises` the
    limits to which the margin is measured. `keep`: whether to keep the log of each flight.
    """

    config: Name = "flight"
    controllers: Names | None = None
    references: Names | None = None
    vehicles: Names | None = None
    sim_vehicles: Names | None = None
    firmwares: Annotated[tuple[Firmware, ...], Field(min_length=1)] = ("px4",)
    scenarios: Names | None = None
    parameters: dict[Key, Annotated[tuple[Any, ...], Field(min_length=1)]] = Field(
        default_factory=dict
    )
    sample: Sample | None = None
    search: Search | None = None
    seeds: Seeds = (1,)
    require: tuple[Annotated[str, AfterValidator(_requirement)], ...] = ()
    promises: Promises = Promises()
    keep: bool = False
