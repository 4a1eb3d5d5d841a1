"""gymnasium environments on the workers of evaluations: `gymnasium.make("actrm/Stack-v0")` after `import actrm.envs`.

An episode is the one that `actrm-zoo eval` runs with its seed. Observations are dicts with LeRobot's keys, so that a
policy's `select_action` takes them as they are; which features they have is an entry's (`entry=`), or by default the
robot's state and the joined objects.
"""

from __future__ import annotations

from typing import Any, ClassVar, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from . import Simulator, simulator_python

TASKS = (
    "Door",
    "Lift",
    "NutAssembly",
    "NutAssemblyRound",
    "NutAssemblySquare",
    "PickAny",
    "PickChain",
    "PickPlace",
    "PickPlaceBread",
    "PickPlaceCan",
    "PickPlaceCereal",
    "PickPlaceMilk",
    "Recall",
    "RecallHeld",
    "RoundPillar",
    "Stack",
    "StackColor",
    "StackThreeCubes",
    "TableMaze",
    "TableMaze10",
    "ToolHang",
    "TwoArmHandover",
    "TwoArmLift",
    "TwoArmPegInHole",
    "TwoArmTransport",
    "Wipe",
)

Observation = dict[str, NDArray[Any]]


class RobotEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One task in a worker process of its own.

    Parameters
    ----------
    task: the task's name.
    entry: an entry whose features and environment to use; also its task unless one is named.
    keys: instead, for each feature its observation keys.
    max_steps: the step limit of an episode; the task's own unless given. An episode that reaches it is truncated.
    render_mode: `rgb_array` or none.
    camera, size: what `render` shows.
    control, python, env_module: as in `actrm.evaluate`.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(
        self,
        task: str | None = None,
        *,
        entry: str | None = None,
        keys: dict[str, list[str]] | None = None,
        max_steps: int | None = None,
        render_mode: str | None = None,
        camera: str = "agentview",
        size: int = 256,
        control: str = "compiled",
        python: str | None = None,
        env_module: str | None = None,
    ) -> None:
        if max_steps is not None and max_steps < 1:
            raise ValueError(f"max_steps: expected at least 1, found {max_steps}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: expected 'rgb_array' or None, found {render_mode!r}")
        self._simulator = Simulator(
            task,
            entry=entry,
            keys=keys,
            control=control,
            python=python or simulator_python(),
            env_module=env_module,
        )
        self.task = self._simulator.task
        self.render_mode = render_mode
        self.max_steps = max_steps if max_steps is not None else self._simulator.max_steps
        self._camera, self._size = camera, size
        self._steps = 0
        low, high = self._simulator.action_limits
        self.action_space = spaces.Box(low, high, dtype=np.float32)

        def space(shape: tuple[int, ...]) -> spaces.Space[Any]:
            if len(shape) == 3:
                return spaces.Box(0, 255, shape, np.uint8)
            return spaces.Box(-np.inf, np.inf, shape, np.float32)

        self.observation_space = spaces.Dict({name: space(shape) for name, shape in self._simulator.features.items()})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin the episode of `seed`; without one that of a seed drawn from the last one."""
        super().reset(seed=seed, options=options)
        self._steps = 0
        episode = seed if seed is not None else int(self.np_random.integers(1 << 31))
        observation, info = self._simulator.reset(episode)
        return observation, {**info, "is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Execute an action, clipped to its limits."""
        observation, reward, success, failure = self._simulator.step(action)
        self._steps += 1
        terminated = success or failure is not None
        truncated = not terminated and self._steps >= self.max_steps
        return observation, reward, terminated, truncated, {"is_success": success, "failure": failure}

    def render(self) -> NDArray[np.uint8] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A picture of the present state."""
        if self.render_mode != "rgb_array":
            return None
        return self._simulator.render(self._camera, self._size, self._size)

    def close(self) -> None:
        """End the worker."""
        self._simulator.close()


for _task in TASKS:
    gymnasium.register(id=f"actrm/{_task}-v0", entry_point="actrm.envs:RobotEnv", kwargs={"task": _task})
