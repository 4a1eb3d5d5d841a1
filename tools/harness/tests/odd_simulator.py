"""`toy_simulator`'s point, and what can be wrong with an environment: `--env-module odd_simulator --task ODD`."""

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from toy_simulator import Slide

from actrm_harness.simulators import Description, Episode, Initial, Options, Stepped
from actrm_harness.tasks import Task, register
from actrm_harness.wire import Array, Tensors


@dataclass
class Odd(Slide):
    """What is wrong is the task's name."""

    task: str = ""
    seed: int = 0

    def describe(self) -> Description:
        """One without limits and one whose limits are no numbers."""
        found = super().describe()
        limits = {"Unlimited": np.full(1, np.inf), "NanLimit": np.full(1, np.nan)}
        limit = limits.get(self.task, found.action_high)
        return replace(found, action_low=-limit, action_high=limit)

    def reset(self, seed: int, demonstration: bool) -> Initial:
        """One whose resets hang, and one whose description of an episode is no JSON."""
        first = super().reset(seed, demonstration)
        self.seed = seed
        if self.task == "ResetHangs":
            time.sleep(3600)
        return replace(first, ep_meta={"size": np.nan}) if self.task == "NanMeta" else first

    def step(self, actions: Array) -> Stepped:
        """Rewards and successes that are no numbers, steps that hang: always, or once a seed."""
        hangs = self.task == "StepHangs"
        if self.task == "HangsOnce":
            mark = Path(os.environ["ODD_FOLDER"]) / str(self.seed)
            hangs = not mark.exists()
            mark.touch()
        if hangs:
            time.sleep(3600)
        done = super().step(actions)
        odd = {
            "NanReward": {"rewards": np.append(done.rewards[:-1], np.nan)},
            "NanSuccess": {"success": np.float64("nan")},
            "NanProgress": {"progress": float("nan")},
            "NanSeen": {"observation": {"place": np.full(1, np.nan)}},
        }
        return replace(done, **odd.get(self.task, {}))

    def expert(self, seed: int, demonstration: bool, expert: str | None = None, skill: str | None = None) -> Episode:
        """One that is lost in its fourth step, half way."""
        if self.task != "ExpertLoses":
            return super().expert(seed, demonstration, expert, skill)
        nothing = np.zeros(4)
        tensors: Tensors = {"actions": nothing[:, None], "rewards": nothing, "dones": np.array([0, 0, 0, 1])}
        return Episode(False, 4, {}, tensors, 0.5, "fell")


def start(options: Options) -> Odd:
    """The simulation of a task."""
    return Odd(task=options.task.name)


NAMES = (
    "Unlimited",
    "NanLimit",
    "ResetHangs",
    "StepHangs",
    "HangsOnce",
    "NanMeta",
    "NanReward",
    "NanSuccess",
    "NanProgress",
    "NanSeen",
    "ExpertLoses",
)
for name in NAMES:
    register(Task(name, simulator=__name__, max_steps=30))
