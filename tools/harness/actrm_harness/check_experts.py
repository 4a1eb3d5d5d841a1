"""Count how often the scripted experts succeed, and whether they do so with either control loop.

    PYTHONPATH=tools/harness .venv/bin/python -m actrm_harness.check_experts --task Door --seeds 200 --workers 2
    PYTHONPATH=tools/harness .venv/bin/python -m actrm_harness.check_experts --task Lift,Stack --control both
    PYTHONPATH=tools/harness .venv/bin/python -m actrm_harness.check_experts --task Door --skill poor

Every seed is the demonstration that `actrm-data collect` would record for it. With --out, a line of JSON is written for
each seed, and a second run goes on where the first was interrupted. The exit code is 1 where a bar is missed. The
compiled loop is the library that ACTRM_CONTROL_LIB names (target/release/libcontrol.so); `--control both` runs each
seed with robosuite's own loop too, which takes five times as long, and compares what came of it. Of skills other than
good the bar is 80%, and a line for each demonstrator says how often and how long they showed the task.
"""

import argparse
import json
import multiprocessing
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from actrm_harness.experts.skills import SHOWN_BY, SKILLS, USUAL
from actrm_harness.tasks import TASKS
from actrm_harness.worker import settle

if TYPE_CHECKING:
    from actrm_harness.simulators.robosuite.envs import Session

BARS = {task.name: task.bar for task in TASKS.values() if task.expert is not None}

# A step in which no action of the arm is larger than this is a pause.
STILL = 0.08

FIRST_SEED = 1_000_000


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of one seed."""

    task: str
    control: str
    seed: int
    success: bool
    steps: int
    pause: int
    """The longest run of steps in which the arm was hardly told to move."""
    expert: str | None = None
    """Which of the task's experts; None is the usual one."""
    skill: str = USUAL
    """What was asked for."""
    shown_by: str = USUAL
    """The skill of whoever showed it."""


# Of seeds, share that must end alike with both loops.
SAME = 0.99

# Of seeds, share that less able demonstrators have to solve.
LESS_ABLE = 0.80

_session: "Session | None" = None
_expert: str | None = None
_skill: str = USUAL


def main() -> int:
    """Run the seeds that are missing, count, compare."""
    settle()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="all", help="a task, several with commas, or all (default)")
    parser.add_argument("--seeds", type=int, default=200, help="episodes a task (default: %(default)s)")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="the first seed (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument(
        "--control", default="compiled", choices=["compiled", "robosuite", "both"], help="loop (default: %(default)s)"
    )
    parser.add_argument("--expert", help="another of the task's experts than the usual one, by its name")
    parser.add_argument(
        "--skill", default=USUAL, choices=list(SHOWN_BY), help="who shows the episodes (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, help="a file of one line of JSON a seed; what it holds is not run again")
    args = parser.parse_args()
    tasks = list(BARS) if args.task == "all" else args.task.split(",")
    unknown = sorted(set(tasks) - set(BARS))
    if unknown:
        parser.error(f"no expert for {', '.join(unknown)}; known: {', '.join(BARS)}")
    loops = ["compiled", "robosuite"] if args.control == "both" else [args.control]
    wanted = range(args.first, args.first + args.seeds)
    met = True
    for task in tasks:
        found: list[list[Outcome]] = []
        for loop in loops:
            wanted_of = (task, loop, args.expert, args.skill)
            known = {
                each.seed: each
                for each in read(args.out)
                if (each.task, each.control, each.expert, each.skill) == wanted_of
            }
            for outcome in play(wanted_of, [seed for seed in wanted if seed not in known], args.workers):
                known[outcome.seed] = outcome
                if args.out:
                    write(args.out, outcome)
            found.append([known[seed] for seed in wanted])
            met &= report(task, found[-1])
        if args.control == "both":
            met &= compare(task, *found)
    return 0 if met else 1


def read(path: Path | None) -> list[Outcome]:
    """The outcomes of an earlier run; a line that was cut off is not one."""
    if path is None or not path.exists():
        return []
    found: list[Outcome] = []
    for line in path.read_text().split("\n")[:-1]:
        with suppress(json.JSONDecodeError):
            found.append(Outcome(**json.loads(line)))
    return found


def write(path: Path, outcome: Outcome) -> None:
    """Add an outcome, on a line of its own whatever an earlier run left."""
    with path.open("a+b") as file:
        if file.tell() > 0:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")
        file.write(json.dumps(asdict(outcome)).encode() + b"\n")


def play(of: tuple[str, str, str | None, str], seeds: list[int], workers: int) -> Iterator[Outcome]:
    """The outcomes of these seeds, in any order."""
    if not seeds:
        return
    processes = multiprocessing.get_context("spawn").Pool(min(workers, len(seeds)), _start, of)
    with processes as pool:
        yield from pool.imap_unordered(_play, seeds)


def _start(task: str, loop: str, expert: str | None, skill: str) -> None:
    global _session, _expert, _skill  # noqa: PLW0603
    from actrm_harness.simulators.robosuite import suite

    suite.prepare()
    from actrm_harness.simulators.robosuite import control, envs

    _expert, _skill = expert, skill
    _session = envs.make(task)
    if loop == "compiled":
        _session.control = control.attach(_session.env)


def _play(seed: int) -> Outcome:
    import numpy as np

    from actrm_harness.simulators.robosuite import episodes

    assert _session is not None, "the pool's initializer made it"
    episode = episodes.expert_episode(_session, seed, name=_expert, skill=_skill)
    actions = episode.tensors["actions"]
    # six numbers an arm, then its fingers', where it has any
    arms = np.arange(actions.shape[1]) % 7 < 6
    moving = np.abs(actions[:, arms]).max(axis=1) > STILL
    longest = current = 0
    for moves in moving.tolist():
        current = 0 if moves else current + 1
        longest = max(longest, current)
    loop = "robosuite" if _session.control is None else "compiled"
    shown_by = episode.attrs.get("skill", USUAL)
    return Outcome(_session.task.name, loop, seed, episode.success, episode.steps, longest, _expert, _skill, shown_by)


def report(task: str, outcomes: list[Outcome]) -> bool:
    """Print a task's line, with the loop that ran; whether its bar is met."""
    loop = " and ".join(sorted({outcome.control for outcome in outcomes}))
    solved = sorted(outcome.steps for outcome in outcomes if outcome.success)
    failed = [outcome.seed for outcome in outcomes if not outcome.success]
    bar = BARS[task] if {outcome.skill for outcome in outcomes} == {USUAL} else min(LESS_ABLE, BARS[task])
    met = len(solved) >= bar * len(outcomes)
    middle, last = (solved[len(solved) // 2], solved[-1]) if solved else (0, 0)
    pause = max((outcome.pause for outcome in outcomes if outcome.success), default=0)
    print(
        f"{task}, {loop} loop: {len(solved)} of {len(outcomes)} (bar {bar:.0%}, {'met' if met else 'MISSED'}), "
        f"steps median {middle}, most {last}, longest pause {pause}; failed seeds: {failed or 'none'}",
        flush=True,
    )
    of_each = {each: [outcome for outcome in outcomes if outcome.shown_by == each] for each in SKILLS}
    for each, shown in of_each.items():
        if shown and len(shown) < len(outcomes):
            solved = sorted(outcome.steps for outcome in shown if outcome.success)
            middle = solved[len(solved) // 2] if solved else 0
            print(f"  {each}: {len(solved)} of {len(shown)}, steps median {middle}", flush=True)
    return met


def compare(task: str, ours: list[Outcome], plain: list[Outcome]) -> bool:
    """Print in how many seeds both loops came to the same end; whether they are enough."""
    other = [mine.seed for mine, theirs in zip(ours, plain, strict=True) if mine.success != theirs.success]
    met = len(other) <= (1.0 - SAME) * len(ours)
    alike = sum(mine.steps == theirs.steps for mine, theirs in zip(ours, plain, strict=True))
    print(
        f"{task}, both loops: same outcome in {len(ours) - len(other)} of {len(ours)} (bar {SAME:.0%}, "
        f"{'met' if met else 'MISSED'}), same number of steps in {alike}; other seeds: {other or 'none'}",
        flush=True,
    )
    return met


if __name__ == "__main__":
    sys.exit(main())
