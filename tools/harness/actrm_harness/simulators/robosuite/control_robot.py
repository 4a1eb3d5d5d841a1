"""One robot of an environment as the compiled loop sees it: where it is, and its controllers' memory."""

from typing import Any

import numpy as np

from actrm_harness.simulators.robosuite.control_abi import STATE, ArmBinding, ControlError
from actrm_harness.simulators.robosuite.control_known import origin_site
from actrm_harness.simulators.robosuite.control_recent import Recent
from actrm_harness.wire import Array

_POLICY_SITE = (STATE.fields or {})["policy_ref_pos"][1] // 8


def arm_binding(env: Any, robot: Any) -> ArmBinding:
    """Where this robot is in the simulation, and its controllers' constants."""
    parts = robot.composite_controller.part_controllers
    # a robot without a gripper has no such part
    arm, fingers = parts["right"], parts.get("right_gripper")
    actuators = robot._ref_actuators_indexes_dict
    binding = ArmBinding(grip_site=env.sim.model.site_name2id(arm.ref_name), origin_site=origin_site(env, arm))
    numbers: dict[str, Any] = {
        "arm_qpos": arm.qpos_index,
        "arm_dof": arm.qvel_index,
        "arm_actuator": actuators["right"],
        "kp": arm.kp,
        "kd": arm.kd,
        **_scaling(arm),
        "initial_joint": arm.initial_joint,
    }
    if robot.gripper["right"].dof:
        low, high = fingers.actuator_min, fingers.actuator_max
        binding.fingers = len(actuators["right_gripper"])
        binding.gripper_speed = robot.gripper["right"].speed
        numbers |= {
            "gripper_actuator": actuators["right_gripper"],
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


def _scaling(part: Any) -> dict[str, Array]:
    """The constants of a part's `scale_action`, by the same expressions."""
    return {
        "input_min": part.input_min,
        "input_max": part.input_max,
        "input_offset": (part.input_max + part.input_min) / 2.0,
        "scale": abs(part.output_max - part.output_min) / abs(part.input_max - part.input_min),
        "output_offset": (part.output_max + part.output_min) / 2.0,
    }


class SharedRobot:
    """A robot whose controllers keep their numbers in the memory that the library works in."""

    def __init__(self, env: Any, robot: Any, state: Any) -> None:
        self._robot = robot
        self._state: Any = state
        self._views: dict[str, Array] = {name: state[name] for name in STATE.names or ()}
        self._policy_site = np.frombuffer(state, dtype=np.float64)[_POLICY_SITE : _POLICY_SITE + 18]
        self._composite = robot.composite_controller
        self._arm = self._composite.part_controllers["right"]
        self._fingers = self._composite.part_controllers.get("right_gripper")
        self._gripper = robot.gripper["right"]
        self.action = robot.action_dim
        self._share()
        self._recent = Recent(robot, env.sim.data._data)

    def bound(self) -> bool:
        """Whether the robot's controllers are still those that share their numbers."""
        return (
            self._robot.composite_controller is self._composite
            and self._arm.joint_pos is self._views["joint_pos"]
            and self._arm.goal_pos is self._views["goal_pos"]
            and (not self._gripper.dof or self._gripper.current_action is self._views["gripper_action"])
        )

    def before(self) -> tuple[Array, Array]:
        """What `note` wants to know of the robot before a step."""
        return self._recent.before()

    def note(self, before: tuple[Array, Array], action: Array) -> None:
        """A control step by this robot's part of an action is over."""
        self._recent.note(before, action, self._policy_site)

    def stepped(self) -> None:
        """Substeps are over: the controllers' numbers are of now."""
        self._arm.new_update = True
        if self._fingers is not None:
            self._fingers.new_update = True

    def _share(self) -> None:
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
        if self._gripper.dof:
            # one number after a reset, one for each finger later
            share(self._gripper, "current_action", views["gripper_action"])
            share(self._fingers, "goal_qvel", views["gripper_goal"])
        self._state["new_update"] = 1 if arm.new_update else 0
