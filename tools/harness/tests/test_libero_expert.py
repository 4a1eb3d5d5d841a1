"""The scripted expert of LIBERO's tasks. Its episodes need .venv-libero (`make libero`)."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Client

from actrm_harness.experts.parts import about_z
from actrm_harness.protocol import RequestError
from actrm_harness.simulators.libero.expert import CLEAR, DEPTH, RIM, WIDEST, Around, Box, box, hold, room
from actrm_harness.simulators.libero.family import of_tasks

UPRIGHT = np.eye(3)
# what LIBERO's bottles are: their own y axis points up
STANDING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def brick(x: float, y: float, z: float) -> Box:
    half = np.array([x, y, z]) / 2
    return Box(-half, half)


def test_a_box_goes_around_turned_boxes() -> None:
    quarter = about_z(np.pi / 2)
    around = box(
        np.array([[0.0, 0.0, 0.0, 0.1, 0.02, 0.03], [0.5, 0.0, 0.0, 0.1, 0.1, 0.1]]),
        np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]),
        np.array([quarter, UPRIGHT]),
    )
    np.testing.assert_allclose(around.low, [-0.02, -0.1, -0.1], atol=1e-12)
    np.testing.assert_allclose(around.high, [0.6, 1.1, 0.1], atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 0.4, -0.7, 1.2])
def test_fingers_close_along_what_they_span(angle: float) -> None:
    place, rotation = np.array([0.1, -0.2, 0.01]), about_z(angle)
    long, wide = brick(0.08, 0.04, 0.02), brick(0.04, 0.08, 0.02)
    for shape, axis in ((long, 1), (wide, 0)):
        how = hold(shape, place, rotation)
        assert how.axis == axis and not how.shift.any()
        hand = about_z(how.angle(rotation, 0.0)) @ np.array([0.0, 1.0, 0.0])
        assert abs(hand @ rotation[:, axis]) == pytest.approx(1.0)
    # either will do: the one that needs the least turn
    cube = hold(brick(0.04, 0.04, 0.04), place, rotation)
    assert abs(cube.angle(rotation, 0.0)) <= np.pi / 4 + 1e-9
    # none will do: on the rim
    bowl = hold(brick(0.12, 0.12, 0.05), place, rotation)
    assert bowl.rim and np.abs(bowl.shift).max() == pytest.approx(0.06 - RIM) and WIDEST < 0.12


def test_tall_things_are_held_near_their_top_and_flat_ones_in_their_middle() -> None:
    place = np.array([0.0, 0.0, 0.07])
    bottle = brick(0.05, 0.14, 0.04)
    assert hold(bottle, place, STANDING).point(bottle, place, STANDING)[2] == pytest.approx(0.14 - DEPTH)
    flat = brick(0.08, 0.04, 0.03)
    low = np.array([0.0, 0.0, 0.015])
    assert hold(flat, low, UPRIGHT).point(flat, low, UPRIGHT)[2] == pytest.approx(0.015)


def test_the_palm_stays_clear_of_a_tall_neighbour() -> None:
    place, shape = np.array([0.0, 0.0, 0.009]), brick(0.08, 0.04, 0.018)
    can = Around(np.array([[0.045, -0.1]]), np.array([0.033]), np.array([0.076]))
    how = hold(shape, place, UPRIGHT, can)
    point = how.point(shape, place, UPRIGHT)
    angle = how.angle(UPRIGHT, 0.0)
    assert room(np.array([0.0, 0.0, 0.009]), 0.0, can) < CLEAR <= room(point, angle, can)
    assert abs(point[0]) < 0.03
    low = Around(can.places, can.radii, np.array([0.03]))
    assert not hold(shape, place, UPRIGHT, low).shift.any()
    # the same can, as a thing of a shape
    seen = Around.of([(brick(0.066, 0.066, 0.076), np.array([0.045, -0.1, 0.038]), UPRIGHT)])
    for one, other in zip((seen.places, seen.radii, seen.tops), (can.places, can.radii, can.tops), strict=True):
        np.testing.assert_allclose(one, other)


def test_the_expert_shows_a_task_and_repeats_itself(libero: Path) -> None:
    assert libero.is_file()
    worker = Client("--task", "libero_object/1")
    message, shown = worker.ask("expert", seed=1_000_003, split="demonstration")
    assert message["success"] and 60 < message["steps"] < 280
    steps = message["steps"]
    assert shown["actions"].shape == (steps, 7) and np.abs(shown["actions"]).max() <= 1.0
    assert shown["states"].shape == (steps, 110) and shown["rewards"][-1] == 1.0 and shown["dones"].sum() >= 10
    assert json.loads(message["attrs"]["ep_meta"])["lang"] == "pick up the cream cheese and place it in the basket"
    assert {"obs/target_pos", "obs/goal_pos", "obs/task_onehot", "obs/cream_cheese_1_pos"} <= set(shown)
    # and what LIBERO's own files hold
    said = json.loads(message["attrs"]["data/problem_info"])
    assert said["language_instruction"].lower() == "pick the cream cheese and place it in the basket"
    assert message["attrs"]["data/bddl_file_name"].startswith("libero_object/pick_up_the_cream_cheese")
    assert shown["robot_states"].shape == (steps, 9) and shown["obs/joint_states"].shape == (steps, 7)
    assert np.array_equal(shown["obs/ee_states"], np.hstack([shown["obs/ee_pos"], shown["obs/ee_ori"]]))
    assert np.allclose(
        np.cos(np.linalg.norm(shown["obs/ee_ori"], axis=1) / 2), shown["obs/robot0_eef_quat"][:, 3], atol=1e-9
    )
    # opens, closes once, opens
    grip = shown["actions"][:, 6]
    assert grip[0] == grip[-1] == -1.0 and (np.diff(grip) != 0).sum() == 2
    _, again = worker.ask("expert", seed=1_000_003, split="demonstration")
    assert all(np.array_equal(value, again[name]) for name, value in shown.items())
    _, other = worker.ask("expert", seed=1_000_004, split="demonstration")
    assert not np.array_equal(shown["states"][0, :10], other["states"][0, :10]), "the arm begins elsewhere, too"
    assert worker.close() == 0


def test_a_suites_recorded_arguments_are_those_of_its_tasks() -> None:
    given = {"env_name": "libero_object", "env_kwargs": {"robots": ["Panda"], "bddl_file_name": "libero_object"}}
    assert of_tasks("libero_object", given) == {"env_name": "libero_object", "env_kwargs": {"robots": ["Panda"]}}
    with pytest.raises(RequestError, match=r"libero_goal: expected bddl_file_name 'libero_goal'.*'libero_object'"):
        of_tasks("libero_goal", given)
    # what are no arguments at all, the task says
    assert of_tasks("libero_goal", {"env_kwargs": 3}) == {"env_kwargs": 3}


def test_a_goal_without_an_expert_is_named(cabinet: Client) -> None:
    with pytest.raises(Exception, match=r"no_expert.*no scripted expert for a goal like this one"):
        cabinet.ask("expert", seed=0, split="demonstration")
