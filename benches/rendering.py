"""What the pictures of a control step cost: two cameras of 84 x 84 on Lift, drawn as `--fast-render` draws them and as
robosuite does, in turns.

    .venv/bin/python benches/rendering.py [--task Lift] [--steps 30]

CPU time of the process with all threads of the renderer, least of each step's repetitions, mean over the steps.
Writes target/bench/rendering.json; the exit code is 1 where a bar is missed.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import control as steps
from actrm_harness.simulators.robosuite.render import Renderer

CAMERAS = ("agentview", "robot0_eye_in_hand")
SIDE = 84
BAR = 20.0
REPEATS = 3


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Lift")
    parser.add_argument("--steps", type=int, default=30, help="control steps that are drawn")
    parser.add_argument("--out", type=Path, default=steps.TARGET / "bench" / "rendering.json")
    args = parser.parse_args()
    row = drawn(args.task, args.steps)
    print(steps.line("work", "ours", "peer", "ratio", "bar", ""))
    shown = (steps.show(row.ours, row.unit), steps.show(row.peer, row.unit), f"{row.ratio:.2f}", row.bar)
    print(steps.line(row.work, *shown, steps.verdict(row)))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    report = {"bench": "rendering", "peer": "the same with reflections and multisampling", "rows": [steps.asdict(row)]}
    args.out.write_text(json.dumps(report, indent=1) + "\n")
    print(f"written: {args.out}")
    return 0 if row.met else 1


def drawn(task: str, count: int) -> steps.Row:
    """Milliseconds of CPU time a step, with both ways to draw."""
    session = steps.envs.make(task)
    steps.envs.reset(session, 0)
    fast, usual = Renderer(fast=True), Renderer(fast=False)
    # the model's setting is read when a renderer first sees it: each has one of its own
    other = steps.envs.make(task)
    steps.envs.reset(other, 0)
    sides = ((fast, session), (usual, other))
    total = [0.0, 0.0]
    for index, action in enumerate(steps.wander(1, count + 1)):
        for side, (renderer, drawn_session) in enumerate(sides):
            drawn_session.env.step(action)
            took: list[float] = []
            for _ in range(REPEATS):
                begun = time.process_time()
                renderer.images(drawn_session.env.sim, CAMERAS, SIDE, SIDE)
                took.append(1e3 * (time.process_time() - begun))
            # the first loads textures and meshes
            total[side] += min(took) if index > 0 else 0.0
    ours, peer = (milliseconds / count for milliseconds in total)
    work = f"{task}: {len(CAMERAS)} pictures of {SIDE} x {SIDE} a step, CPU"
    return steps.Row(work, "ms", ours, peer, ours / peer, f"<= {BAR:g} ms", ours <= BAR)


if __name__ == "__main__":
    sys.exit(main())
