"""RoundPillar: the expert takes either side, the middle is lost, and nothing touches the pillar."""

import dataclasses
from typing import Any

import numpy as np

from actrm_harness.simulators.robosuite import envs, episodes, suite
from actrm_harness.tasks import find, row
from actrm_harness.wire import Array

suite.prepare()


def test_both_sides_lead_to_the_goal_and_straight_on_does_not() -> None:
    from actrm_harness.experts.parts import Scene

    task = row("RoundPillar")
    assert task.expert is not None
    session = envs.make("RoundPillar")
    env: Any = session.env
    sides: list[bool] = []
    for seed in range(12):
        seen = envs.reset(session, seed, True)
        assert envs.failure(env) is None and np.allclose(seen["hand_to_goal"], env.goal - env.hand())
        expert: Any = find(task.expert)(Scene(env), np.random.default_rng(seed))
        solved, widest = False, 0.0
        for _ in range(task.max_steps):
            result = envs.step(env, np.clip(expert.act(), -1.0, 1.0), None)
            assert result.failure is None
            aside = float((env.hand() - env.pillar)[1])
            widest = aside if abs(aside) > abs(widest) else widest
            if result.success:
                solved = True
                break
        assert solved and abs(widest) > 0.065, seed
        sides.append(widest > 0)
    assert 2 <= sum(sides) <= 10, sides
    # the mean of both ways
    envs.reset(session, 3)
    failures: list[str | None] = []
    for _ in range(60):
        ahead = env.goal - env.hand()
        action = np.zeros(7)
        action[:3] = ahead / np.linalg.norm(ahead) * 0.5
        failures.append(envs.step(env, action, None).failure)
        if failures[-1]:
            break
    assert failures[-1] == "struck"
    env.close()


class StraightOn:
    """An expert that knows of no pillar."""

    def __init__(self, scene: Any, rng: np.random.Generator) -> None:
        del rng
        self.env = scene.env

    def act(self) -> Array:
        """Half of the speed, to the goal."""
        ahead = self.env.goal - self.env.hand()
        return np.concatenate([ahead / np.linalg.norm(ahead) * 0.5, np.zeros(4)])


def test_an_experts_episode_says_why_it_was_lost() -> None:
    session = envs.make("RoundPillar")
    session.task = dataclasses.replace(session.task, expert=StraightOn)
    lost = episodes.expert_episode(session, 3, demonstration=False)
    assert (lost.success, lost.failure, lost.progress) == (False, "struck", 0.0)
    session.env.close()


def test_extract_reads_pillar_and_goal_back() -> None:
    """States do not hold them; the demonstration's model does, with six digits."""
    session = envs.make("RoundPillar")
    demo = episodes.expert_episode(session, 1_000_003)
    assert demo.success and demo.failure is None
    again = episodes.extract(session, demo.tensors["states"], demo.tensors["actions"], demo.attrs["model_file"])
    for name in ("rewards", "dones"):
        assert np.array_equal(again.tensors[name][:-1], demo.tensors[name][:-1]), name
    for name in ("obs/pillar_pos", "obs/goal_pos"):
        assert np.abs(again.tensors[name] - demo.tensors[name]).max() < 1e-6, name
    session.env.close()
