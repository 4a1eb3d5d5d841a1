"""actrm's tasks as LeRobot's environments, whose observations have LeRobot's older names."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium
from actrm.envs import TASKS, RobotEnv
from gymnasium import spaces
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

CAMERA = "observation.images."
NAMES = {"observation.state": "agent_pos", "observation.environment_state": "environment_state"}


class LerobotEnv(gymnasium.ObservationWrapper[Any, Any, Any]):
    """A task whose observations are called as LeRobot's environments call them."""

    def __init__(self, **options: Any) -> None:
        env = RobotEnv(**options)
        super().__init__(env)
        self._max_episode_steps = env.max_steps
        self.task_description = self.task = env.task
        self.observation_space = spaces.Dict(self.observation(env.observation_space.spaces))

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Other names, and cameras in a dict of their own."""
        named = {NAMES.get(key, key): value for key, value in observation.items() if not key.startswith(CAMERA)}
        pixels = {key[len(CAMERA) :]: value for key, value in observation.items() if key.startswith(CAMERA)}
        if not pixels:
            return named
        space = isinstance(next(iter(pixels.values())), spaces.Space)
        return {**named, "pixels": spaces.Dict(pixels) if space else pixels}


for _task in TASKS:
    gymnasium.register(
        id=f"actrm_lerobot/{_task}-v0",
        entry_point="lerobot_policy_actrm.environment_actrm:LerobotEnv",
        kwargs={"task": _task},
    )


@EnvConfig.register_subclass("actrm")
@dataclass
class ActrmEnv(EnvConfig):
    """One of actrm's tasks, with the features of an entry where one is named.

    Its task is the one named, else the entry's, else Stack.
    """

    task: str | None = None
    fps: int = 20
    entry: str | None = None
    python: str | None = None
    render_mode: str = "rgb_array"
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Ask an environment what it shows."""
        if self.task is None and self.entry is None:
            self.task = "Stack"
        env = RobotEnv(self.task, entry=self.entry, python=self.python)
        self.task = env.task
        shape = env.action_space.shape or ()
        self.features = {"action": PolicyFeature(FeatureType.ACTION, shape)}
        self.features_map = {"action": "action"}
        for name, space in env.observation_space.spaces.items():
            shape = space.shape or ()
            if name.startswith(CAMERA):
                key, kind = f"pixels/{name[len(CAMERA) :]}", FeatureType.VISUAL
            else:
                key = NAMES.get(name, name)
                kind = FeatureType.ENV if key == "environment_state" else FeatureType.STATE
            self.features[key] = PolicyFeature(kind, shape)
            self.features_map[key] = name
        env.close()

    @property
    def gym_id(self) -> str:
        """The name that gymnasium knows."""
        return f"actrm_lerobot/{self.task}-v0"

    @property
    def package_name(self) -> str:
        """Where it is registered."""
        return "lerobot_policy_actrm"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """What the environment is made with."""
        return {"entry": self.entry, "python": self.python, "render_mode": self.render_mode}
