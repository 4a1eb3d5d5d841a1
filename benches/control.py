"""The compiled control loop beside robosuite's own: time of a control step, and how far the two drift apart.

    .venv/bin/python benches/control.py [--tasks Lift,Door] [--steps 200] [--seeds 3]

One process, one core. Times are CPU time of the stepping thread, the loops taking turns step by step on the same
actions, so that the ratios hold on a busy machine too. Writes target/bench/control.json; the exit code is 1 where a
bar is missed.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
sys.path.insert(0, str(ROOT / "tools" / "harness"))
os.environ.setdefault("ACTRM_CONTROL_LIB", str(TARGET / "release" / "libcontrol.so"))

from actrm_harness import suite  # noqa: E402

suite.prepare()

import numpy as np  # noqa: E402
from actrm_harness import control, envs  # noqa: E402
from actrm_harness.wire import Array  # noqa: E402

SPEED_BARS = {"Lift": 5.0, "Stack": 5.0, "PickPlaceCan": 3.5, "NutAssemblySquare": 3.0, "Door": 4.5}
RAW_BAR = 1.3
SUBSTEPS = 25


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    work: str
    unit: str
    ours: float
    peer: float
    ratio: float
    bar: str
    met: bool
    aim: bool = False
    """Wished for, not promised: missing it does not fail the run."""


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", default=",".join(SPEED_BARS))
    parser.add_argument("--steps", type=int, default=200, help="timed control steps a task")
    parser.add_argument("--seeds", type=int, default=3, help="episodes compared a task")
    parser.add_argument("--out", type=Path, default=TARGET / "bench" / "control.json")
    args = parser.parse_args()
    rows: list[Row] = []
    for task in args.tasks.split(","):
        for row in (*speed(task, args.steps), *parity(task, args.seeds)):
            if not rows:
                print(line("work", "ours", "peer", "ratio", "bar", ""))
            rows.append(row)
            ratio = f"{row.ratio:.2f}" if row.ratio < 1e4 else f"{row.ratio:.0e}"
            print(line(row.work, show(row.ours, row.unit), show(row.peer, row.unit), ratio, row.bar, verdict(row)))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    report = {
        "bench": "control",
        "peer": f"robosuite {suite.robosuite().__version__}, mujoco {suite.mujoco().__version__}",
        "rows": [asdict(row) for row in rows],
    }
    args.out.write_text(json.dumps(report, indent=1) + "\n")
    print(f"written: {args.out}")
    return 0 if all(row.met or row.aim for row in rows) else 1


def line(*cells: str) -> str:
    """One line of the table."""
    return "  ".join(cell.ljust(width) for cell, width in zip(cells, (58, 10, 10, 8, 30, 6), strict=True)).rstrip()


def show(value: float, unit: str) -> str:
    """A number for people."""
    return f"{value:.3f} {unit}" if unit == "ms" else f"{value:.1e}"


def verdict(row: Row) -> str:
    """Whether the bar is met."""
    return "ok" if row.met else "over" if row.aim else "MISSED"


def wander(seed: int, steps: int) -> Iterator[Array]:
    """Actions that wander: down towards the table at first, fingers opening and closing."""
    rng = np.random.default_rng(seed)
    action = np.zeros(7)
    for index in range(steps):
        action = 0.9 * action + rng.normal(size=7) * [0.15, 0.15, 0.15, 0.1, 0.1, 0.1, 1.0]
        moved = np.clip(action, -1.0, 1.0)
        moved[2] -= 0.3 if index < 20 else 0.0
        yield moved


def seeded(env: Any, seed: int) -> None:
    """Reset as the worker does."""
    env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state
    env.reset()


def attached(env: Any) -> control.CompiledControl:
    """The compiled loop; without it there is nothing to measure."""
    compiled = control.attach(env)
    if compiled is None:
        raise SystemExit("benches/control.py: the compiled loop could not be attached (cargo build --release)")
    return compiled


def speed(task: str, steps: int) -> Iterator[Row]:
    """A control step: the whole of it, observations and reward included, and beside MuJoCo alone."""
    plain, ours, raw = (envs.make(task).env for _ in range(3))
    for env in (plain, ours, raw):
        seeded(env, 1)
    compiled = attached(ours)
    mujoco = suite.mujoco()
    model, data = raw.sim.model._model, raw.sim.data._data

    def physics(_: Array) -> None:
        for _ in range(SUBSTEPS):
            mujoco.mj_step1(model, data)
            mujoco.mj_step2(model, data)

    loops: dict[str, Callable[[Array], Any]] = {"plain": plain.step, "ours": compiled.step, "raw": physics}
    seen: dict[str, list[float]] = {name: [] for name in loops}
    for action in wander(1, steps + 10):
        start = ours.sim.data._data
        data.qpos[:], data.qvel[:], data.ctrl[:] = start.qpos, start.qvel, start.ctrl
        for name, loop in loops.items():
            before = time.thread_time()
            loop(action)
            seen[name].append(1e3 * (time.thread_time() - before))
    plain_ms, ours_ms, raw_ms = (float(np.median(seen[name][10:])) for name in ("plain", "ours", "raw"))
    ratio, bar = plain_ms / ours_ms, SPEED_BARS[task]
    yield Row(f"{task}: env.step", "ms", ours_ms, plain_ms, ratio, f">= {bar:g} times as fast", ratio >= bar)
    over = ours_ms / raw_ms
    work, text = f"{task}: env.step beside 25 x MuJoCo alone", f"aim: <= {RAW_BAR} times"
    yield Row(work, "ms", ours_ms, raw_ms, over, text, over <= RAW_BAR, aim=True)
    for env in (plain, ours, raw):
        env.close()


def parity(task: str, seeds: int) -> Iterator[Row]:
    """How far joint positions are from robosuite's, and robosuite's from its own after a push of 1 ulp."""
    plain, other = envs.make(task).env, envs.make(task).env
    compiled = attached(other)
    marks = {1: 25, 20: 500, 200: 5000}
    ours: dict[int, list[float]] = {substeps: [] for substeps in marks.values()}
    moved: dict[int, list[float]] = {substeps: [] for substeps in marks.values()}
    for seed in range(seeds):
        for found, step, push in ((ours, compiled.step, False), (moved, other.step, True)):
            seeded(plain, seed)
            seeded(other, seed)
            if push:
                other.sim.data.qpos[3] = np.nextafter(other.sim.data.qpos[3], 9.0)
            for index, action in enumerate(wander(seed, 200), start=1):
                plain.step(action)
                step(action)
                if index in marks:
                    found[marks[index]].append(float(np.abs(plain.sim.data.qpos - other.sim.data.qpos).max()))
    for substeps, bar in ((25, 1e-14), (500, 1e-12), (5000, None)):
        mine, theirs = float(np.median(ours[substeps])), float(np.median(moved[substeps]))
        work = f"{task}: |dqpos| at {substeps} substeps, median of {seeds}"
        # which contact comes first decides between the two: orders of magnitude, not digits
        beside = mine <= 100.0 * theirs
        met = beside if bar is None else mine <= bar
        text = "peer: itself moved by 1 ulp" if bar is None else f"<= {bar:g}"
        yield Row(work, "", mine, theirs, mine / theirs if theirs else float(mine > 0), text, met)
    plain.close()
    other.close()


if __name__ == "__main__":
    sys.exit(main())
