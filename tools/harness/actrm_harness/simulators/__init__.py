"""The simulators that a worker can hold, one folder each, and what a worker asks of one.

A row of `tasks` names its simulator: a module of this package, or any other module that Python finds, with a
function `start(options: Options) -> Simulation`. Importing that module must not import the simulator: `start` does. A
function `prepare()`, if there is one, sets what has to be set before anybody imports the simulator. `REQUIREMENTS`, if
there are any, name the packages that it needs and the virtual environment that has them.
"""

import importlib
import importlib.util
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from actrm_harness.protocol import RequestError
from actrm_harness.tasks import Task
from actrm_harness.wire import Array, Tensors


@dataclass(frozen=True, slots=True)
class Requirements:
    """What a simulator runs in."""

    packages: tuple[str, ...]
    """Modules that must be found."""
    venv: str = ".venv"
    """Name of the virtual environment that has them; it lies beside the one that the worker was started in."""
    install: str = ""
    """The command that makes it."""


@dataclass(frozen=True, slots=True)
class Options:
    """What a worker was told to be."""

    task: Task
    control: str = "compiled"
    cameras: tuple[str, ...] = ()
    size: int = 84
    fast_render: bool = False
    """Draw without reflections and multisampling: a third of the time, and other pixels."""
    env_args: dict[str, Any] | None = None
    """robomimic's `env_args` of an environment that is not the task's usual one: other robots or controllers."""


@dataclass(frozen=True, slots=True)
class Description:
    """What an environment takes and gives, and what it runs on."""

    env_name: str
    control: str
    control_freq: int
    action_low: Array
    action_high: Array
    observations: dict[str, list[int]]
    versions: dict[str, str]
    """The simulator's version, under its name, and those of what it stands on."""
    env_args: dict[str, Any] = field(default_factory=dict[str, Any])
    unusual: str | None = None
    """SHA-256 of the environment's arguments, where they are not the task's usual ones."""
    stages: list[str] = field(default_factory=list[str])
    """What an episode passes before the task is solved, in order, where that is known."""
    kernels: str | None = None
    """Which kernels numpy's linear algebra runs, where that can be told."""
    renderer: str | None = None
    """What draws the pictures, where there are cameras."""
    packages: frozenset[str] = frozenset()
    """Modules that decide what happens, beside those of the simulation's class and of the simulator's name."""


@dataclass(frozen=True, slots=True)
class Initial:
    """What a reset left."""

    observation: Tensors
    fingerprint: str
    """SHA-256 of the initial state."""
    ep_meta: dict[str, Any]
    drawing_ms: float = 0.0
    """How long the observation's pictures took; for results only, nothing depends on it."""


@dataclass(frozen=True, slots=True)
class Stepped:
    """What control steps led to."""

    observation: Tensors
    rewards: Array
    """Of each step that was done; success and failure end them early."""
    success: bool
    failure: str | None = None
    """In a word why the task can no longer be solved, where that is known: the episode ends."""
    drawing_ms: float = 0.0
    """How long the observation's pictures took."""
    progress: float | None = None
    """Which share of its way the episode has come, 1 where the task is solved; where stages are known."""


OF_THE_FILE = "data/"
"""Begins the name of an attribute that is not the demo's but the group `data`'s."""


@dataclass(frozen=True, slots=True)
class Episode:
    """One recorded episode and the attributes of its demo."""

    success: bool
    steps: int
    attrs: dict[str, str]
    tensors: Tensors
    progress: float | None = None
    """Which share of its way it came before the task was solved, 1 if it was; where stages are known."""
    failure: str | None = None
    """In a word why the task could no longer be solved, where that ended the episode."""


@dataclass(frozen=True, slots=True)
class Stored:
    """A stored episode: robomimic's arrays, and what its attributes say."""

    states: Array
    actions: Array
    model_file: str
    ep_meta: dict[str, Any]


class Simulation(Protocol):
    """One environment of a simulator. What cannot be done is a `RequestError`."""

    def describe(self) -> Description:
        """What it is; before anything else is asked."""
        ...

    def reset(self, seed: int, demonstration: bool) -> Initial:
        """Begin the episode of `seed`, which depends on the seed alone."""
        ...

    def step(self, actions: Array) -> Stepped:
        """Do one action, or one a row until the task is solved or lost."""
        ...

    def expert(self, seed: int, demonstration: bool, expert: str | None = None, skill: str | None = None) -> Episode:
        """One whole episode of the task's scripted expert, or of another of them by its name, of a skill if named."""
        ...

    def extract(self, stored: Stored) -> Episode:
        """What stored states look like."""
        ...

    def image(self, camera: str, height: int, width: int) -> Array:
        """What a camera sees now: U8 of (height, width, 3)."""
        ...


def packages(thing: object) -> frozenset[str]:
    """The top-level modules that define the class of `thing`."""
    return frozenset(each.__module__.split(".")[0] for each in type(thing).__mro__)


def verdict(value: Any) -> bool:
    """Whether the task is solved; RequestError where the environment says neither yes nor no."""
    if not isinstance(value, bool | np.bool_):
        number: Array = np.asarray(value)
        if number.dtype.kind == "f" and not np.isfinite(number).all():
            raise RequestError("environment", f"the environment's success is {number.tolist()}, neither true nor false")
    return bool(value)


def finite(what: str, values: Array) -> Array:
    """Numbers that the environment gave; RequestError where one of them is none."""
    if not np.isfinite(values).all():
        step = int(np.flatnonzero(~np.isfinite(values))[0])
        raise RequestError("environment", f"the environment's {what} is {float(values.flat[step])} (step {step + 1})")
    return values


# Set in a worker that was started again in a simulator's own interpreter: there is no second time.
MOVED = "ACTRM_WORKER_MOVED"


def interpreter(simulator: str) -> str | None:
    """The interpreter that this simulator needs where the present one lacks its packages.

    It is the one that `ACTRM_PYTHON_<SIMULATOR>` names, else the one of the simulator's virtual environment.
    RequestError("missing_module") if there is none, or it is the present one.
    """
    needs: Requirements | None = getattr(_module(simulator), "REQUIREMENTS", None)
    missing = [name for name in needs.packages if importlib.util.find_spec(name) is None] if needs else []
    if needs is None or not missing:
        return None
    variable = f"ACTRM_PYTHON_{simulator.rsplit('.', 1)[-1].upper()}"
    python = os.environ.get(variable) or str(Path(sys.prefix).parent / needs.venv / "bin/python")
    if os.access(python, os.X_OK) and MOVED not in os.environ:
        return python
    text = f"{sys.executable} has no {', '.join(missing)}, which simulator {simulator} needs"
    install = f"run `{needs.install}` in the repository, or " if needs.install else ""
    raise RequestError("missing_module", f"{text}; {install}name a Python that has them by {variable}")


def start(options: Options) -> Simulation:
    """Start the simulator that the task's row names."""
    return cast(Simulation, _module(options.task.simulator).start(options))


def prepare(simulator: str) -> None:
    """Set what has to be set before anybody imports this simulator."""
    getattr(_module(simulator), "prepare", lambda: None)()


def _module(simulator: str) -> Any:
    own = f"{__name__}.{simulator}"
    # one in a package is none of ours
    ours = "." not in simulator and importlib.util.find_spec(own) is not None
    return importlib.import_module(own if ours else simulator)
