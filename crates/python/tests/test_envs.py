"""gymnasium environments."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

import actrm
import actrm.envs
from conftest import ROOT


@pytest.mark.filterwarnings("ignore:.*Box .* precision lowered.*", "ignore:.*infinity.*")
def test_gymnasium_s_checker_has_nothing_to_say() -> None:
    from gymnasium.utils.env_checker import check_env

    env = gymnasium.make("actrm/Stack-v0", render_mode="rgb_array", size=64)
    check_env(env.unwrapped, skip_render_check="MUJOCO_GL" not in os.environ)
    env.close()


def test_every_task_is_known() -> None:
    known = {name for name in gymnasium.registry if name.startswith("actrm/")}
    assert known == {f"actrm/{task}-v0" for task in actrm.envs.TASKS}
    # families of tasks have no id
    text = (ROOT / "tools/harness/actrm_harness/tasks.py").read_text().split("FAMILIES")[0]
    assert set(actrm.envs.TASKS) == set(re.findall(r'Task\(\s*"(\w+)"', text))


def test_both_arms_are_seen() -> None:
    env = gymnasium.make("actrm/TwoArmPegInHole-v0")
    shapes = {name: space.shape for name, space in env.observation_space.items()}
    one = gymnasium.make("actrm/Lift-v0").observation_space["observation.state"].shape
    observation, _ = env.reset(seed=3)
    assert shapes["observation.state"][0] > one[0]
    assert observation["observation.state"].shape == shapes["observation.state"]
    env.close()


def test_an_episode_is_the_evaluation_s(zoo: Path) -> None:
    stored = actrm.evaluate(zoo / "lift-act", episodes=200, seed=40_000, progress=False)
    policy = actrm.load_policy(zoo / "lift-act")
    env = gymnasium.make("actrm/Lift-v0", entry=str(zoo / "lift-act"))
    policy.reset(seed=40_000)
    observation, info = env.reset(seed=40_000)
    assert info["fingerprint"] == stored["fingerprint"][0] and not info["is_success"]
    steps, over = 0, False
    while not over:
        observation, reward, terminated, truncated, info = env.step(policy.select_action(observation))
        steps, over = steps + 1, terminated or truncated
    assert (info["is_success"], steps) == (bool(stored["success"][0]), int(stored["steps"][0]))
    env.close()
    with pytest.raises(actrm.Error, match="closed"):
        env.unwrapped.reset(seed=1)


def test_what_was_before_is_what_was_shown_before() -> None:
    hand = "robot0_eef_pos"
    keys = {"observation.state": [hand, f"before({hand}:3)", f"first({hand})", f"{hand} - before({hand}:1)"]}
    env = actrm.envs.RobotEnv("Lift", keys=keys)
    up = np.array([0.2, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0], np.float32)
    # the second episode remembers nothing of the first
    for seed in (5, 6):
        shown = [env.reset(seed=seed)[0]["observation.state"]]
        shown += [env.step(up)[0]["observation.state"] for _ in range(8)]
        hands = [state[:3] for state in shown]
        assert not np.array_equal(hands[0], hands[8])
        for step, state in enumerate(shown):
            np.testing.assert_array_equal(state[3:6], hands[max(step - 3, 0)])
            np.testing.assert_array_equal(state[6:9], hands[0])
            np.testing.assert_array_equal(state[9:], hands[step] - hands[max(step - 1, 0)])
    env.close()


def test_a_cap_truncates_and_bad_actions_are_refused() -> None:
    env = actrm.envs.RobotEnv("Lift", max_steps=3)
    env.reset(seed=5)
    still = np.zeros(7, np.float32)
    assert [env.step(still)[2:4] for _ in range(3)] == [(False, False), (False, False), (False, True)]
    for action in (np.zeros(6), np.full(7, np.nan), np.zeros((1, 7))):
        with pytest.raises(ValueError, match="action"):
            env.step(action)
    for action in (0.0, None):
        with pytest.raises(ValueError, match=r"action: expected shape \[7\], found \[\]"):
            env.step(action)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="action: could not convert"):
        env.step("a")  # type: ignore[arg-type]
    env.step(np.full(7, 1e9))
    env.close()
    for argument in ({"max_steps": 0}, {"render_mode": "foo"}):
        with pytest.raises(ValueError, match=f"{next(iter(argument))}: expected"):
            actrm.envs.RobotEnv("Lift", **argument)  # type: ignore[arg-type]
    with pytest.raises(actrm.Error, match="NoSuchTask"):
        actrm.envs.RobotEnv("NoSuchTask")
    with pytest.raises(actrm.Error, match="observation.state"):
        actrm.envs.RobotEnv("Lift", keys={"observation.state": ["no_such_key"]})


def test_a_request_that_cannot_be_done_leaves_the_simulator() -> None:
    simulator = actrm.Simulator("Lift")
    simulator.reset(1)
    with pytest.raises(actrm.Error, match="unknown camera 'frontveiw'"):
        simulator.render("frontveiw")
    with pytest.raises(ValueError, match="seed: expected a whole number from 0"):
        simulator.reset(-1)
    simulator.step([0] * 7)
    simulator.close()
