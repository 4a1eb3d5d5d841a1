"""The compiled control loop for LIBERO's robot: robosuite 1.4's `env.step` with its inner loop in the library.

robosuite 1.4 computes positions and forces three times a substep: before the controller, in it, and in `mj_step`. The
library of `crates/control` does so once, so that a step takes a third of the time and its result differs by rounding.
The goal of an action is robosuite's own. The gripper, which robosuite 1.4 moves in every substep, is moved here.
"""

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from actrm_harness.simulators.robosuite.control import LIBRARY, binding
from actrm_harness.simulators.robosuite.control_abi import (
    STATE,
    ArmBinding,
    ControlError,
    Library,
    check,
    mujoco_functions,
)
from actrm_harness.wire import Array

_SNAPSHOT = {
    "ref_pos": "ee_pos",
    "ref_ori": "ee_ori_mat",
    "ref_pos_vel": "ee_pos_vel",
    "ref_ori_vel": "ee_ori_vel",
    "joint_pos": "joint_pos",
    "joint_vel": "joint_vel",
    "mass": "mass_matrix",
    "jacobian": "J_full",
}
"""What a controller knows of its arm: our names and robosuite's."""


def attach(env: Any) -> "Loop | None":
    """The compiled loop for `env`; None, and one line on standard error that says why, if it cannot be had."""
    path = os.environ.get(LIBRARY)
    try:
        if not path:
            raise ControlError(f"{LIBRARY} is not set")  # noqa: TRY301
        return Loop(env, Library(Path(path)))
    except ControlError as error:
        print(f"compiled control is off, robosuite's own loop runs: {error}", file=sys.stderr)
        return None


class Loop:
    """Steps one environment through the library, as often as it is reset with the same model."""

    def __init__(self, env: Any, library: Library) -> None:
        self._env = env
        self._library = library
        self._state: Any = np.zeros(1, dtype=STATE)
        self._action = np.zeros(6)
        self._places = (self._state.ctypes.data, self._action.ctypes.data)
        self._substeps = int(env.control_timestep / env.model_timestep)
        self._sim = env.sim
        self._handle: int | None = library.open(binding(env, mujoco_functions()), [self._arm()])

    def __del__(self) -> None:
        if (handle := getattr(self, "_handle", None)) is not None:
            self._library.close(handle)

    def _arm(self) -> ArmBinding:
        env = self._env
        if len(env.robots) != 1:
            raise ControlError(f"the environment has {len(env.robots)} robots")
        robot = env.robots[0]
        arm, model = robot.controller, env.sim.model._model
        expected = {
            "name": "OSC_POSE",
            "impedance_mode": "fixed",
            "use_delta": True,
            "use_ori": True,
            "uncoupling": True,
            "interpolator_pos": None,
            "interpolator_ori": None,
            "position_limits": None,
            "orientation_limits": None,
        }
        for name, known in expected.items():
            if getattr(arm, name) != known:
                raise ControlError(f"the arm controller's {name} is {getattr(arm, name)!r}, not {known!r}")
        # the library takes goals in the frame of a site; any that cannot move will do
        still = np.flatnonzero(model.body_weldid[model.site_bodyid] == 0)
        if not len(still):
            raise ControlError("every site of the model can move")
        found = ArmBinding(grip_site=env.sim.model.site_name2id(arm.eef_name), origin_site=int(still[0]))
        numbers: dict[str, Any] = {
            "arm_qpos": arm.qpos_index,
            "arm_dof": arm.qvel_index,
            "arm_actuator": robot._ref_joint_actuator_indexes,
            "kp": arm.kp,
            "kd": arm.kd,
            "initial_joint": arm.initial_joint,
        }
        for name, values in numbers.items():
            getattr(found, name)[:] = np.asarray(values).tolist()
        self._origin = int(still[0])
        self._fingers = [env.sim.model.actuator_name2id(name) for name in robot.gripper.actuators]
        ranges = model.actuator_ctrlrange[self._fingers]
        self._bias, self._weight = ranges.sum(axis=1) / 2, (ranges[:, 1] - ranges[:, 0]) / 2
        return found

    def step(self, action: Array) -> tuple[dict[str, Array], float, bool]:
        """What `step` of LIBERO's environment does: observations, reward, and whether the task is done."""
        env = self._env
        if env.sim is not self._sim:
            raise ControlError("the environment has another simulation than the loop")
        robot, data = env.robots[0], env.sim.data._data
        env.timestep += 1
        # as env.step does in its first substep
        env.sim.forward()
        state, arm = self._state[0], robot.controller
        state["new_update"] = 1 if arm.new_update else 0
        arm.set_goal(action[:6])
        if not state["new_update"]:
            # after a reset, the first substep is of what the controller knew before the state was set
            for name, held in _SNAPSHOT.items():
                state[name] = getattr(arm, held)
        origin = data.site_xmat[self._origin].reshape(3, 3)
        state["goal_pos"] = origin.T @ (arm.goal_pos - data.site_xpos[self._origin])
        state["goal_ori"] = origin.T @ arm.goal_ori
        at_once = self._clocks(self._substeps - 1)
        for substep in range(self._substeps):
            fingers = robot.gripper.format_action(action[6:])
            data.ctrl[self._fingers] = self._bias + self._weight * fingers
            check(self._library.run(self._handle, *self._places, 1, 0))
            if not at_once or substep == self._substeps - 1:
                env._update_observables()
        arm.new_update = True
        env.cur_time += env.control_timestep
        reward, _, _ = env._post_action(action)
        return env._get_observations(), float(reward), bool(env._check_success())

    def _clocks(self, substeps: int) -> bool:
        """Let the observables' clocks pass all but the last substep; False, and nothing done, if any samples before."""
        passed: list[tuple[Any, float, bool]] = []
        for each in self._env._observables.values():
            if not each._enabled:
                continue
            time, sampled, period = each._time_since_last_sample, each._sampled, each._sampling_timestep
            for _ in range(substeps):
                time += self._env.model_timestep
                if not sampled and period - each._current_delay >= time:
                    return False
                if time >= period:
                    if not sampled:
                        return False
                    time, sampled = time % period, False
            passed.append((each, time, sampled))
        for each, time, sampled in passed:
            each._time_since_last_sample, each._sampled = time, sampled
        return True
