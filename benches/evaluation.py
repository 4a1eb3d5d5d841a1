"""A whole evaluation of ACT beside the same with robosuite's own control loop, and what a control step costs in it.

    .venv/bin/python benches/evaluation.py [--task Stack] [--episodes 50] [--rounds 1]

It collects a few demonstrations, trains ACT on them for a few steps (how well it acts does not matter here), and runs
`actrm-zoo eval` with 2 workers, start of the simulators included, the two loops taking turns. CPU time is that of the
program and all its workers. The cost of a step is the difference of two evaluations that differ in their length alone,
beside the same number of steps of the compiled loop in one process without policy and pipe. Writes
target/bench/evaluation.json; the exit code is 1 where a bar is missed.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import control as steps

ROOT = Path(__file__).resolve().parents[1]
BIN = steps.TARGET / "release"
SPEED_BAR = 3.0
OVERHEAD_BAR = 1.10


@dataclass(frozen=True, slots=True)
class Took:
    """Seconds."""

    wall: float
    cpu: float


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Stack")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--max-steps", type=int, default=120, help="length of an episode")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--out", type=Path, default=steps.TARGET / "bench" / "evaluation.json")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="actrm-bench-") as name:
        folder = Path(name)
        prepare(folder, args.task)
        rows = list(whole(folder, args)) + [overhead(folder, args.task)]
    print(steps.line("work", "ours", "peer", "ratio", "bar", ""))
    for row in rows:
        ours, peer = (f"{value:.2f} {row.unit}" for value in (row.ours, row.peer))
        print(steps.line(row.work, ours, peer, f"{row.ratio:.2f}", row.bar, steps.verdict(row)))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    report = {
        "bench": "evaluation",
        "peer": f"robosuite {steps.suite.robosuite().__version__}, its own control loop",
        "rows": [steps.asdict(row) for row in rows],
    }
    args.out.write_text(json.dumps(report, indent=1) + "\n")
    print(f"written: {args.out}")
    return 0 if all(row.met or row.aim for row in rows) else 1


def run(*command: object) -> Took:
    """Run a command that must succeed; its wall time and its CPU time with all its children's."""
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    environment = os.environ | {"ACTRM_PYTHON": sys.executable}
    done = subprocess.run([str(part) for part in command], env=environment, capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"{command[0]}: exit code {done.returncode}\n{done.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Took(time.perf_counter() - begun, cpu)


def prepare(folder: Path, task: str) -> None:
    """An entry of ACT's usual size for the task."""
    demos = folder / "demos.hdf5"
    run(BIN / "actrm-data", "collect", "--task", task, "--episodes", 4, "--out", demos)
    where = ["--data", demos, "--zoo", folder / "zoo", "--runs", folder / "runs"]
    run(BIN / "actrm-zoo", "train", "act_lift", *where, "entry=bench", f"task.name={task}", "train.steps=20")


def evaluate(folder: Path, episodes: int, max_steps: int, workers: int, *more: str) -> Took:
    """One evaluation, results in a folder of its own."""
    results = tempfile.mkdtemp(dir=folder)
    sizes = ["--episodes", episodes, "--max-steps", max_steps, "--workers", workers]
    return run(BIN / "actrm-zoo", "eval", "bench", *sizes, *more, "--zoo", folder / "zoo", "--results", results)


def whole(folder: Path, args: argparse.Namespace) -> list[steps.Row]:
    """The whole evaluation with either loop: least of the rounds."""
    seen: dict[str, list[Took]] = {"compiled": [], "robosuite": []}
    for _ in range(args.rounds):
        for loop, all_times in seen.items():
            all_times.append(evaluate(folder, args.episodes, args.max_steps, 2, "--control", loop))
    rows: list[steps.Row] = []
    for what in ("wall", "cpu"):
        ours, peer = (min(getattr(took, what) for took in seen[loop]) for loop in ("compiled", "robosuite"))
        work = f"{args.task}: ACT, {args.episodes} episodes of {args.max_steps} steps, 2 workers, {what}"
        # on a busy machine wall times say little: the bar is on CPU time
        met, aim = peer / ours >= SPEED_BAR, what == "wall"
        rows.append(steps.Row(work, "s", ours, peer, peer / ours, f">= {SPEED_BAR:g} times as fast", met, aim))
    return rows


def overhead(folder: Path, task: str) -> steps.Row:
    """CPU time of a control step in an evaluation beside that of the compiled loop alone: least of the rounds."""
    episodes, short, long, rounds = 6, 20, 220, 4
    count = episodes * (long - short)
    longer, shorter = (min(evaluate(folder, episodes, n, 1).cpu for _ in range(rounds)) for n in (long, short))
    whole_step = 1e3 * (longer - shorter) / count
    env: Any = steps.envs.make(task).env
    steps.seeded(env, 10_000)
    compiled = steps.attached(env)
    still = steps.np.zeros(7)
    for _ in range(20):
        compiled.step(still)
    took: list[float] = []
    for _ in range(rounds):
        begun = time.thread_time()
        for _ in range(count):
            compiled.step(still)
        took.append(time.thread_time() - begun)
    alone = 1e3 * min(took) / count
    env.close()
    ratio = whole_step / alone
    work = f"{task}: a control step with framing and inference beside env.step"
    return steps.Row(work, "ms", whole_step, alone, ratio, f"<= {OVERHEAD_BAR:g} times", ratio <= OVERHEAD_BAR)


if __name__ == "__main__":
    sys.exit(main())
