"""The worker, driven over its pipes with robosuite behind it."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from conftest import Client, WorkerError, walk

from actrm_harness import wire

EXTRACTED_TOO = ("eef_quat_site", "joint_acc", "joint_pos_cos", "joint_pos_sin")
"""What robomimic's extraction shows of the arm and a recorded episode does not."""


def test_the_handshake_says_what_the_worker_is(lift: Client) -> None:
    ready = lift.ready
    assert (ready["protocol"], ready["task"], ready["env_name"], ready["control"]) == (2, "Lift", "Lift", "robosuite")
    assert ready["simulator"] == "robosuite" and sorted(ready["versions"]) == ["mujoco", "numpy", "python", "robosuite"]
    assert (ready["versions"]["robosuite"], ready["versions"]["mujoco"]) == ("1.5.2", "3.3.7")
    assert ready["module_sha256"] is None and ready["kernels"].startswith("openblas ")
    assert ready["renderer"] is None
    assert (ready["action_dim"], ready["control_freq"]) == (7, 20)
    assert ready["action_low"] == [-1.0] * 7 and ready["action_high"] == [1.0] * 7
    for name, shape in {"object": [10], "robot0_eef_pos": [3], "robot0_gripper_qpos": [2]}.items():
        assert ready["observations"][name] == shape


def test_env_args_have_robomimics_layout(lift: Client) -> None:
    args = lift.ready["env_args"]
    assert {key: args[key] for key in ("env_name", "env_version", "type")} == {
        "env_name": "Lift",
        "env_version": "1.5.2",
        "type": 1,
    }
    assert set(args["env_kwargs"]) == {
        "robots",
        "controller_configs",
        "reward_shaping",
        "has_renderer",
        "has_offscreen_renderer",
        "ignore_done",
        "use_object_obs",
        "use_camera_obs",
        "camera_depths",
    }
    assert args["env_kwargs"]["controller_configs"]["body_parts"]["right"]["type"] == "OSC_POSE"


def trajectory(client: Client, seed: int, steps: int) -> list[bytes]:
    """Every byte that an episode shows."""
    message, first = client.ask("reset", seed=seed)
    seen = [message["fingerprint"].encode(), *(first[name].tobytes() for name in sorted(first))]
    for action in walk(seed, steps):
        message, after = client.step(action)
        seen += [struct.pack("<d?", message["reward"], message["success"])]
        seen += [after[name].tobytes() for name in sorted(after)]
    return seen


def test_an_episode_depends_on_its_seed_and_actions_alone(lift: Client) -> None:
    """Two workers with different histories show the same episode, bit for bit; another seed shows another."""
    for seed, steps in ((7, 3), (3, 11), (10_000, 2)):
        trajectory(lift, seed, steps)
    lift.ask("expert", seed=5)
    here = trajectory(lift, 10_001, 40)
    fresh = Client("--task", "Lift")
    there = trajectory(fresh, 10_001, 40)
    other = trajectory(fresh, 10_002, 1)
    assert fresh.close() == 0
    assert here == there
    assert other[0] != here[0]


def test_an_expert_episode_does_not_depend_on_what_ran_before(lift: Client) -> None:
    first = lift.ask("expert", seed=1_000_003)
    lift.ask("reset", seed=4)
    lift.step(np.ones(7))
    again = lift.ask("expert", seed=1_000_003)
    assert {**first[0], "id": 0} == {**again[0], "id": 0}
    for name, value in first[1].items():
        assert value.tobytes() == again[1][name].tobytes(), name


def test_an_expert_episode_is_a_robomimic_demo(lift: Client) -> None:
    message, data = lift.ask("expert", seed=1_000_000)
    steps = message["steps"]
    assert message["success"] and 30 <= steps <= 120
    assert data["states"].shape == (steps, 32) and data["states"].dtype == np.float64
    assert data["actions"].shape == (steps, 7) and np.abs(data["actions"]).max() <= 1.0
    assert data["dones"].dtype == np.int64 and data["dones"][-1] == 1
    assert np.array_equal(data["rewards"] > 0, data["dones"] == 1)
    assert data["rewards"][:-11].max() == 0.0
    for name in ("object", "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"):
        assert np.array_equal(data[f"obs/{name}"][1:], data[f"next_obs/{name}"][:-1])
    assert "robosuite/models/assets" in message["attrs"]["model_file"]
    assert str(Path.home()) not in message["attrs"]["model_file"] and 'file="/' not in message["attrs"]["model_file"]
    assert json.loads(message["attrs"]["ep_meta"]) == {}


def test_replaying_a_demos_actions_gives_its_states(lift: Client) -> None:
    """The stored actions are what was executed: from the same seed they lead through the same observations."""
    _, data = lift.ask("expert", seed=1_000_001)
    lift.ask("reset", seed=1_000_001)
    for index, action in enumerate(data["actions"]):
        message, seen = lift.step(action)
        assert seen["obs/object"].tobytes() == data["next_obs/object"][index].tobytes()
        assert message["reward"] == data["rewards"][index]


def test_actions_in_one_request_end_where_the_task_is_solved(lift: Client) -> None:
    _, data = lift.ask("expert", seed=1_000_001)
    lift.ask("reset", seed=1_000_001)
    message, seen = lift.ask("step", {"action": data["actions"]})
    solved = int(np.argmax(data["rewards"] > 0))
    assert solved + 1 < len(data["actions"]), "the expert stays a while"
    assert message["success"] and message["reward"] == 1.0
    assert np.array_equal(seen["rewards"], data["rewards"][: solved + 1])
    assert seen["obs/object"].tobytes() == data["next_obs/object"][solved].tobytes()


def test_extract_gives_the_observations_of_stored_states(lift: Client) -> None:
    message, data = lift.ask("expert", seed=1_000_002)
    stored = {"states": data["states"], "actions": data["actions"]}
    again, seen = lift.ask("extract", stored, model_file=message["attrs"]["model_file"])
    assert again["steps"] == message["steps"] and again["success"]
    # robomimic's extraction shows more than an episode that is recorded
    more = {f"{kind}/robot0_{key}" for kind in ("obs", "next_obs") for key in EXTRACTED_TOO}
    assert set(seen) == set(data) | more
    assert np.array_equal(seen["dones"], data["dones"])
    # qpos is exact; poses of bodies are one substep (2 ms) fresher than in a live observation. What follows the last
    # action is simulated with a controller that has just been reset, so it is left out.
    assert np.array_equal(seen["obs/robot0_joint_pos"], data["obs/robot0_joint_pos"])
    assert np.abs(seen["obs/object"] - data["obs/object"]).max() < 5e-3
    # The demonstration's model must not stay behind.
    fresh = Client("--task", "Lift")
    assert trajectory(lift, 11, 3) == trajectory(fresh, 11, 3)
    fresh.close()


@pytest.mark.parametrize(
    ("kind", "fields", "tensors", "word", "text"),
    [
        ("step", {}, {"action": np.zeros(6)}, "bad_action", r"\(7,\)"),
        ("step", {}, {"action": np.full(7, np.nan)}, "bad_action", "not finite"),
        ("step", {}, {"action": np.zeros(7, dtype=np.float32)}, "bad_action", "F64"),
        ("step", {}, {"action": np.zeros((0, 7))}, "bad_action", "no action"),
        ("step", {}, {}, "bad_request", "'action' is missing"),
        ("reset", {}, {}, "bad_request", "seed"),
        ("reset", {"seed": -1}, {}, "bad_request", "seed"),
        ("jump", {}, {}, "unknown_request", "jump"),
        ("extract", {"model_file": ""}, {"states": np.zeros((2, 3)), "actions": np.zeros((2, 7))}, "bad_request", "32"),
    ],
)
def test_a_bad_request_is_answered_and_the_worker_stays(
    lift: Client, kind: str, fields: dict[str, object], tensors: wire.Tensors, word: str, text: str
) -> None:
    with pytest.raises(WorkerError, match=text) as caught:
        lift.ask(kind, tensors, **fields)
    assert caught.value.message["kind"] == word
    message, _ = lift.ask("reset", seed=1)
    assert message["type"] == "reset"


def start_error(*arguments: str, env: dict[str, str] | None = None) -> tuple[wire.Message, int]:
    client = Client(*arguments, env=env, ready=False)
    frame = wire.read_frame(client.replies)
    assert frame is not None
    return frame[0], client.close()


def test_an_unknown_task_is_one_line_and_a_failure() -> None:
    message, code = start_error("--task", "Lifft")
    assert (message["type"], message["kind"], code) == ("error", "unknown_task", 1)
    assert "Lifft" in message["message"] and "Lift" in message["message"] and "\n" not in message["message"]


def test_a_python_without_robosuite_is_named(tmp_path: Path) -> None:
    (tmp_path / "robosuite.py").write_text("raise ModuleNotFoundError(\"No module named 'robosuite'\")\n")
    paths = {"PYTHONPATH": f"{tmp_path}:{Path(__file__).resolve().parents[1]}"}
    message, code = start_error("--task", "Lift", env=paths)
    assert (message["kind"], code) == ("missing_module", 1)
    assert "robosuite" in message["message"]


def test_printing_does_not_get_into_the_stream(tmp_path: Path) -> None:
    (tmp_path / "noisy.py").write_text(
        "import os, sys\nprint('hello from print')\nsys.stdout.flush()\nos.write(1, b'hello from fd 1')\n"
    )
    paths = {"PYTHONPATH": f"{tmp_path}:{Path(__file__).resolve().parents[1]}"}
    client = Client("--task", "Lift", "--env-module", "noisy", env=paths)
    assert client.ask("reset", seed=0)[0]["type"] == "reset"
    assert client.close() == 0


def test_a_garbled_frame_ends_the_worker_with_an_error() -> None:
    client = Client("--task", "Lift")
    client.requests.write(struct.pack("<Q", 5) + b"xxxxx")
    client.requests.flush()
    frame = wire.read_frame(client.replies)
    assert frame is not None and frame[0]["kind"] == "bad_frame"
    assert client.close() == 1


def test_close_is_answered() -> None:
    client = Client("--task", "Lift")
    assert client.ask("close")[0]["type"] == "closed"
    assert client.close() == 0
