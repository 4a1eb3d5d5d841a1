"""The compiled control loop: robosuite's `env.step` with its inner loop in one call.

`attach(env)` looks whether the environment is one that the library of `crates/control` knows: fixed Pandas, one or
more, with their own grippers or Wipe's pad, under the BASIC composite controller and OSC_POSE, as robosuite 1.5.2 ships
them. If so,
`CompiledControl.step` takes the place of `env.step`: the 25 passes of {mj_step1, torques, mj_step2} run in the library,
on the simulator's own model and data; counters, observables, reward and success stay robosuite's. If not, it says why.

The controllers' Python attributes (`ref_pos`, `goal_pos`, `torques`, ...) become views of the memory that the library
works in, so both sides see one state, and `env.step` may be called at any time in between.
"""

import importlib
import os
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np

from actrm_harness.simulators.robosuite.control_abi import (
    STATE,
    Binding,
    ControlError,
    Library,
    check,
    mujoco_functions,
)
from actrm_harness.simulators.robosuite.control_known import robosuite_class, unknown
from actrm_harness.simulators.robosuite.control_robot import SharedRobot, arm_binding
from actrm_harness.simulators.robosuite.control_sensors import ContactTest, Sensor, WatchedCache, cheaper
from actrm_harness.wire import Array

LIBRARY = "ACTRM_CONTROL_LIB"
"""The environment variable with the library's path; our programs set it for their workers."""

Observations = dict[str, Array]


def attach(env: Any) -> "CompiledControl | None":
    """The compiled loop for `env`; None, and one line on standard error that says why, if it cannot be had."""
    path = os.environ.get(LIBRARY)
    try:
        if not path:
            raise ControlError(f"{LIBRARY} is not set")  # noqa: TRY301
        return CompiledControl(env, Library(Path(path)))
    except ControlError as error:
        print(f"compiled control is off, robosuite's own loop runs: {error}", file=sys.stderr)
        return None


def binding(env: Any, functions: dict[str, int]) -> Binding:
    """Where everything of this environment is."""
    model, data = env.sim.model._model, env.sim.data._data
    arrays = {
        "ctrl": data.ctrl,
        "qpos": data.qpos,
        "qvel": data.qvel,
        "qm": data.qM,
        "qfrc_bias": data.qfrc_bias,
        "site_xpos": data.site_xpos,
        "site_xmat": data.site_xmat,
        "ctrlrange": model.actuator_ctrlrange,
        "dof_madr": model.dof_Madr,
        "dof_parent": model.dof_parentid,
    }
    return Binding(
        **functions,
        model=model._address,
        data=data._address,
        **{name: array.ctypes.data for name, array in arrays.items()},
        nq=model.nq,
        nv=model.nv,
        nu=model.nu,
        nm=model.nM,
        nsite=model.nsite,
    )


class CompiledControl:
    """Steps one environment through the library. Make it with `attach`."""

    def __init__(self, env: Any, library: Library) -> None:
        self.env = env
        self._library = library
        self._functions = mujoco_functions()
        self._handle: int | None = None
        self._states: Any = np.zeros(len(env.robots), dtype=STATE)
        self._action = np.zeros(env.action_dim)
        self._addresses = (self._states.ctypes.data, self._action.ctypes.data)
        observables = importlib.import_module("robosuite.utils.observables")
        self._no_delay = observables.NO_DELAY
        self._untouched = (observables.NO_CORRUPTION, observables.NO_FILTER)
        self._macros = importlib.import_module("robosuite.macros")
        self._clocks: dict[tuple[float, bool, float, float], tuple[float, bool] | None] = {}
        self._sensors: dict[str, tuple[Any, Sensor | None]] = {}
        self._sim: Any = None
        self._robots: list[SharedRobot] = []
        self._unseen: tuple[float, bool] | None = None
        self._late_reads: bool | None = None
        self._bind()

    def release(self) -> None:
        """Let go of the simulation, before a reset makes another; the next step takes that one up."""
        if self._handle is not None:
            self._library.close(self._handle)
            self._handle = None
        self._sensors.clear()
        self._sim = None
        self._robots = []
        self._unseen = self._late_reads = None
        self.env.__dict__.pop("check_contact", None)

    def __del__(self) -> None:
        if getattr(self, "_handle", None) is not None:
            self._library.close(self._handle)

    # ---- binding ---------------------------------------------------------------------------------------------------

    def _bound(self) -> bool:
        """Whether the library still holds the state of the controllers that the environment has.

        A reset makes new controllers, and a plain `env.step` or `reset_goal` replaces some of their arrays: then their
        state has to be taken over anew.
        """
        return self._sim is not None and self.env.sim is self._sim and all(robot.bound() for robot in self._robots)

    def _bind(self) -> None:
        env = self.env
        reason = unknown(env)
        if reason is not None:
            raise ControlError(reason)
        self.release()
        arms = [arm_binding(env, robot) for robot in env.robots]
        self._handle = self._library.open(binding(env, self._functions), arms)
        self._robots = [SharedRobot(env, robot, state) for robot, state in zip(env.robots, self._states, strict=True)]
        self._substeps = int(env.control_timestep / env.model_timestep)
        self._clocks.clear()
        kind = cast(Any, type(env))
        if kind.check_contact is robosuite_class("environments.base", "MujocoEnv").check_contact:
            env.check_contact = ContactTest(env.sim)
        self._sim = env.sim

    # ---- stepping --------------------------------------------------------------------------------------------------

    def step(self, action: Any, look: bool = True) -> tuple[Observations, float, bool, dict[str, Any]]:
        """What `env.step(action)` does and returns; without `look`, no observations (`look` gives them later)."""
        env = self.env
        if env.done:
            raise ValueError("executing action in terminated episode")
        if len(action) != len(self._action):
            raise ControlError(f"an action has {len(self._action)} numbers, got {len(action)}")
        if not self._bound():
            self._bind()
        self._unseen = None
        before = [robot.before() for robot in self._robots]
        self._action[:] = action
        env.timestep += 1
        clock = self._clock()
        if clock is None:
            for substep in range(self._substeps):
                self._run(1, substep == 0)
                env._update_observables()
        else:
            self._run(self._substeps, True)
            if look or self._has_past():
                self._observe(*clock)
            else:
                self._tick(*clock)
        first = 0
        for robot, its in zip(self._robots, before, strict=True):
            robot.note(its, self._action[first : first + robot.action])
            first += robot.action
        env.cur_time += env.control_timestep
        reward, done, info = env._post_action(action)
        return self._observations() if look else {}, reward, done, info

    def look(self) -> Observations:
        """What a step without `look` led to, had it looked; nothing may have moved since."""
        clock, self._unseen = self._unseen, None
        if clock is not None:
            self._observe(*clock)
        return self._observations()

    def _run(self, substeps: int, policy_step: bool) -> None:
        check(self._library.run(self._handle, *self._addresses, substeps, policy_step))
        for robot in self._robots:
            robot.stepped()

    def _clock(self) -> tuple[float, bool] | None:
        """The observables' clock after this step, if all of them sample in its last substep and in no other.

        None where one is due earlier, or delayed: then they are updated after each substep.
        """
        start: tuple[float, bool, float, float] | None = None
        for observable in self.env._observables.values():
            if not observable._enabled:
                continue
            mine = (
                observable._time_since_last_sample,
                observable._sampled,
                observable._sampling_timestep,
                observable._current_delay,
            )
            if start is None:
                start = mine
            if mine != start or observable._delayer is not self._no_delay:
                return None
        if start is None:
            return None
        if start not in self._clocks:
            self._clocks[start] = _advance(start, self.env.model_timestep, self._substeps)
        return self._clocks[start]

    def _tick(self, time: float, sampled: bool) -> None:
        """`_observe` for nobody: the observables' clocks alone."""
        for observable in self.env._observables.values():
            if observable._enabled:
                observable._time_since_last_sample = time
                observable._sampled = sampled
        self._unseen = (time, sampled)

    def _has_past(self) -> bool:
        """Whether what is observed depends on what was observed at the step before, so that none may be left out.

        Noise and filters may; and PickPlace's and NutAssembly's sensors of where a thing is from the hand run before
        those of where it is, and take that from the step before.
        """
        enabled = {name: each for name, each in self.env._observables.items() if each._enabled}
        if any((each._corrupter, each._filter) != self._untouched for each in enabled.values()):
            return True
        if self._late_reads is None:
            cache = WatchedCache(self.env._obs_cache, set(enabled))
            for name, observable in enabled.items():
                cache[name] = observable._sensor(cache)
            self._late_reads = cache.late_reads
        return self._late_reads

    def _observe(self, time: float, sampled: bool) -> None:
        """`env._update_observables` in the substep in which all sample."""
        cache = self.env._obs_cache
        for name, observable in self.env._observables.items():
            if not observable._enabled:
                continue
            sensor = observable._sensor
            known = self._sensors.get(name)
            if known is None or known[0] is not sensor:
                known = self._sensors[name] = (sensor, cheaper(sensor, self.env))
            quick = known[1]
            if quick is not None and (observable._corrupter, observable._filter) == self._untouched:
                value = quick(cache)
            else:
                value = np.array(observable._filter(observable._corrupter(sensor(cache))))
            if value.shape == (1,):
                value = value[0]
            observable._current_observed_value = value
            cache[name] = np.array(value)
            observable._time_since_last_sample = time
            observable._sampled = sampled

    def _observations(self) -> Observations:
        """`env._get_observations()`."""
        observations: Observations = {}
        modalities: dict[str, list[Any]] = {}
        for name, observable in self.env._observables.items():
            if not (observable._enabled and observable._active):
                continue
            value = observable._current_observed_value
            observations[name] = value
            scalar = isinstance(value, int | float) or not value.shape
            modalities.setdefault(observable._sensor.__modality__, []).append([value] if scalar else value)
        for modality, values in modalities.items():
            if modality != "image" or self._macros.CONCATENATE_IMAGES:
                observations[f"{modality}-state"] = np.concatenate(values, axis=-1)
        return observations


def _advance(start: tuple[float, bool, float, float], timestep: float, substeps: int) -> tuple[float, bool] | None:
    """`Observable.update`'s clock over a control step; None if it samples in any substep but the last.

    The sums are robosuite's, rounding included: after a reset the clock is one timestep ahead, and that is what moves
    sampling to the end of a step.
    """
    time, sampled, period, delay = start
    due: list[int] = []
    for substep in range(substeps):
        time += timestep
        if not sampled and period - delay >= time:
            due.append(substep)
            sampled = True
        if time >= period:
            if not sampled:
                return None
            time %= period
            sampled = False
    return (time, sampled) if due == [substeps - 1] else None
