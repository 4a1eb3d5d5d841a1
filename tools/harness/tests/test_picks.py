"""PickChain, PickAny and Recall: what is drawn, what is seen, and how an episode ends."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Client

from actrm_harness.simulators.robosuite import control, envs, episodes, suite
from actrm_harness.wire import Array, Tensors

suite.prepare()


@pytest.fixture(scope="module")
def chain() -> Iterator[envs.Session]:
    session = envs.make("PickChain")
    yield session
    session.env.close()


def seen_chain(seen: Tensors) -> tuple[list[int], list[int], int]:
    """Colours, pointers and start, as an episode shows them."""

    def color(name: str) -> int:
        value: Array = seen[name]
        assert value.shape == (12,) and np.array_equal(np.sort(value), [0.0] * 11 + [1.0])
        return int(np.argmax(value))

    colors = [color(f"cube{k}_color") for k in range(12)]
    return colors, [color(f"cube{k}_points") for k in range(12)], color("goal_color")


@pytest.mark.parametrize(("demonstration", "most"), [(True, 4), (False, 7)])
def test_a_chain_can_be_followed_and_an_end_tells_nothing(chain: envs.Session, demonstration: bool, most: int) -> None:
    """Three chains, three ends, one cube that points to each of them; the goal's chain is as long as is said."""
    hops: list[int] = []
    places: set[bytes] = set()
    for seed in range(120):
        seen = envs.reset(chain, seed, demonstration)
        colors, points, start = seen_chain(seen)
        meta = chain.env.get_ep_meta()
        assert sorted(colors) == list(range(12)) and "object" not in seen
        ends = [k for k in range(12) if points[k] == colors[k]]
        assert len(ends) == 3
        for end in ends:
            assert sum(points[k] == colors[end] for k in range(12) if k != end) == 1
        # nothing points to a cube that something else points to: no chain runs into another
        onward = [points[k] for k in range(12) if k not in ends]
        assert len(set(onward)) == len(onward)
        cube, steps = colors.index(start), 0
        while cube not in ends:
            cube, steps = colors.index(points[cube]), steps + 1
        env: Any = chain.env
        assert (cube, steps, f"{steps} hops") == (env.target, meta["hops"], meta["group"])
        hops.append(steps)
        places.add(seen[f"cube{cube}_pos"].tobytes())
        positions = np.array([seen[f"cube{k}_pos"] for k in range(12)])
        apart = np.abs(positions[:, None, :2] - positions[None, :, :2]) + 9.0 * np.eye(12)[:, :, None]
        assert np.all((apart[..., 0] > 0.05) | (apart[..., 1] > 0.075))
    assert set(hops) == set(range(most + 1)) and len(places) == 120
    assert max(hops.count(each) for each in set(hops)) < 120 / (most + 1) * 2


def lift(env: Any, cube: int, height: float) -> None:
    pose = np.array([0.0, 0.3, float(env.table_offset[2]) + height, 1.0, 0.0, 0.0, 0.0])
    env.sim.data.set_joint_qpos(f"cube{cube}_joint0", pose)
    env.sim.forward()


def test_lifting_is_success_or_the_wrong_cube(chain: envs.Session) -> None:
    env: Any = chain.env
    envs.reset(chain, 3)
    other = (env.target + 1) % 12
    assert (envs.success(env), envs.failure(env), env.reward(None)) == (False, None, 0.0)
    lift(env, env.target, 0.041)
    assert (envs.success(env), envs.failure(env), env.reward(None)) == (True, None, 1.0)
    lift(env, other, 0.041)
    assert (envs.success(env), envs.failure(env)) == (False, "wrong")
    lift(env, other, 0.016)
    lift(env, env.target, 0.039)
    assert (envs.success(env), envs.failure(env)) == (False, None)
    # a wrong cube ends a row of actions
    lift(env, other, 0.3)
    result, rewards = envs.steps_session(chain, np.zeros((5, 7)))
    assert (result.success, result.failure, rewards.tolist()) == (False, "wrong", [0.0])


def test_the_worker_tells_a_failure() -> None:
    client = Client("--task", "PickChain")
    client.ask("reset", seed=1)
    message, data = client.step(np.zeros(7))
    assert message["failure"] is None and data["obs/cube11_points"].shape == (12,)
    client.close()


@pytest.mark.parametrize("task", ["PickChain", "PickAny"])
def test_extract_reads_what_states_do_not_hold(task: str) -> None:
    session = envs.make(task)
    session.task = dataclasses.replace(session.task, max_steps=4)
    demo = episodes.expert_episode(session, 1_000_003)
    meta = json.loads(demo.attrs["ep_meta"])
    again = episodes.extract(session, demo.tensors["states"], demo.tensors["actions"], demo.attrs["model_file"], meta)
    assert again.attrs["ep_meta"] == demo.attrs["ep_meta"]
    for name, value in demo.tensors.items():
        if name.endswith(("_color", "_points")):
            assert np.array_equal(again.tensors[name], value), name
        elif name.startswith("obs/cube"):
            assert np.abs(again.tensors[name] - value).max() < 5e-3, name
    session.env.close()


def test_pick_any_shows_the_cubes_that_are_there() -> None:
    session = envs.make("PickAny")
    env: Any = session.env
    groups: set[str] = set()
    for seed in range(60):
        seen = envs.reset(session, seed)
        present = [k for k in range(8) if seen[f"cube{k}_color"].any()]
        groups.add(env.get_ep_meta()["group"])
        assert env.get_ep_meta()["group"].split()[0] == str(len(present) - 1)
        named = [k for k in present if np.array_equal(seen[f"cube{k}_color"], seen["goal_color"])]
        assert named == [env.target]
        for k in set(range(8)) - set(present):
            assert not seen[f"cube{k}_pos"].any() and not seen[f"gripper_to_cube{k}"].any()
        for k in present:
            assert abs(seen[f"cube{k}_pos"][2] - 0.818) < 0.005
    assert groups == {"1 other"} | {f"{count} others" for count in range(2, 8)}
    env.close()


def test_recall_shows_its_goal_for_a_second() -> None:
    session = envs.make("Recall")
    first = envs.reset(session, 5)["goal_rgb"]
    assert first.sum() == 3.0
    shown = [envs.step(session.env, np.zeros(7), None).observation["goal_rgb"] for _ in range(22)]
    assert all(np.array_equal(goal, first) for goal in shown[:19])
    assert not np.array(shown[19:]).any()
    session.task = dataclasses.replace(session.task, max_steps=23)
    demo = episodes.expert_episode(session, 1_000_000)
    again = episodes.extract(
        session,
        demo.tensors["states"],
        demo.tensors["actions"],
        demo.attrs["model_file"],
        json.loads(demo.attrs["ep_meta"]),
    )
    for name in ("obs/goal_rgb", "obs/slot0_rgb"):
        assert np.array_equal(again.tensors[name], demo.tensors[name])
    assert demo.tensors["obs/goal_rgb"].any(axis=1).sum() == 20
    session.env.close()


@pytest.mark.parametrize("compiled", [False, True])
def test_recall_held_moves_nothing_while_the_goal_is_shown(compiled: bool, library: Path) -> None:
    session = envs.make("RecallHeld")
    first = envs.reset(session, 5)
    if compiled:
        session.control = control.attach(session.env)
        assert session.control is not None and library.is_file()
    ask = np.array([1.0, 0.5, -1.0, 0.0, 0.0, 0.5, 1.0])

    def moved(seen: Tensors, name: str) -> float:
        return float(np.abs(seen[name] - first[name]).max())

    for _ in range(23):
        seen = envs.step_session(session, ask).observation
        assert np.array_equal(seen["goal_rgb"], first["goal_rgb"])
    seen = envs.step_session(session, ask).observation
    assert not seen["goal_rgb"].any()
    assert moved(seen, "robot0_eef_pos") < 2e-3 and moved(seen, "robot0_gripper_qpos") < 2e-3
    # the same in one call, and from then on actions are done
    after, rewards = envs.steps_session(session, np.array([ask] * 4))
    assert moved(after.observation, "robot0_eef_pos") > 5e-3 and len(rewards) == 4
    again = envs.reset(session, 5)
    assert all(np.array_equal(again[key], first[key]) for key in first)
    several, _ = envs.steps_session(session, np.array([ask] * 28))
    assert np.array_equal(several.observation["robot0_eef_pos"], after.observation["robot0_eef_pos"])
    session.env.close()


def test_recall_held_demonstrations_ask_while_the_arm_is_held() -> None:
    session = envs.make("RecallHeld")
    session.task = dataclasses.replace(session.task, max_steps=40)
    demo = episodes.expert_episode(session, 1_000_000)
    assert demo.tensors["actions"][:, :6].any(axis=1).all()
    hand = demo.tensors["obs/robot0_eef_pos"]
    assert np.abs(hand[:25] - hand[0]).max() < 2e-3 and np.abs(hand[30] - hand[0]).max() > 5e-3
    assert demo.tensors["obs/goal_rgb"].any(axis=1).sum() == 24
    session.env.close()
