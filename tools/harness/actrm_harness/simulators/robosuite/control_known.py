"""Whether the compiled loop knows an environment, its robots and their controllers."""

import importlib
from typing import Any, cast

from actrm_harness.simulators.robosuite.control_abi import DOF, MUJOCO

ROBOSUITE = "1.5.2"


def unknown(env: Any) -> str | None:
    """Why the compiled loop cannot drive `env`; None if it can."""
    for name, known in (("mujoco", MUJOCO), ("robosuite", ROBOSUITE)):
        found = importlib.import_module(name).__version__
        if found != known:
            return f"it knows {name} {known}, this is {found}"
    return _unknown_env(env) or next(filter(None, (_unknown_robot(env, robot) for robot in env.robots)), None)


def _unknown_env(env: Any) -> str | None:
    kind = cast(Any, type(env))
    base = robosuite_class("environments.base", "MujocoEnv")
    robot_env = robosuite_class("environments.robot_env", "RobotEnv")
    if not isinstance(env, robot_env):
        return f"{kind.__name__} is no robot environment"
    replaced = {"step": base, "_update_observables": base, "_get_observations": base, "_pre_action": robot_env}
    for name, owner in replaced.items():
        if getattr(kind, name) is not getattr(owner, name) or name in env.__dict__:
            return f"{kind.__name__} has its own {name}"
    return _first(
        (
            type(env.sim) is robosuite_class("utils.binding_utils", "MjSim"),
            lambda: f"the simulation is a {type(env.sim).__name__}",
        ),
        (env.lite_physics, lambda: "lite_physics is off"),
        (not env.has_renderer and not env.viewer_get_obs, lambda: "the environment has a viewer"),
    )


def _unknown_robot(env: Any, robot: Any) -> str | None:
    if type(robot) is not robosuite_class("robots.fixed_base_robot", "FixedBaseRobot"):
        return f"a robot is a {robot.name} on no fixed base"
    composite = robot.composite_controller
    basic = robosuite_class("controllers.composite.composite_controller", "CompositeController")
    if type(composite) is not basic:
        return f"the composite controller is {type(composite).__name__}"
    parts = dict(composite._action_split_indexes)
    known = ({"right": (0, 6)}, *({"right": (0, 6), "right_gripper": (6, 6 + fingers)} for fingers in (0, 1)))
    return _first(
        (parts in known, lambda: f"the parts of an action are {parts}"),
        (all(robot.enabled(part) for part in parts), lambda: "a part of the robot is disabled"),
    ) or (_unknown_arm(env, robot) or _unknown_gripper(robot))


def _unknown_arm(env: Any, robot: Any) -> str | None:
    arm = robot.composite_controller.part_controllers["right"]
    if type(arm) is not robosuite_class("controllers.parts.arm.osc", "OperationalSpaceController"):
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
    if model.body_weldid[model.site_bodyid[origin_site(env, arm)]] != 0:
        return "the robot's base can move"
    return None


def _unknown_gripper(robot: Any) -> str | None:
    gripper = robot.gripper["right"]
    rigid = (("wiping_gripper", "WipingGripper"), ("null_gripper", "NullGripper"))
    if any(type(gripper) is robosuite_class(f"models.grippers.{module}", name) for module, name in rigid):
        return None if gripper.dof == 0 else f"the gripper has {gripper.dof} degrees of freedom"
    fingers = robot.composite_controller.part_controllers["right_gripper"]
    return _first(
        (
            type(gripper) is robosuite_class("models.grippers.panda_gripper", "PandaGripper"),
            lambda: f"the gripper is a {type(gripper).__name__}",
        ),
        (
            type(fingers) is robosuite_class("controllers.parts.gripper.simple_grip", "SimpleGripController"),
            lambda: f"the gripper's controller is {type(fingers).__name__}",
        ),
        (
            fingers.interpolator is None and fingers.use_action_scaling,
            lambda: "the gripper's controller interpolates or does not scale",
        ),
    )


def _first(*conditions: tuple[Any, Any]) -> str | None:
    return next((complaint() for holds, complaint in conditions if not holds), None)


def robosuite_class(module: str, name: str) -> Any:
    """A class of robosuite's, by the module it is in."""
    return getattr(importlib.import_module(f"robosuite.{module}"), name)


def origin_site(env: Any, arm: Any) -> int:
    """The site in whose frame an arm's goals are given."""
    return env.sim.model.site_name2id(f"{arm.naming_prefix}{arm.part_name}_center")
