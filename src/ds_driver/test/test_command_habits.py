# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from numpy.typing import NDArray

from ds_driver.control.command_habits import command_habits

WAVE = 0.4 * np.sin(np.linspace(0.0, 20.0, 200))


@pytest.mark.parametrize(
    ("steering", "speed", "kinds"),
    [
        (WAVE, 7.0, []),
        (np.clip(25.0 * WAVE, -1.0, 1.0), 7.0, ["saturated"]),
        (np.full(200, 0.1), 7.0, ["constant"]),
        (WAVE, 0.5, ["crawls"]),
        (np.ones(200), 0.0, ["saturated", "constant", "crawls"]),
        (np.ones(10), 0.0, []),  # half a second says nothing
    ],
)
def test_names_what_is_unusual_about_commands(steering: NDArray[np.float64], speed: float, kinds: list[str]) -> None:
    found = command_habits(steering, np.full(len(steering) + 1, speed))

    assert [habit.kind for habit in found] == kinds


def test_says_the_share_of_saturated_commands() -> None:
    (habit,) = command_habits(np.repeat([1.0, -1.0, 0.3], [60, 32, 8]), np.full(100, 7.0))

    assert "92%" in habit.text
