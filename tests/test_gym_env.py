# SPDX-License-Identifier: Apache-2.0
"""The Gymnasium environment: Gymnasium's checker, episodes that equal the simulator's runs, reproducible bytes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from tests.drives import driven

import ds_sim.gym_env
from ds_road import generate
from ds_sim import CommandError
from ds_sim.testing import STRAIGHT

ROAD = generate(np.random.default_rng(21), max_angle=120)


@pytest.fixture
def env() -> Iterator[gymnasium.Env]:
    made = gymnasium.make(ds_sim.gym_env.ENVIRONMENT_ID, simulator="donkey", render_mode="rgb_array")
    yield made
    made.close()


def test_gymnasiums_own_checker_has_no_complaint() -> None:
    env = gymnasium.make("DigitalSiblings-v0", simulator="donkey")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Its advice to scale every action to [-1, 1] does not apply: the throttle has no negative half.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        check_env(env.unwrapped)
    env.close()


def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_road(env: gymnasium.Env) -> None:
    def episode(seed: int) -> tuple[bytes, str]:
        image, info = env.reset(seed=seed)
        env.action_space.seed(seed)
        images = [image.tobytes()]
        for _ in range(8):
            image, reward, _, _, _ = env.step(env.action_space.sample())
            images += [image.tobytes(), np.float64(reward).tobytes()]
        return b"".join(images), info["road_id"]

    first, again, other = episode(3), episode(3), episode(4)
    assert first == again
    assert first[0] != other[0] and first[1] != other[1]


def test_an_episode_is_the_run_of_the_simulator(env: gymnasium.Env) -> None:
    """Given the reference run's commands, it passes through the same states, and the rewards sum to its progress."""
    run = driven("donkey", ROAD, 5)
    env.reset(options={"road": ROAD, "simulator_seed": 5})
    total, expected = 0.0, 0.0
    for index, command in enumerate(run.commands):
        before, after = run.observations[index].lane, run.observations[index + 1].lane
        expected += (after.arc_length - before.arc_length) * (1 - abs(after.lateral_position) / 2.0)
        # Bypass the wrappers, which convert to float32: the simulator computes in float64.
        _, reward, terminated, truncated, info = env.unwrapped.step(np.array([command.steering, command.throttle]))
        total += float(reward)
        assert info["lateral_position"] == after.lateral_position
        assert terminated == (index == len(run.commands) - 1) and not truncated
    assert info["outcome"] == "COMPLETED" == run.outcome.name
    assert total == pytest.approx(expected) and total < info["arc_length"]


def test_leaving_the_lane_ends_the_episode_with_the_failure_reward(env: gymnasium.Env) -> None:
    env.reset(seed=1, options={"road": STRAIGHT})
    terminated = False
    while not terminated:
        image, reward, terminated, truncated, info = env.step(np.array([0.6, 0.8], np.float32))
        assert not truncated
    assert info["outcome"] == "OUT_OF_BOUNDS" and reward == ds_sim.gym_env.FAILURE_REWARD
    shown = env.render()
    assert isinstance(shown, np.ndarray) and np.array_equal(shown, image)


def test_bad_input_is_refused_by_name(env: gymnasium.Env) -> None:
    for options, words in (
        ({"raod": STRAIGHT}, "unknown option 'raod'"),
        ({"road": [[1, 2]]}, "option road is a list"),
        ({"simulator_seed": -1}, "expected a whole number"),
    ):
        with pytest.raises(ValueError, match=words):
            env.reset(options=options)
    env.reset(options={"road": STRAIGHT})
    with pytest.raises(CommandError, match="steering is nan"):
        env.unwrapped.step(np.array([np.nan, 0.0]))
