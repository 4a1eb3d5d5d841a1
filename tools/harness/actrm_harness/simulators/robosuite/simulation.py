"""An environment of robosuite, as the worker asks for it."""

import platform
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from actrm_harness.simulators import Description, Episode, Initial, Options, Stepped, Stored, packages
from actrm_harness.simulators.robosuite import control, envs, episodes, suite
from actrm_harness.wire import Array

try:
    from threadpoolctl import threadpool_info  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]
except ImportError:
    # another Python than ours, with a robosuite of its own
    threadpool_info = None


@dataclass(slots=True)
class Robosuite:
    """A session, and what can be asked of it."""

    session: envs.Session

    @staticmethod
    def start(options: Options) -> "Robosuite":
        """Make the environment and attach the compiled control loop where it is wanted and known."""
        session = envs.make(
            options.task.name, options.cameras, options.size, options.env_args, fast_render=options.fast_render
        )
        if options.control == "compiled":
            session.control = control.attach(session.env)
        return Robosuite(session)

    def describe(self) -> Description:
        """Versions, shapes and the environment's arguments."""
        env = self.session.env
        low, high = env.action_spec
        models = [getattr(robot, "robot_model", None) for robot in env.robots]
        seen = {name: list(value.shape) for name, value in envs.reset(self.session, 0).items()}
        if self.session.control is None:
            envs.compile_control(env)
        return Description(
            env_name=self.session.task.name,
            control="robosuite" if self.session.control is None else "compiled",
            control_freq=int(env.control_freq),
            action_low=low,
            action_high=high,
            observations=seen,
            versions={
                "robosuite": suite.robosuite().__version__,
                "mujoco": suite.mujoco().__version__,
                "python": platform.python_version(),
                "numpy": np.__version__,
            },
            env_args=self.session.env_args,
            unusual=self.session.unusual,
            stages=[name for name, _ in self.session.stages],
            kernels=kernels(),
            renderer=envs.renderer(self.session).name() if self.session.cameras else None,
            packages=frozenset({"mujoco"}).union(*map(packages, (env, *env.robots, *models))),
        )

    def reset(self, seed: int, demonstration: bool) -> Initial:
        """Begin the episode of `seed`."""
        first = envs.reset(self.session, seed, demonstration)
        drawing_ms = self.session.drawing_ms
        return Initial(first, envs.fingerprint(self.session.env), self.session.env.get_ep_meta(), drawing_ms)

    def step(self, actions: Array) -> Stepped:
        """Do one action, or one a row until the task is solved or lost."""
        checked = envs.check_actions(self.session.env, actions)
        envs.slim(self.session)
        result, rewards = envs.steps_session(self.session, checked)
        progress = self.session.progress(result.success)
        return Stepped(result.observation, rewards, result.success, result.failure, self.session.drawing_ms, progress)

    def expert(self, seed: int, demonstration: bool, expert: str | None = None, skill: str | None = None) -> Episode:
        """One whole episode of the task's scripted expert."""
        return episodes.expert_episode(self.session, seed, demonstration, expert, skill)

    def extract(self, stored: Stored) -> Episode:
        """What stored states look like."""
        return episodes.extract(self.session, stored.states, stored.actions, stored.model_file, stored.ep_meta)

    def image(self, camera: str, height: int, width: int) -> Array:
        """What a camera sees now."""
        return envs.image(self.session, camera, height, width)


def kernels() -> str | None:
    """The kernels that the loaded linear algebra runs, such as `openblas Haswell`; None where that cannot be told."""
    loaded = [] if threadpool_info is None else cast("list[dict[str, Any]]", threadpool_info())
    found = {f"{one['internal_api']} {one['architecture']}" for one in loaded if one.get("architecture")}
    return ", ".join(sorted(found)) or None
