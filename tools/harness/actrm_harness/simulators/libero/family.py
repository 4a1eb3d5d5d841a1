"""All tasks of a suite as one task: `libero_object`. Seed s is the episode of seed s // n of task s % n of n.

The environments of the first `KEPT` tasks that are asked for stay. Of the others one is there at a time: each takes
0.3 GB, and a second to make.
"""

import ctypes
import gc
from dataclasses import dataclass, field, replace
from typing import Any, cast

from actrm_harness.protocol import RequestError
from actrm_harness.simulators import Description, Episode, Initial, Options, Stepped, Stored
from actrm_harness.simulators.libero import suite
from actrm_harness.simulators.libero.simulation import COMMON, Libero
from actrm_harness.simulators.robosuite.render import Renderer
from actrm_harness.wire import Array, Tensors

KEPT = 5


@dataclass(slots=True)
class Family:
    """The environments of a suite's tasks, made when they are asked for."""

    options: Options
    tasks: int
    made: dict[int, Libero] = field(default_factory=dict[int, Libero])
    present: Libero | None = None
    """The one whose episode it is."""
    renderer: Renderer | None = None
    """What draws all of them."""

    @staticmethod
    def start(options: Options) -> "Family":
        """Look for the files of all tasks."""
        if options.env_args is not None:
            options = replace(options, env_args=of_tasks(options.task.name, options.env_args))
        tasks = suite.tasks(options.task.name)
        for number in range(tasks):
            suite.files(f"{options.task.name}/{number}")
        return Family(options, tasks)

    def task(self, number: int, keep: bool = True) -> Libero:
        """The environment of a task, with no other episode under way."""
        one = self.made.get(number)
        if one is None and self.present is not None and self.present.files.number == number:
            one = self.present
        if one is None:
            if self.present is not None and self.present.files.number not in self.made:
                self.present = None
                gc.collect()
            name = f"{self.options.task.name}/{number}"
            one = Libero.start(replace(self.options, task=replace(self.options.task, name=name)))
            # what loading a model took beside the model
            ctypes.CDLL(None).malloc_trim(0)
        if keep and len(self.made) < KEPT:
            self.made[number] = one
        if self.options.cameras and self.renderer is None:
            self.renderer = one.drawn_by()
        one.renderer, self.present = self.renderer, one
        return one

    def now(self) -> Libero:
        """The environment whose episode it is."""
        if self.present is None:
            raise RequestError("bad_request", f"{self.options.task.name}: expected a reset first")
        return self.present

    def describe(self) -> Description:
        """What its first task is, and the observations that all of its tasks have."""
        first = self.task(0, keep=False).describe()
        kwargs = first.env_args["env_kwargs"] | {"bddl_file_name": self.options.task.name}
        observations = {name: shape for name, shape in first.observations.items() if self.shared(name)}
        arguments = first.env_args | {"env_name": self.options.task.name, "env_kwargs": kwargs}
        return replace(first, env_name=self.options.task.name, observations=observations, env_args=arguments)

    def reset(self, seed: int, demonstration: bool) -> Initial:
        """Begin the episode of `seed`, in the environment of its task."""
        one = self.task(seed % self.tasks)
        first = one.reset(seed // self.tasks, demonstration)
        meta = first.ep_meta | {"group": f"{one.files.suite}/{one.files.number}"}
        return replace(first, observation=self.common(first.observation), ep_meta=meta)

    def step(self, actions: Array) -> Stepped:
        """Do one action, or one a row until the task is solved."""
        done = self.now().step(actions)
        return replace(done, observation=self.common(done.observation))

    def expert(self, seed: int, demonstration: bool, expert: str | None = None, skill: str | None = None) -> Episode:
        """One whole episode of the scripted expert of the seed's task."""
        from actrm_harness.simulators.libero.expert_episode import expert_episode

        one = self.task(seed % self.tasks)
        return self.shortened(expert_episode(one, seed // self.tasks, demonstration, expert, skill))

    def extract(self, stored: Stored) -> Episode:
        """Nothing is extracted yet."""
        return self.now().extract(stored)

    def image(self, camera: str, height: int, width: int) -> Array:
        """What a camera sees now, upright."""
        return self.now().image(camera, height, width)

    def shared(self, name: str) -> bool:
        """Whether all tasks observe this."""
        return name.startswith(COMMON) or name.removesuffix("_image") in self.options.cameras

    def common(self, observation: Tensors) -> Tensors:
        """Of an observation what all tasks have."""
        return {name: value for name, value in observation.items() if self.shared(name)}

    def shortened(self, episode: Episode) -> Episode:
        """The episode with observations that all tasks have."""
        kept: Tensors = {
            name: value
            for name, value in episode.tensors.items()
            if not (place := name.split("/", 1))[0].endswith("obs") or self.shared(place[-1])
        }
        return replace(episode, tensors=kept)


def of_tasks(name: str, recorded: dict[str, Any]) -> dict[str, Any]:
    """The recorded arguments of a suite as each of its tasks has them; RequestError where they are of another one."""
    kwargs = recorded.get("env_kwargs")
    problem = cast("dict[str, Any]", kwargs).get("bddl_file_name", name) if isinstance(kwargs, dict) else name
    if problem != name:
        raise RequestError("env_args", f"{name}: expected bddl_file_name {name!r}, the suite, found {problem!r}")
    if not isinstance(kwargs, dict):
        return recorded
    others = {key: value for key, value in cast("dict[str, Any]", kwargs).items() if key != "bddl_file_name"}
    return recorded | {"env_kwargs": others}
