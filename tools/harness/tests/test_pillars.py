"""RoundPillar: the expert takes either side, the middle is lost, and nothing touches the pillar."""

from typing import Any

import numpy as np

from actrm_harness.simulators.robosuite import envs, suite
from actrm_harness.tasks import find, row

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
