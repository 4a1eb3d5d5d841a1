"""What the worker asks of a simulator: other robots, and another simulator altogether."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Client, WorkerError, walk

from actrm_harness import wire

HERE = Path(__file__).resolve().parent
PATHS = {"PYTHONPATH": f"{HERE}:{HERE.parent}"}


def env_args(**kwargs: object) -> str:
    return json.dumps({"env_name": "any", "type": 1, "env_kwargs": kwargs})


OLD_CONTROLLER: dict[str, Any] = {
    "type": "OSC_POSE",
    "input_max": 1,
    "input_min": -1,
    "output_max": [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],
    "output_min": [-0.05, -0.05, -0.05, -0.5, -0.5, -0.5],
    "kp": 150,
    "damping": 1,
    "impedance_mode": "fixed",
    "kp_limits": [0, 300],
    "damping_limits": [0, 10],
    "position_limits": None,
    "orientation_limits": None,
    "uncouple_pos_ori": True,
    "control_delta": True,
    "interpolation": None,
    "ramp_ratio": 0.2,
}


@pytest.mark.parametrize(
    ("task", "arguments", "width", "robots"),
    [
        ("TwoArmHandover", None, 14, ["Panda", "Panda"]),
        ("TwoArmLift", env_args(robots=["Panda", "Sawyer"], env_configuration="parallel"), 14, ["Panda", "Sawyer"]),
        ("Lift", env_args(robots=["Sawyer"]), 7, "Sawyer"),
        ("Lift", env_args(robots="IIWA", gripper_types="PandaGripper"), 7, "IIWA"),
        ("Lift", env_args(robots=["Panda"], controller_configs=OLD_CONTROLLER, has_renderer=True), 7, "Panda"),
    ],
)
def test_robots_are_what_env_args_say(task: str, arguments: str | None, width: int, robots: object) -> None:
    """They start, and an episode depends on its seed alone, on robosuite's own loop where the compiled one is not."""
    given = [] if arguments is None else ["--env-args", arguments]
    client = Client("--task", task, *given)
    ready = client.ready
    assert (ready["action_dim"], ready["control"]) == (width, "robosuite")
    assert ready["env_args"]["env_kwargs"]["robots"] == robots
    assert (ready["env_args_sha256"] is None) == (arguments is None)
    assert ready["env_args"]["env_kwargs"]["has_renderer"] is False
    several = isinstance(robots, list)
    assert ("robot1_eef_pos" in ready["observations"]) == several
    seen: list[list[bytes]] = []
    for _ in range(2):
        message, first = client.ask("reset", seed=3)
        seen.append([message["fingerprint"].encode(), first["obs/object"].tobytes()])
        for action in walk(1, 3, width):
            seen[-1].append(client.step(action)[1]["obs/robot0_eef_pos"].tobytes())
        client.ask("reset", seed=4)
    assert seen[0] == seen[1] and len(set(seen[0])) == len(seen[0])
    # another robot with its usual controller and gripper has the task's expert
    if arguments is not None and robots != "Sawyer":
        with pytest.raises(WorkerError, match="no scripted expert"):
            client.ask("expert", seed=0)
    client.close()


def test_env_args_of_the_usual_environment_change_nothing(lift: Client) -> None:
    """What a file that we collected says of its environment leads to the environment that it was collected in."""
    same = Client("--task", "Lift", "--env-args", json.dumps(lift.ready["env_args"]))
    assert same.ready == lift.ready
    assert same.ask("reset", seed=5)[0]["fingerprint"] == lift.ask("reset", seed=5)[0]["fingerprint"]
    assert same.ask("expert", seed=1_000_000)[0]["success"]
    same.close()


def test_parts_that_the_robot_lacks_make_no_difference(lift: Client) -> None:
    """Robosuite's own recordings list controllers for a left arm, a head and legs."""
    config = lift.ready["env_args"]["env_kwargs"]["controller_configs"]
    right = config["body_parts"]["right"]
    more = {**config, "body_parts": {"right": right, "left": right, "head": {**right, "type": "JOINT_POSITION"}}}
    client = Client(
        "--task", "Lift", "--env-args", env_args(robots=["Panda"], controller_configs=more, control_freq=20)
    )
    assert client.ready["env_args_sha256"] is None
    client.close()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "must be an object"),
        ("{", "not JSON"),
        ('{"env_name": "Lift"}', "no env_kwargs"),
        (env_args(robots="Pandda"), "cannot be made"),
        (env_args(colour="red"), "cannot be made"),
    ],
)
def test_env_args_that_make_no_environment_are_one_line(text: str, words: str) -> None:
    from test_worker import start_error

    message, code = start_error("--task", "Lift", "--env-args", text)
    assert (message["kind"], code) == ("env_args", 1), message
    assert words in message["message"]


def test_another_simulator_is_a_module() -> None:
    """The worker, its protocol and its checks are the same, and nothing of robosuite is asked for."""
    client = Client("--task", "Slide", "--env-module", "toy_simulator", env=PATHS)
    ready = client.ready
    assert (ready["simulator"], ready["versions"], ready["max_steps"]) == ("toy_simulator", {"toy": "0.1"}, 30)
    assert ready["control"] == "own" and ready["env_args"]["env_module"]["sha256"] == ready["module_sha256"]
    client.ask("reset", seed=1)
    message, data = client.ask("step", {"action": -np.ones((30, 1))})
    assert message["success"] and 9 <= len(data["rewards"]) <= 20 and data["rewards"][-1] == 1.0
    with pytest.raises(WorkerError, match="nobody knows how"):
        client.ask("expert", seed=0)
    client.close()


def test_a_simulator_may_lie_in_a_package(tmp_path: Path) -> None:
    (tmp_path / "world").mkdir()
    (tmp_path / "world/__init__.py").write_text("")
    (tmp_path / "world/sim.py").write_text((HERE / "toy_simulator.py").read_text())
    paths = {"PYTHONPATH": f"{tmp_path}:{HERE.parent}"}
    client = Client("--task", "Slide", "--env-module", "world.sim", env=paths)
    assert (client.ready["simulator"], "world" in client.ready["sources"]) == ("world.sim", True)
    client.close()


def test_a_modules_sum_says_what_it_says(tmp_path: Path) -> None:
    """With what it imports from beside it; not with what merely lies there."""

    def digest() -> str:
        client = Client("--task", "Slide", "--env-module", "changed", env={"PYTHONPATH": f"{tmp_path}:{HERE.parent}"})
        client.close()
        return client.ready["module_sha256"]

    (tmp_path / "changed.py").write_text((HERE / "toy_simulator.py").read_text() + "\nimport rules\nrules.show()\n")
    (tmp_path / "rules.py").write_text("def show() -> None: ...\n")
    first = digest()
    (tmp_path / "unused.py").write_text("HEIGHT = 0.2\n")
    assert digest() == first and len(first) == 64
    (tmp_path / "rules.py").write_text("HEIGHT = 0.2\ndef show() -> None: ...\n")
    second = digest()
    (tmp_path / "changed.py").write_text((tmp_path / "changed.py").read_text() + "# another\n")
    assert len({first, second, digest()}) == 3


@pytest.mark.parametrize(
    ("task", "text"),
    [
        ("NanReward", r"environment: the environment's reward is nan \(step 2\)"),
        ("NanSuccess", "environment: the environment's success is nan, neither true nor false"),
        ("NanProgress", "environment: step: .*cannot be sent.*'progress': nan"),
    ],
)
def test_what_is_no_number_is_the_environments_error_and_the_worker_stays(task: str, text: str) -> None:
    client = Client("--task", task, "--env-module", "odd_simulator", env=PATHS)
    for seed in (1, 2):
        client.ask("reset", seed=seed)
        with pytest.raises(WorkerError, match=text):
            client.ask("step", {"action": np.zeros((2, 1))})
    assert client.close() == 0


def test_descriptions_that_are_no_json_are_the_environments_error() -> None:
    client = Client("--task", "NanMeta", "--env-module", "odd_simulator", env=PATHS)
    with pytest.raises(WorkerError, match=r"environment: reset: .*cannot be sent"):
        client.ask("reset", seed=1)
    assert client.close() == 0


def test_actions_without_limits_are_null_and_limits_that_are_no_numbers_an_error() -> None:
    from test_worker import start_error

    client = Client("--task", "Unlimited", "--env-module", "odd_simulator", env=PATHS)
    assert (client.ready["action_low"], client.ready["action_high"]) == ([None], [None])
    client.ask("reset", seed=1)
    assert client.step(np.full(1, -30.0))[0]["success"] is False
    client.close()
    message, code = start_error("--task", "NanLimit", "--env-module", "odd_simulator", env=PATHS)
    assert (message["kind"], code) == ("environment", 1) and "limits of an action" in message["message"]


def test_a_humanoid_is_stepped() -> None:
    """GR1's arms take targets without limits; one robot with two arms has no stages of two robots."""
    client = Client("--task", "TwoArmLift", "--env-args", env_args(robots="GR1ArmsOnly"))
    assert None in client.ready["action_low"] and client.ready["stages"] == []
    client.ask("reset", seed=1)
    message, _ = client.step(np.zeros((2, client.ready["action_dim"])))
    assert message["success"] is False
    client.close()


def test_a_success_of_robosuite_that_is_no_number_is_named(tmp_path: Path) -> None:
    (tmp_path / "nowhere.py").write_text(
        (HERE / "example_env.py").read_text().replace("return height >", "return np.nan + ")
    )
    paths = {"PYTHONPATH": f"{tmp_path}:{HERE.parent}"}
    client = Client("--task", "LiftHigh", "--env-module", "nowhere", env=paths)
    client.ask("reset", seed=1)
    with pytest.raises(WorkerError, match="success is nan"):
        client.step(np.zeros(7))
    client.close()


def test_what_was_imported_is_summed(lift: Client, tmp_path: Path) -> None:
    """The simulator, what it stands on, the harness; a copy that says otherwise has another sum."""
    assert sorted(lift.ready["sources"]) == ["actrm_harness", "mujoco", "robosuite"]
    # evaluations from before sources were written down count as run on this release
    released = HERE.parents[2] / "crates/results/src/record.rs"
    assert f'"1.5.2", "{lift.ready["sources"]["robosuite"]}"' in released.read_text()

    def sums() -> dict[str, str]:
        paths = {"PYTHONPATH": f"{tmp_path}:{HERE}:{HERE.parent}"}
        client = Client("--task", "Slide", "--env-module", "toy_simulator", env=paths)
        client.close()
        return client.ready["sources"]

    first = sums()
    assert sorted(first) == ["actrm_harness", "toy_simulator"]
    assert first["actrm_harness"] == lift.ready["sources"]["actrm_harness"]
    text = (HERE / "toy_simulator.py").read_text()
    (tmp_path / "toy_simulator.py").write_text(text)
    assert sums() == first, "where it lies does not matter"
    (tmp_path / "toy_simulator.py").write_text(text.replace("< 0.1)", "< 0.2)"))
    assert sums()["toy_simulator"] != first["toy_simulator"]


HOUSED = """
from odd_simulator import start
from actrm_harness.simulators import Requirements
from actrm_harness.tasks import Task, register
REQUIREMENTS = Requirements(("only_there",), ".venv-housed", "make housed")
register(Task("HOUSED", simulator="housed"))
"""


def test_a_simulator_runs_in_the_interpreter_that_has_its_packages(tmp_path: Path) -> None:
    (tmp_path / "housed.py").write_text(HOUSED)
    (tmp_path / "packages").mkdir()
    (tmp_path / "packages/only_there.py").write_text("")
    paths = f"{tmp_path}:{PATHS['PYTHONPATH']}"
    arguments = ("--task", "HOUSED", "--env-module", "housed")
    client = Client(*arguments, env={"PYTHONPATH": paths}, ready=False)
    frame = wire.read_frame(client.replies)
    assert frame is not None and client.close() == 1
    assert frame[0]["kind"] == "missing_module"
    for word in ("only_there", "simulator housed", "`make housed`", "ACTRM_PYTHON_HOUSED"):
        assert word in frame[0]["message"]
    other = tmp_path / "python"
    other.write_text(f'#!/bin/sh\nPYTHONPATH={tmp_path}/packages:$PYTHONPATH exec "{sys.executable}" "$@"\n')
    other.chmod(0o755)
    client = Client(*arguments, env={"PYTHONPATH": paths, "ACTRM_PYTHON_HOUSED": str(other)})
    assert client.ready["task"] == "HOUSED"
    assert client.ask("reset", seed=1)[0]["type"] == "reset"
    assert client.close() == 0
