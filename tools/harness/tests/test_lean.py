"""What makes resets cheap and the process small leaves no trace."""

import dataclasses
from typing import Any

import pytest

from actrm_harness.simulators.robosuite import suite

suite.prepare()

from actrm_harness.simulators.robosuite import envs, episodes  # noqa: E402


@pytest.fixture
def kept() -> envs.Session:
    """A session that keeps its model between episodes."""
    session = envs.make("Stack")
    assert session.task.soft_reset
    return session


def test_the_robots_own_model_is_compiled_when_somebody_looks_at_it(kept: envs.Session) -> None:
    robot: Any = kept.env.robots[0].robot_model
    before = envs.model_xml(kept.env)
    model = robot.mujoco_model
    expected = robot.get_model()
    assert (model.nv, model.nbody, model.ngeom) == (expected.nv, expected.nbody, expected.ngeom)
    assert model.body_mass.tobytes() == expected.body_mass.tobytes()
    assert robot.mujoco_model is model
    robot.set_mujoco_model(expected)
    assert robot.mujoco_model is expected
    assert "cube" in before


def test_looking_at_the_robots_model_leaves_the_scenes_text(kept: envs.Session) -> None:
    before = envs.model_xml(kept.env)
    assert kept.env.robots[0].robot_model.mujoco_model.nv > 0
    assert envs.model_xml(kept.env) == before


def test_a_slimmed_session_writes_its_model_again(kept: envs.Session) -> None:
    """An evaluation forgets the model's text; an expert's episode and an extraction after it have it all the same."""
    kept.task = dataclasses.replace(kept.task, max_steps=30)
    first = again = episodes.expert_episode(kept, 5)
    for _ in range(2):
        envs.reset(kept, 1)
        envs.slim(kept)
        assert kept.xml_forgotten
        again = episodes.expert_episode(kept, 5)
        assert again.attrs["model_file"].startswith("<mujoco")
        assert again.tensors["states"].tobytes() == first.tensors["states"].tobytes()
    envs.reset(kept, 1)
    envs.slim(kept)
    states, actions = again.tensors["states"], again.tensors["actions"]
    for model_file in ("", again.attrs["model_file"]):
        found = episodes.extract(kept, states, actions, model_file)
        assert found.attrs["model_file"].startswith("<mujoco")


def test_a_mujoco_without_mjspec_begins_the_same_episodes_and_writes_no_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo 3.1: Lift's cube is drawn anew by the older call."""
    session = envs.make("Lift")

    def begun() -> list[dict[str, bytes]]:
        return [{name: x.tobytes() for name, x in envs.reset(session, seed).items()} for seed in (3, 4, 3)]

    expected = begun()
    monkeypatch.delattr("mujoco.MjSpec")
    assert begun() == expected
    with pytest.raises(envs.RequestError, match=r"before 3\.2"):
        envs.model_xml(session.env)
