"""Episodes of LIBERO, by LIBERO's own environment or by ours, as arrays in a file: run in .venv-libero by test_libero.

`python libero_parity.py own|ours SIZE STEPS FOLDER TASK:INIT...`; of size 0 without images.

`python libero_parity.py all FOLDER [SUITE...]` compares both over 10 tasks x 5 initial states of each suite, 50 random
actions each, without images: half an hour. It runs a process a task, and begins where it was stopped.
"""

import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

HARNESS = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(HARNESS))
CAMERAS = ("agentview", "robot0_eye_in_hand")
ADDED = ("target_", "goal_", "task_onehot", "instruction_words", "ee_", "gripper_states", "joint_states")
"""What begins the names of observations that LIBERO's environment does not have."""


def actions(steps: int) -> Any:
    """Every step another action; the gripper opens and closes for ten steps each."""
    rows = np.random.default_rng(3).uniform(-1, 1, size=(steps, 7))
    rows[:, 6] = np.where(np.arange(steps) // 10 % 2, 1.0, -1.0)
    return rows


def own(task: str, init: int, size: int, steps: int) -> dict[str, Any]:
    """What examples/libero/main.py of openpi does: make, seed, reset, set the initial state, settle, step."""
    libero: Any = importlib.import_module("libero.libero")
    benchmark: Any = importlib.import_module("libero.libero.benchmark")
    envs: Any = importlib.import_module("libero.libero.envs")
    name, _, index = task.partition("/")
    number = int(index)
    suite = benchmark.get_benchmark_dict()[name]()
    row = suite.get_task(number)
    path = str(Path(libero.get_libero_path("bddl_files")) / row.problem_folder / row.bddl_file)
    images = {"camera_heights": size, "camera_widths": size} if size else {"use_camera_obs": False}
    env = envs.OffScreenRenderEnv(bddl_file_name=path, **images)
    env.seed(7)
    env.reset()
    obs = env.set_init_state(suite.get_task_init_states(number)[init])
    for _ in range(10):
        obs, _, _, _ = env.step([0.0] * 6 + [-1.0])
    seen: list[Any] = [(obs, env.get_sim_state(), 0.0, False)]
    for action in actions(steps):
        obs, reward, done, _ = env.step(action.tolist())
        seen.append((obs, env.get_sim_state(), reward, done))
    env.close()
    # openpi turns images by 180 degrees
    cameras = CAMERAS if size else ()
    images = {f"{camera}_image": [step[0][f"{camera}_image"][::-1, ::-1] for step in seen] for camera in cameras}
    rest = {
        name: [step[0][name] for step in seen]
        for name in seen[0][0]
        if not name.endswith(("_image", "robot0_proprio-state"))
    }
    rest["object"] = rest.pop("object-state")
    return collected(images | rest, [step[1:] for step in seen])


def ours(task: str, init: int, size: int, steps: int) -> dict[str, Any]:
    """The same by our simulator, after an episode from another initial state."""
    from actrm_harness import simulators
    from actrm_harness.tasks import row

    simulators.prepare("libero")
    cameras = CAMERAS if size else ()
    simulation: Any = simulators.start(simulators.Options(row(task), "robosuite", cameras, size))
    simulation.reset(init + 1, demonstration=False)
    simulation.step(np.array([[0.5, 0.5, -0.5, 0.1, 0.1, 0.1, 1.0]] * 7))
    first = simulation.reset(init, demonstration=False)
    seen: list[Any] = [(first.observation, simulation.control.get_sim_state(), 0.0, False)]
    for action in actions(steps):
        done = simulation.step(action)
        seen.append((done.observation, simulation.control.get_sim_state(), done.rewards[-1], done.success))
    values = {name: [step[0][name] for step in seen] for name in first.observation if not name.startswith(ADDED)}
    for camera in cameras:
        # the mapping openpi-libero mirrors them
        values[f"{camera}_image"] = [image[:, ::-1] for image in values[f"{camera}_image"]]
    return collected(values, [step[1:] for step in seen])


def collected(values: dict[str, Any], rest: list[Any]) -> dict[str, Any]:
    """Observations, states, rewards and success, each as one array."""
    arrays = {f"obs/{name}": np.array(value) for name, value in values.items()}
    for at, name in enumerate(("states", "rewards", "success")):
        arrays[name] = np.array([step[at] for step in rest], dtype=bool if name == "success" else np.float64)
    return arrays


def differing(folder: Path, task: str, init: str) -> list[str]:
    """What differs between the two sides of an episode."""
    own, ours = (np.load(folder / f"{which}-{task.replace('/', '-')}-{init}.npz") for which in ("own", "ours"))
    if set(own) != set(ours):
        return sorted(set(own) ^ set(ours))
    return [key for key in own.files if not np.array_equal(own[key], ours[key])]


def every(folder: Path, suites: list[str]) -> None:
    """Compare 10 tasks x 5 initial states of each suite, and say what differs."""
    settings = {"MUJOCO_GL": "egl", "PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    folder.mkdir(exist_ok=True)
    compared, bad = 0, 0
    for task in [f"{suite}/{number}" for suite in suites for number in range(10)]:
        # spread over the 50 states, and others in every task
        inits = [str((int(task.rpartition("/")[2]) + 11 * k) % 50) for k in range(5)]
        for which in ("own", "ours"):
            left = [init for init in inits if not (folder / f"{which}-{task.replace('/', '-')}-{init}.npz").exists()]
            command = [sys.executable, __file__, which, "0", "50", str(folder), *(f"{task}:{init}" for init in left)]
            if left:
                subprocess.run(command, env=os.environ | settings, check=True, stderr=subprocess.DEVNULL)
        for init in inits:
            found = differing(folder, task, init)
            compared, bad = compared + 1, bad + bool(found)
            print(task, init, "differs: " + ", ".join(found) if found else "equal", flush=True)
    print(f"{compared} episodes, {bad} differ")
    sys.exit(bool(bad))


def main() -> None:
    """Write a file for each task."""
    if sys.argv[1] == "all":
        every(Path(sys.argv[2]), sys.argv[3:] or ["libero_spatial", "libero_object", "libero_goal", "libero_10"])
    which, size, steps, folder = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
    for name in sys.argv[5:]:
        task, _, init = name.partition(":")
        arrays = (own if which == "own" else ours)(task, int(init), size, steps)
        np.savez(folder / f"{which}-{task.replace('/', '-')}-{init}.npz", **arrays)
    # robosuite's renderers fail when they are freed
    os._exit(0)


if __name__ == "__main__":
    main()
