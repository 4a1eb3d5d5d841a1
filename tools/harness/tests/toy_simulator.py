"""A simulator of a few lines, to show what another one has to be: `--env-module toy_simulator --task Slide`."""

import hashlib
from dataclasses import dataclass, field

import numpy as np

from actrm_harness.protocol import RequestError
from actrm_harness.simulators import Description, Episode, Initial, Options, Stepped, Stored
from actrm_harness.tasks import Task, register
from actrm_harness.wire import Array


@dataclass
class Slide:
    """A point on a line that has to be brought to zero."""

    place: Array = field(default_factory=lambda: np.zeros(1))

    def describe(self) -> Description:
        """One number to see, one to act with."""
        limit = np.ones(1)
        return Description("Slide", "own", 10, -limit, limit, {"place": [1]}, {"toy": "0.1"})

    def reset(self, seed: int, demonstration: bool) -> Initial:
        """Somewhere right of zero."""
        del demonstration
        self.place = np.random.default_rng(seed).uniform(1.0, 2.0, size=1)
        return Initial(
            {"place": self.place}, hashlib.sha256(self.place.tobytes()).hexdigest(), {"lang": "slide to zero"}
        )

    def step(self, actions: Array) -> Stepped:
        """Move, until it is there."""
        rewards: list[float] = []
        for action in actions.reshape(-1, 1):
            self.place = self.place + 0.1 * action
            rewards.append(float(abs(self.place[0]) < 0.1))
            if rewards[-1]:
                break
        return Stepped({"place": self.place}, np.array(rewards), bool(rewards[-1]))

    def expert(self, seed: int, demonstration: bool, expert: str | None = None, skill: str | None = None) -> Episode:
        """There is none."""
        raise RequestError("no_expert", f"nobody knows how, seed {seed}, {demonstration}, {expert}, {skill}")

    def extract(self, stored: Stored) -> Episode:
        """Nothing is stored."""
        raise RequestError("bad_request", f"{len(stored.states)} states of something else")

    def image(self, camera: str, height: int, width: int) -> Array:
        """Nothing is to be seen."""
        raise RequestError("unknown_camera", f"no camera {camera}, of {height} x {width} or otherwise")


def start(options: Options) -> Slide:
    """The simulation of a task."""
    assert options.task.name == "Slide"
    return Slide()


register(Task("Slide", simulator=__name__, max_steps=30))
