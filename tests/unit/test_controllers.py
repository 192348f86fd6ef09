"""The controllers as a table: shipped files, defaults and what all of them promise."""

from __future__ import annotations

import json

import numpy as np
import pytest
from attitude_plant import Lemniscate
from laws import LEVEL, law_named, state_of

from offboard.control.base import Controller, Situation
from offboard.control.catalogue import names, settings_of
from offboard.documents import shipped
from offboard.run.configuration import read_part


def test_every_law_has_a_shipped_file_and_every_file_a_law() -> None:
    files = set(shipped.names("controllers"))
    assert set(names()) == files - {"paper_integral", "paper_limited"}


@pytest.mark.parametrize("law", names())
def test_shipped_file_states_the_defaults(law: str) -> None:
    settings = settings_of(law)
    given = settings.model_validate_json(json.dumps(read_part("controller", law)), strict=True)
    assert given == settings(law=law)


@pytest.mark.parametrize("law", names())
def test_reset_gives_the_decisions_of_a_new_controller(law: str) -> None:
    reference = Lemniscate(8.0)
    states = [state_of(np.random.default_rng(seed), reference, 0.3) for seed in range(3)]

    def decisions(controller: Controller) -> list[object]:
        return [
            controller.decide(Situation(5.0, state, reference, LEVEL)).command for state in states
        ]

    controller = law_named(law)
    first = decisions(controller)
    controller.reset()
    assert decisions(controller) == first == decisions(law_named(law))
