"""The compiled control loop: robosuite's `env.step` with its inner loop in one call.

`attach(env)` looks whether the environment is one that the library of `crates/control` knows: one fixed Panda with its
own gripper under the BASIC composite controller and OSC_POSE, as robosuite 1.5.2 ships them. If so,
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
    ACTION,
    DOF,
    MUJOCO,
    STATE,
    Binding,
    ControlError,
    Library,
    mujoco_functions,
)
from actrm_harness.simulators.robosuite.control_recent import Recent
from actrm_harness.simulators.robosuite.control_sensors import ContactTest, Sensor, WatchedCache, cheaper
from actrm_harness.wire import Array

LIBRARY = "ACTRM_CONTROL_LIB"
"""The environment variable with the library's path; our programs set it for their workers."""

ROBOSUITE = "1.5.2"

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


def unknown(env: Any) -> str | None:
    """Why the compiled loop cannot drive `env`; None if it can."""
    for name, known in (("mujoco", MUJOCO), ("robosuite", ROBOSUITE)):
        found = importlib.import_module(name).__version__
        if found != known:
            return f"it knows {name} {known}, this is {found}"
    return _unknown_env(env) or _unknown_robot(env.robots) or _unknown_arm(env) or _unknown_gripper(env.robots[0])


def _unknown_env(env: Any) -> str | None:
    kind = cast(Any, type(env))
    base = _class("environments.base", "MujocoEnv")
    robot_env = _class("environments.robot_env", "RobotEnv")
    if not isinstance(env, robot_env):
        return f"{kind.__name__} is no robot environment"
    replaced = {"step": base, "_update_observables": base, "_get_observations": base, "_pre_action": robot_env}
    for name, owner in replaced.items():
        if getattr(kind, name) is not getattr(owner, name) or name in env.__dict__:
            return f"{kind.__name__} has its own {name}"
    return _first(
        (
            type(env.sim) is _class("utils.binding_utils", "MjSim"),
            lambda: f"the simulation is a {type(env.sim).__name__}",
        ),
        (env.lite_physics, lambda: "lite_physics is off"),
        (not env.has_renderer and not env.viewer_get_obs, lambda: "the environment has a viewer"),
    )


def _unknown_robot(robots: list[Any]) -> str | None:
    if len(robots) != 1 or type(robots[0]) is not _class("robots.fixed_base_robot", "FixedBaseRobot"):
        return f"the robots are {[robot.name for robot in robots]}, not one on a fixed base"
    robot = robots[0]
    composite = robot.composite_controller
    basic = _class("controllers.composite.composite_controller", "CompositeController")
    if type(composite) is not basic:
        return f"the composite controller is {type(composite).__name__}"
    parts = dict(composite._action_split_indexes)
    return _first(
        (parts == {"right": (0, 6), "right_gripper": (6, 7)}, lambda: f"the parts of an action are {parts}"),
        (all(robot.enabled(part) for part in parts), lambda: "a part of the robot is disabled"),
    )


def _unknown_arm(env: Any) -> str | None:
    arm = env.robots[0].composite_controller.part_controllers["right"]
    if type(arm) is not _class("controllers.parts.arm.osc", "OperationalSpaceController"):
        return f"the arm's controller is {arm.name}"
    expected = {
        "name": "OSC_POSE",
        "joint_dim": DOF,
        "num_ref_sites": 1,
        "impedance_mode": "fixed",
        "input_type": "delta",
        "input_ref_frame": "base",
        "_goal_update_mode": "achieved",
        "uncoupling": True,
        "lite_physics": True,
        "interpolator_pos": None,
        "interpolator_ori": None,
        "position_limits": None,
        "orientation_limits": None,
    }
    for name, known in expected.items():
        found = getattr(arm, name)
        if type(found) is not type(known) or found != known:
            return f"the arm controller's {name} is {found!r}, not {known!r}"
    model = env.sim.model._model
    if model.body_weldid[model.site_bodyid[_origin_site(env, arm)]] != 0:
        return "the robot's base can move"
    return None


def _unknown_gripper(robot: Any) -> str | None:
    gripper = robot.gripper["right"]
    fingers = robot.composite_controller.part_controllers["right_gripper"]
    return _first(
        (
            type(gripper) is _class("models.grippers.panda_gripper", "PandaGripper"),
            lambda: f"the gripper is a {type(gripper).__name__}",
        ),
        (
            type(fingers) is _class("controllers.parts.gripper.simple_grip", "SimpleGripController"),
            lambda: f"the gripper's controller is {type(fingers).__name__}",
        ),
        (
            fingers.interpolator is None and fingers.use_action_scaling,
            lambda: "the gripper's controller interpolates or does not scale",
        ),
    )


def _first(*conditions: tuple[Any, Any]) -> str | None:
    return next((complaint() for holds, complaint in conditions if not holds), None)


def _class(module: str, name: str) -> Any:
    return getattr(importlib.import_module(f"robosuite.{module}"), name)


def _origin_site(env: Any, arm: Any) -> int:
    return env.sim.model.site_name2id(f"{arm.naming_prefix}{arm.part_name}_center")


def _scaling(part: Any) -> dict[str, Array]:
    """The constants of a part's `scale_action`, by the same expressions."""
    return {
        "input_min": part.input_min,
        "input_max": part.input_max,
        "input_offset": (part.input_max + part.input_min) / 2.0,
        "scale": abs(part.output_max - part.output_min) / abs(part.input_max - part.input_min),
        "output_offset": (part.output_max + part.output_min) / 2.0,
    }


def _binding(env: Any, functions: dict[str, int]) -> Binding:
    """Where everything of this environment is."""
    robot = env.robots[0]
    parts = robot.composite_controller.part_controllers
    arm, fingers = parts["right"], parts["right_gripper"]
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
    binding = Binding(
        **functions,
        model=model._address,
        data=data._address,
        **{name: array.ctypes.data for name, array in arrays.items()},
        nq=model.nq,
        nv=model.nv,
        nu=model.nu,
        nm=model.nM,
        nsite=model.nsite,
        grip_site=env.sim.model.site_name2id(arm.ref_name),
        origin_site=_origin_site(env, arm),
        gripper_speed=robot.gripper["right"].speed,
    )
    actuators = robot._ref_actuators_indexes_dict
    low, high = fingers.actuator_min, fingers.actuator_max
    numbers: dict[str, Any] = {
        "arm_qpos": arm.qpos_index,
        "arm_dof": arm.qvel_index,
        "arm_actuator": actuators["right"],
        "gripper_actuator": actuators["right_gripper"],
        "kp": arm.kp,
        "kd": arm.kd,
        **_scaling(arm),
        "initial_joint": arm.initial_joint,
        # as in PandaGripper.format_action
        "gripper_direction": [-1.0, 1.0],
        **{f"gripper_{name}": value for name, value in _scaling(fingers).items()},
        "gripper_bias": 0.5 * (high + low),
        "gripper_weight": 0.5 * (high - low),
    }
    for name, values in numbers.items():
        field = getattr(binding, name)
        if len(values) != len(field):
            raise ControlError(f"{name} has {len(values)} numbers, expected {len(field)}")
        field[:] = np.asarray(values).tolist()
    return binding


class CompiledControl:
    """Steps one environment through the library. Make it with `attach`."""

    def __init__(self, env: Any, library: Library) -> None:
        self.env = env
        self._library = library
        self._functions = mujoco_functions()
        self._handle: int | None = None
        self._state: Any = np.zeros((), dtype=STATE)
        self._views: dict[str, Array] = {name: self._state[name] for name in STATE.names or ()}
        first = STATE.fields["policy_ref_pos"][1] // 8 if STATE.fields else 0
        self._policy_site = np.frombuffer(self._state, dtype=np.float64)[first : first + 18]
        self._action = np.zeros(ACTION)
        self._addresses = (self._state.ctypes.data, self._action.ctypes.data)
        observables = importlib.import_module("robosuite.utils.observables")
        self._no_delay = observables.NO_DELAY
        self._untouched = (observables.NO_CORRUPTION, observables.NO_FILTER)
        self._macros = importlib.import_module("robosuite.macros")
        self._clocks: dict[tuple[float, bool, float, float], tuple[float, bool] | None] = {}
        self._sensors: dict[str, tuple[Any, Sensor | None]] = {}
        self._parts: tuple[Any, ...] = ()
        self._unseen: tuple[float, bool] | None = None
        self._late_reads: bool | None = None
        self._bind()

    def release(self) -> None:
        """Let go of the simulation, before a reset makes another; the next step takes that one up."""
        if self._handle is not None:
            self._library.close(self._handle)
            self._handle = None
        self._sensors.clear()
        self._parts = ()
        self._unseen = self._late_reads = None
        self._recent = None
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
        if not self._parts:
            return False
        sim, composite, arm, gripper = self._parts
        views = self._views
        return (
            self.env.sim is sim
            and self.env.robots[0].composite_controller is composite
            and arm.joint_pos is views["joint_pos"]
            and arm.goal_pos is views["goal_pos"]
            and gripper.current_action is views["gripper_action"]
        )

    def _bind(self) -> None:
        env = self.env
        reason = unknown(env)
        if reason is not None:
            raise ControlError(reason)
        self.release()
        robot = env.robots[0]
        composite = robot.composite_controller
        self._arm = composite.part_controllers["right"]
        self._fingers = composite.part_controllers["right_gripper"]
        self._handle = self._library.open(_binding(env, self._functions))
        self._share(robot.gripper["right"])
        self._substeps = int(env.control_timestep / env.model_timestep)
        self._clocks.clear()
        self._recent = Recent(robot, env.sim.data._data)
        kind = cast(Any, type(env))
        if kind.check_contact is _class("environments.base", "MujocoEnv").check_contact:
            env.check_contact = ContactTest(env.sim)
        self._parts = (env.sim, composite, self._arm, robot.gripper["right"])

    def _share(self, gripper: Any) -> None:
        """Copy the controllers' state and put views of the copy in its place."""
        arm, views = self._arm, self._views

        def share(owner: Any, attribute: str, view: Array) -> None:
            held = getattr(owner, attribute)
            if held is not None and held is not view:
                view[...] = held
            setattr(owner, attribute, view)

        jacobian = views["jacobian"]
        share(arm, "J_full", jacobian)
        arm.J_pos, arm.J_ori = jacobian[:3], jacobian[3:]
        share(arm, "ref_ori_mat", views["ref_ori"])
        share(arm, "mass_matrix", views["mass"])
        for name in ("ref_pos", "ref_pos_vel", "ref_ori_vel", "joint_pos", "joint_vel"):
            share(arm, name, views[name])
        for name in ("origin_pos", "origin_ori", "goal_pos", "goal_ori", "torques"):
            share(arm, name, views[name])
        # one number after a reset, one for each finger later
        share(gripper, "current_action", views["gripper_action"])
        share(self._fingers, "goal_qvel", views["gripper_goal"])
        self._state["new_update"] = 1 if arm.new_update else 0

    # ---- stepping --------------------------------------------------------------------------------------------------

    def step(self, action: Any, look: bool = True) -> tuple[Observations, float, bool, dict[str, Any]]:
        """What `env.step(action)` does and returns; without `look`, no observations (`look` gives them later)."""
        env = self.env
        if env.done:
            raise ValueError("executing action in terminated episode")
        if len(action) != ACTION:
            raise ControlError(f"an action has {ACTION} numbers, got {len(action)}")
        if not self._bound():
            self._bind()
        self._unseen = None
        recent = self._recent
        assert recent is not None
        before = recent.before()
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
        recent.note(before, self._action, self._policy_site)
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
        status = self._library.run(self._handle, *self._addresses, substeps, policy_step)
        if status != 0:
            raise ControlError("the simulation has diverged: the arm's inertia matrix is not positive definite")
        self._arm.new_update = True
        self._fingers.new_update = True

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
