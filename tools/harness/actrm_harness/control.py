"""The compiled control loop: robosuite's `env.step` with its inner loop in one call.

`attach(env)` looks whether the environment is one that the library in `crates/control` knows: one
fixed Panda with its own gripper under the BASIC composite controller and OSC_POSE as robosuite
1.5.2 ships it. If so, `CompiledControl.step` takes the place of `env.step`: the 25 passes of
{mj_step1, torques, mj_step2} run in the library, on the simulator's own model and data; counters,
observables, reward and success stay robosuite's. If not, `attach` says why, once, and the caller
keeps `env.step`.

The controllers' Python attributes (`ref_pos`, `goal_pos`, `torques`, ...) become views of the
memory that the library works in, so both sides see one state, and `env.step` may be called at any
time in between.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections import OrderedDict
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import robosuite
import robosuite.macros as macros
from robosuite.controllers.composite.composite_controller import CompositeController
from robosuite.controllers.parts.arm.osc import OperationalSpaceController
from robosuite.controllers.parts.gripper.simple_grip import SimpleGripController
from robosuite.environments.base import MujocoEnv
from robosuite.environments.robot_env import RobotEnv
from robosuite.models.grippers.panda_gripper import PandaGripper
from robosuite.robots.fixed_base_robot import FixedBaseRobot
from robosuite.utils.binding_utils import MjSim
from robosuite.utils.observables import NO_CORRUPTION, NO_DELAY, NO_FILTER

from actrm_harness.control_sensors import ContactTest, Sensor, cheaper

LIBRARY_VARIABLE = "ACTRM_CONTROL_LIB"
"""The environment variable that names the library; the binaries set it for their workers."""

MUJOCO = "3.3.7"
ROBOSUITE = "1.5.2"

_DOF = 7
_ABI = 1

_ARM = [
    ("ref_pos", "f8", 3),
    ("ref_ori", "f8", (3, 3)),
    ("ref_pos_vel", "f8", 3),
    ("ref_ori_vel", "f8", 3),
]

_STATE = np.dtype(
    [
        *_ARM,
        ("joint_pos", "f8", _DOF),
        ("joint_vel", "f8", _DOF),
        ("mass", "f8", (_DOF, _DOF)),
        ("jacobian", "f8", (6, _DOF)),
        ("origin_pos", "f8", 3),
        ("origin_ori", "f8", (3, 3)),
        ("goal_pos", "f8", 3),
        ("goal_ori", "f8", (3, 3)),
        ("torques", "f8", _DOF),
        ("gripper_action", "f8", 2),
        ("gripper_goal", "f8", 2),
        *((f"policy_{name}", kind, shape) for name, kind, shape in _ARM),
        ("new_update", "u8"),
    ]
)
"""`State` of crates/control/src/abi.rs."""


class _Binding(ctypes.Structure):
    """`Binding` of crates/control/src/abi.rs."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("step1", "step2", "jac_site", "model", "data")),
        *(
            (name, ctypes.c_void_p)
            for name in (
                "ctrl",
                "qpos",
                "qvel",
                "qm",
                "qfrc_bias",
                "site_xpos",
                "site_xmat",
                "ctrlrange",
                "dof_madr",
                "dof_parent",
            )
        ),
        *((name, ctypes.c_int32) for name in ("nq", "nv", "nu", "nm", "nsite")),
        ("grip_site", ctypes.c_int32),
        ("origin_site", ctypes.c_int32),
        ("arm_qpos", ctypes.c_int32 * _DOF),
        ("arm_dof", ctypes.c_int32 * _DOF),
        ("arm_actuator", ctypes.c_int32 * _DOF),
        ("gripper_actuator", ctypes.c_int32 * 2),
        *(
            (name, ctypes.c_double * 6)
            for name in (
                "kp",
                "kd",
                "input_min",
                "input_max",
                "input_offset",
                "scale",
                "output_offset",
            )
        ),
        ("initial_joint", ctypes.c_double * _DOF),
        ("gripper_speed", ctypes.c_double),
        *(
            (f"gripper_{name}", ctypes.c_double * 2)
            for name in (
                "direction",
                "input_min",
                "input_max",
                "input_offset",
                "scale",
                "output_offset",
                "bias",
                "weight",
            )
        ),
    ]


class ControlError(Exception):
    """The compiled loop cannot go on, or was never able to start."""


class Library:
    """The loaded shared object, its interface checked."""

    def __init__(self, path: Path) -> None:
        try:
            lib = ctypes.CDLL(str(path))
        except OSError as error:
            raise ControlError(f"{path} cannot be loaded: {error}") from error
        try:
            lib.control_abi.restype = ctypes.c_uint64
            lib.control_open.restype = ctypes.c_void_p
            lib.control_open.argtypes = [ctypes.c_void_p]
            lib.control_run.restype = ctypes.c_int32
            lib.control_run.argtypes = [
                ctypes.c_void_p,
                ctypes.c_void_p,
                ctypes.c_void_p,
                ctypes.c_uint32,
                ctypes.c_uint32,
            ]
            lib.control_close.argtypes = [ctypes.c_void_p]
            lib.control_close.restype = None
            lib.control_delta_rotation.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
            lib.control_delta_rotation.restype = None
        except AttributeError as error:
            raise ControlError(f"{path} is no control library: {error}") from error
        expected = (_ABI << 32) | (ctypes.sizeof(_Binding) << 16) | _STATE.itemsize
        if lib.control_abi() != expected:
            raise ControlError(
                f"{path} has interface {lib.control_abi():#x}, this package {expected:#x}: "
                "build both from the same sources"
            )
        self.abi = lib.control_abi
        self.open = lib.control_open
        self.run = lib.control_run
        self.close = lib.control_close
        self._delta_rotation = lib.control_delta_rotation

    def delta_rotation(self, axis: np.ndarray) -> np.ndarray:
        """The matrix of a scaled axis, rounded as robosuite's `quat2mat` rounds it."""
        axis = np.array(axis, dtype=np.float64)
        out = np.empty((3, 3))
        self._delta_rotation(axis.ctypes.data, out.ctypes.data)
        return out


def _mujoco_functions() -> dict[str, int]:
    """Addresses of the MuJoCo functions that the loop calls, in the library Python already uses."""
    directory = Path(mujoco.__file__).parent
    names = [f"libmujoco.so.{MUJOCO}", f"libmujoco.{MUJOCO}.dylib"]
    found = [directory / name for name in names if (directory / name).is_file()]
    if not found:
        raise ControlError(f"{directory} has no {names[0]}")
    lib = ctypes.CDLL(str(found[0]))
    return {
        ours: ctypes.cast(getattr(lib, theirs), ctypes.c_void_p).value or 0
        for ours, theirs in {
            "step1": "mj_step1",
            "step2": "mj_step2",
            "jac_site": "mj_jacSite",
        }.items()
    }


def unknown(env: Any) -> str | None:
    """Why the compiled loop cannot drive `env`; None if it can."""
    for what, found, known in (
        ("mujoco", mujoco.__version__, MUJOCO),
        ("robosuite", robosuite.__version__, ROBOSUITE),
    ):
        if found != known:
            return f"it knows {what} {known}, this is {found}"
    kind = type(env)
    if not isinstance(env, RobotEnv):
        return f"{kind.__name__} is no robot environment"
    for name, base in (
        ("step", MujocoEnv),
        ("_pre_action", RobotEnv),
        ("_update_observables", MujocoEnv),
        ("_get_observations", MujocoEnv),
    ):
        if getattr(kind, name) is not getattr(base, name) or name in vars(env):
            return f"{kind.__name__} has its own {name}"
    if type(env.sim) is not MjSim:
        return f"the simulation is a {type(env.sim).__name__}"
    if not env.lite_physics:
        return "lite_physics is off"
    if env.has_renderer or env.viewer_get_obs:
        return "the environment has a viewer"
    if len(env.robots) != 1:
        return f"there are {len(env.robots)} robots"
    robot = env.robots[0]
    if type(robot) is not FixedBaseRobot or list(robot.arms) != ["right"]:
        return f"the robot is {robot.name}, not one arm on a fixed base"
    composite = robot.composite_controller
    if type(composite) is not CompositeController:
        return f"the composite controller is {type(composite).__name__}"
    if list(composite.part_controllers) != ["right", "right_gripper"]:
        return f"the controlled parts are {list(composite.part_controllers)}"
    if dict(composite._action_split_indexes) != {"right": (0, 6), "right_gripper": (6, 7)}:
        return "the action is not six numbers for the arm and one for the gripper"
    if not (robot.enabled("right") and robot.enabled("right_gripper")):
        return "a part of the robot is disabled"
    return _unknown_arm(env, composite.part_controllers["right"]) or _unknown_gripper(
        robot.gripper["right"], composite.part_controllers["right_gripper"]
    )


def _unknown_arm(env: Any, arm: Any) -> str | None:
    if type(arm) is not OperationalSpaceController or arm.name != "OSC_POSE":
        return f"the arm's controller is {arm.name}"
    if arm.joint_dim != _DOF or arm.num_ref_sites != 1:
        return f"the arm has {arm.joint_dim} joints and {arm.num_ref_sites} reference sites"
    for name, known in (
        ("impedance_mode", "fixed"),
        ("input_type", "delta"),
        ("input_ref_frame", "base"),
        ("_goal_update_mode", "achieved"),
        ("use_ori", True),
        ("uncoupling", True),
        ("lite_physics", True),
        ("interpolator_pos", None),
        ("interpolator_ori", None),
        ("position_limits", None),
        ("orientation_limits", None),
    ):
        found = getattr(arm, name)
        if found is not known and found != known:
            return f"the arm controller's {name} is {found!r}, not {known!r}"
    model = env.sim.model._model
    body = model.site_bodyid[_origin_site(env, arm)]
    if model.body_weldid[body] != 0:
        return "the robot's base can move"
    return None


def _unknown_gripper(gripper: Any, controller: Any) -> str | None:
    if type(gripper) is not PandaGripper:
        return f"the gripper is a {type(gripper).__name__}"
    if type(controller) is not SimpleGripController:
        return f"the gripper's controller is {type(controller).__name__}"
    if controller.control_dim != 2:
        return f"the gripper has {controller.control_dim} actuators"
    if controller.interpolator is not None or not controller.use_action_scaling:
        return "the gripper's controller interpolates or does not scale"
    return None


def _origin_site(env: Any, arm: Any) -> int:
    return env.sim.model.site_name2id(f"{arm.naming_prefix}{arm.part_name}_center")


def _scaling(part: Any) -> dict[str, np.ndarray]:
    """The constants of a part's `scale_action`, by the same expressions."""
    return {
        "input_min": part.input_min,
        "input_max": part.input_max,
        "input_offset": (part.input_max + part.input_min) / 2.0,
        "scale": abs(part.output_max - part.output_min) / abs(part.input_max - part.input_min),
        "output_offset": (part.output_max + part.output_min) / 2.0,
    }


class CompiledControl:
    """Steps one environment through the library. Make it with `attach`."""

    def __init__(self, env: Any, library: Library) -> None:
        self.env = env
        self._library = library
        self._functions = _mujoco_functions()
        self._state = np.zeros((), dtype=_STATE)
        self._state_address = self._state.ctypes.data
        self._action = np.zeros(_DOF)
        self._action_address = self._action.ctypes.data
        self._handle: int | None = None
        self._clocks: dict[tuple[float, bool, float, float], tuple[float, bool] | None] = {}
        self._sensors: dict[str, tuple[Any, Sensor | None]] = {}
        self._views = {name: self._state[name] for name in _STATE.names or ()}
        self._bind()

    def close(self) -> None:
        """Gives the library's memory back; the environment stays usable."""
        if self._handle is not None:
            self._library.close(self._handle)
            self._handle = None

    def __del__(self) -> None:
        self.close()

    # ---- binding -------------------------------------------------------------------------------

    def _bound(self) -> bool:
        """Whether the controllers are still those whose state the library holds.

        A reset makes new controllers, and a plain `env.step` or `reset_goal` replaces some of
        their arrays: then their state has to be taken over anew.
        """
        composite = self.env.robots[0].composite_controller
        views = self._views
        arm = self._arm
        return (
            composite is self._composite
            and self.env.sim is self._sim
            and arm.joint_pos is views["joint_pos"]
            and arm.goal_pos is views["goal_pos"]
            and self._gripper.current_action is views["gripper_action"]
        )

    def _bind(self) -> None:
        env = self.env
        reason = unknown(env)
        if reason is not None:
            raise ControlError(reason)
        robot = env.robots[0]
        self._sim = env.sim
        self._composite = robot.composite_controller
        self._arm = self._composite.part_controllers["right"]
        self._fingers = self._composite.part_controllers["right_gripper"]
        self._gripper = robot.gripper["right"]
        self._substeps = int(env.control_timestep / env.model_timestep)
        self._clocks.clear()
        self._sensors.clear()
        self._open()
        self._share()
        if type(env).check_contact is MujocoEnv.check_contact:
            env.check_contact = ContactTest(env.sim)

    def _open(self) -> None:
        model, data = self._sim.model._model, self._sim.data._data
        arm, fingers, robot = self._arm, self._fingers, self.env.robots[0]
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
        actuators = robot._ref_actuators_indexes_dict
        low, high = fingers.actuator_min, fingers.actuator_max
        numbers = {
            "arm_qpos": arm.qpos_index,
            "arm_dof": arm.qvel_index,
            "arm_actuator": actuators["right"],
            "gripper_actuator": actuators["right_gripper"],
            "kp": arm.kp,
            "kd": arm.kd,
            **_scaling(arm),
            "initial_joint": arm.initial_joint,
            # PandaGripper.format_action
            "gripper_direction": [-1.0, 1.0],
            **{f"gripper_{name}": value for name, value in _scaling(fingers).items()},
            "gripper_bias": 0.5 * (high + low),
            "gripper_weight": 0.5 * (high - low),
        }
        binding = _Binding(
            **self._functions,
            model=model._address,
            data=data._address,
            **{name: array.ctypes.data for name, array in arrays.items()},
            nq=model.nq,
            nv=model.nv,
            nu=model.nu,
            nm=model.nM,
            nsite=model.nsite,
            grip_site=self._sim.model.site_name2id(arm.ref_name),
            origin_site=_origin_site(self.env, arm),
            gripper_speed=self._gripper.speed,
        )
        for name, values in numbers.items():
            field = getattr(binding, name)
            if len(values) != len(field):
                raise ControlError(f"{name} has {len(values)} numbers, expected {len(field)}")
            field[:] = [x.item() if isinstance(x, np.generic) else x for x in values]
        self.close()
        self._handle = self._library.open(ctypes.addressof(binding))
        if self._handle is None:
            raise ControlError("the library refuses the robot's indices")

    def _share(self) -> None:
        """Copies the controllers' state and puts views of the copy in its place."""
        arm, fingers, gripper = self._arm, self._fingers, self._gripper
        views, state = self._views, self._state

        def share(owner: Any, attribute: str, view: np.ndarray) -> None:
            held = getattr(owner, attribute)
            if held is not None and held is not view:
                view[...] = held
            setattr(owner, attribute, view)

        jacobian = views["jacobian"]
        share(arm, "J_full", jacobian)
        arm.J_pos, arm.J_ori = jacobian[:3], jacobian[3:]
        for attribute, name in (
            ("ref_pos", "ref_pos"),
            ("ref_ori_mat", "ref_ori"),
            ("ref_pos_vel", "ref_pos_vel"),
            ("ref_ori_vel", "ref_ori_vel"),
            ("joint_pos", "joint_pos"),
            ("joint_vel", "joint_vel"),
            ("mass_matrix", "mass"),
            ("origin_pos", "origin_pos"),
            ("origin_ori", "origin_ori"),
            ("goal_pos", "goal_pos"),
            ("goal_ori", "goal_ori"),
            ("torques", "torques"),
        ):
            share(arm, attribute, views[name])
        # one number after a reset, one for each finger later
        share(gripper, "current_action", views["gripper_action"])
        share(fingers, "goal_qvel", views["gripper_goal"])
        state["new_update"] = 1 if arm.new_update else 0

    # ---- stepping ------------------------------------------------------------------------------

    def step(self, action: Any) -> tuple[OrderedDict[str, Any], float, bool, dict[str, Any]]:
        """What `env.step(action)` does and returns."""
        env = self.env
        if env.done:
            raise ValueError("executing action in terminated episode")
        if not self._bound():
            self._bind()
        if len(action) != _DOF:
            raise AssertionError(
                f"environment got invalid action dimension -- expected {_DOF}, got {len(action)}"
            )
        self._action[:] = action
        env.timestep += 1
        clock = self._clock()
        if clock is None:
            for substep in range(self._substeps):
                self._run(1, substep == 0)
                env._update_observables()
        else:
            self._run(self._substeps, True)
            self._observe(*clock)
        env.cur_time += env.control_timestep
        reward, done, info = env._post_action(action)
        return self._observations(), reward, done, info

    def _run(self, substeps: int, policy_step: bool) -> None:
        status = self._library.run(
            self._handle, self._state_address, self._action_address, substeps, policy_step
        )
        if status != 0:
            raise ControlError("the simulation has diverged: the arm's inertia is not positive")
        self._arm.new_update = True
        self._fingers.new_update = True

    def _clock(self) -> tuple[float, bool] | None:
        """The observables' clock after this step, if all of them sample in its last substep only.

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
            if mine != start or observable._delayer is not NO_DELAY:
                return None
        if start is None:
            return None
        if start not in self._clocks:
            self._clocks[start] = _advance(*start, self.env.model_timestep, self._substeps)
        return self._clocks[start]

    def _observe(self, time: float, sampled: bool) -> None:
        """`env._update_observables` in the substep in which all sample."""
        cache = self.env._obs_cache
        sensors = self._sensors
        for name, observable in self.env._observables.items():
            if not observable._enabled:
                continue
            sensor = observable._sensor
            known = sensors.get(name)
            if known is None or known[0] is not sensor:
                known = (sensor, cheaper(sensor, self.env))
                sensors[name] = known
            quick = known[1]
            if (
                quick is not None
                and observable._corrupter is NO_CORRUPTION
                and observable._filter is NO_FILTER
            ):
                value = quick(cache)
            else:
                value = np.array(observable._filter(observable._corrupter(sensor(cache))))
            if value.shape == (1,):
                value = value[0]
            observable._current_observed_value = value
            cache[name] = np.array(value)
            observable._time_since_last_sample = time
            observable._sampled = sampled

    def _observations(self) -> OrderedDict[str, Any]:
        """`env._get_observations()`."""
        observations: OrderedDict[str, Any] = OrderedDict()
        modalities: dict[str, list[Any]] = {}
        for name, observable in self.env._observables.items():
            if not (observable._enabled and observable._active):
                continue
            value = observable._current_observed_value
            observations[name] = value
            modality = observable._sensor.__modality__
            values = modalities.get(modality)
            if values is None:
                values = modalities[modality] = []
            single = type(value) in (int, float) or not value.shape
            values.append(np.array([value]) if single else value)
        for modality, values in modalities.items():
            if modality == "image" and not macros.CONCATENATE_IMAGES:
                continue
            observations[modality + "-state"] = np.concatenate(values, axis=-1)
        return observations


def _advance(
    time: float, sampled: bool, period: float, delay: float, timestep: float, substeps: int
) -> tuple[float, bool] | None:
    """`Observable.update`'s clock over a control step; None if it samples before the last substep.

    The sums are robosuite's, rounding included: after a reset the clock is one timestep ahead, and
    that is what moves sampling to the end of a step.
    """
    due = []
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


def attach(env: Any) -> CompiledControl | None:
    """Prepares the compiled loop for `env`; None, and a line on stderr, if that cannot be."""
    path = os.environ.get(LIBRARY_VARIABLE)
    try:
        if not path:
            raise ControlError(f"{LIBRARY_VARIABLE} is not set")
        return CompiledControl(env, Library(Path(path)))
    except ControlError as error:
        print(f"compiled control is off, robosuite's own loop runs: {error}", file=sys.stderr)
        return None
