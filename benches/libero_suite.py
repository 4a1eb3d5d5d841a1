"""Evaluating a suite of LIBERO: `actrm-zoo eval` beside LIBERO's own loop, with the same policy.

The policy answers in a millisecond and is sent what openpi's evaluation sends: two cameras, a state, the instruction.
Five actions of each chunk are executed. LIBERO's side has two processes, with the steps of openpi's
examples/libero/main.py: an `OffScreenRenderEnv` a task, for each episode a reset, the initial state, ten settling
steps, then steps up to the cap. Needs .venv-libero (`make libero`) and a build. Processor seconds are those of all
processes of a side. They count where other programs run beside, which time on the wall does not allow.

    .venv/bin/python benches/libero_suite.py                                  # 10 tasks x 10 episodes: an hour
    .venv/bin/python benches/libero_suite.py --task libero_object/0 --episodes 2 --steps 60
"""

import argparse
import importlib
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from constant_policy import ConstantPolicy

ROOT = Path(__file__).resolve().parents[1]
LIBERO = Path(os.environ.get("ACTRM_PYTHON_LIBERO") or ROOT / ".venv-libero/bin/python")
PROGRAM = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release/actrm-zoo"
CHUNK = 5
MAPPING = """prompt = "{{instruction}}"
n_action_steps = {chunk}
image_size = 128
[[observation]]
key = "observation/image"
feature = "observation.images.agentview"
flip = "horizontal"
[[observation]]
key = "observation/wrist_image"
feature = "observation.images.robot0_eye_in_hand"
flip = "horizontal"
[[observation]]
key = "observation/state"
feature = "observation.state"
axis_angle_at = 3
"""


def own(suite: str, tasks: list[int], episodes: int, steps: int, chunk: int) -> None:
    """LIBERO's own loop; the policy is a sleep."""
    np: Any = importlib.import_module("numpy")
    libero: Any = importlib.import_module("libero.libero")
    benchmark: Any = importlib.import_module("libero.libero.benchmark")
    envs: Any = importlib.import_module("libero.libero.envs")
    found = benchmark.get_benchmark_dict()[suite]()
    for number in tasks:
        row = found.get_task(number)
        path = str(Path(libero.get_libero_path("bddl_files")) / row.problem_folder / row.bddl_file)
        states = found.get_task_init_states(number)
        env = envs.OffScreenRenderEnv(bddl_file_name=path, camera_heights=128, camera_widths=128)
        env.seed(7)
        for episode in range(episodes):
            env.reset()
            obs = env.set_init_state(states[episode])
            for _ in range(10):
                obs, _, _, _ = env.step([0.0] * 6 + [-1.0])
            for step in range(steps):
                if step % chunk == 0:
                    for camera in ("agentview", "robot0_eye_in_hand"):
                        np.ascontiguousarray(obs[f"{camera}_image"][::-1, ::-1])
                    time.sleep(0.001)
                obs, _, done, _ = env.step([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
                if done:
                    break
        # robosuite's renderers fail when they are freed
        env.env.sim._render_context_offscreen = None
    sys.stdout.flush()
    os._exit(0)


def timed(commands: list[list[str]], env: dict[str, str]) -> tuple[float, float]:
    """Seconds on the wall and of the processor that commands take, all of them at once."""
    begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    running = [subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL) for command in commands]
    codes = [process.wait() for process in running]
    if any(codes):
        sys.exit(f"{commands}: exit codes {codes}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.perf_counter() - begun, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Time both and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="libero_object", help="or one of its tasks (default: %(default)s)")
    parser.add_argument("--episodes", type=int, default=10, help="of each task (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=280, help="of an episode (default: %(default)s)")
    parser.add_argument("--chunk", type=int, default=CHUNK, help="actions executed of a chunk (default: %(default)s)")
    parser.add_argument("--own", help=argparse.SUPPRESS)
    args = parser.parse_args()
    suite, _, number = args.task.partition("/")
    tasks = [int(number)] if number else list(range(10))
    if args.own:
        own(suite, [int(task) for task in args.own.split(",")], args.episodes, args.steps, args.chunk)
    server = ConstantPolicy([[0.1, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]] * 10)
    with tempfile.TemporaryDirectory() as folder:
        mapping = Path(folder) / "mapping.toml"
        mapping.write_text(MAPPING.format(chunk=args.chunk))
        asked = ["--seed", "10000", "--episodes", str(len(tasks) * args.episodes), "--task", args.task]
        command = [str(PROGRAM), "eval", "--policy", server.address, "--name", "constant", "--mapping", str(mapping)]
        command += [*asked, "--max-steps", str(args.steps), "--workers", "2", "--zoo", folder]
        ours = timed([command], dict(os.environ))
    settings = {"MUJOCO_GL": "egl", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    shared = [str(LIBERO), __file__, "--task", args.task, "--episodes", str(args.episodes)]
    shared += ["--steps", str(args.steps), "--chunk", str(args.chunk)]
    halves = [part for part in (tasks[::2], tasks[1::2]) if part]
    commands = [[*shared, "--own", ",".join(map(str, half))] for half in halves]
    theirs = timed(commands, {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | settings)
    print(f"{args.task}: {len(tasks) * args.episodes} episodes of {args.steps} steps, chunks of {args.chunk}")
    print("| | wall s | processor s |\n|---|---|---|")
    for name, (wall, cpu) in (("actrm-zoo eval, 2 workers", ours), ("LIBERO's own loop, 2 processes", theirs)):
        print(f"| {name} | {wall:.1f} | {cpu:.1f} |")
    print(f"ratio: {theirs[0] / ours[0]:.2f} on the wall, {theirs[1] / ours[1]:.2f} of the processor")


if __name__ == "__main__":
    main()
