"""How far an episode came: the stages of robosuite's own tasks, in the order in which a policy passes them.

A stage is a name and a question to the present state; it is reached once, and only after those before it. What solves
the task is no stage: it ends the episode. Environments of ours have a method `stages()` that gives theirs. Nothing here
changes the simulation, and nothing that an episode depends on is drawn from it.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from actrm_harness.wire import Array

Stage = tuple[str, Callable[[], bool]]

NEAR = 0.05
"""How near to a thing the grip site is at it, in metres."""
LIFTED = 0.03
"""By how much a thing is higher than it lay when it is up."""


def stages(env: Any, task: str) -> tuple[Stage, ...]:
    """The stages of a task, for the episode that has just begun; none where nobody has named any."""
    own = getattr(env, "stages", None)
    if own is not None:
        return tuple(own())
    found = _STAGES.get(task)
    # one robot with two arms may do what two robots usually do
    if found is None or (task.startswith("TwoArm") and len(env.robots) != 2):
        return ()
    return found(env)


def hand(env: Any) -> Array:
    """Where the grip site is."""
    return np.array(env.sim.data.site_xpos[env.robots[0].eef_site_id["right"]])


def held(env: Any, thing: Any) -> bool:
    """Whether both fingers touch it."""
    return bool(env._check_grasp(gripper=env.robots[0].gripper, object_geoms=thing))


def fetching(env: Any, thing: Any, place: Callable[[], Array], grip: Callable[[], Array] | None = None) -> list[Stage]:
    """At a thing, holding it, and holding it above where it lay; `grip` is where to hold it, if not at its centre."""
    at = place if grip is None else grip
    rest = float(place()[2])
    return [
        ("at it", lambda: float(np.linalg.norm(hand(env) - at())) < NEAR),
        ("held", lambda: held(env, thing)),
        ("lifted", lambda: float(place()[2]) > rest + LIFTED),
    ]


def _body(env: Any, body: int) -> Callable[[], Array]:
    return lambda: np.array(env.sim.data.body_xpos[body])


def _above(place: Callable[[], Array], target: Callable[[], Array], within: float) -> Callable[[], bool]:
    return lambda: float(np.abs((place() - target())[:2]).max()) < within


def _lift(env: Any) -> tuple[Stage, ...]:
    return tuple(fetching(env, env.cube, _body(env, env.cube_body_id))[:2])


def _stack(env: Any) -> tuple[Stage, ...]:
    upper, lower = _body(env, env.cubeA_body_id), _body(env, env.cubeB_body_id)
    return (*fetching(env, env.cubeA, upper), ("above", _above(upper, lower, 0.02)))


# How far above their origins the tall things of the bins are taken.
_GRIPPED = {"Milk": 0.045, "Cereal": 0.04}


def _pick_place(env: Any) -> tuple[Stage, ...]:
    thing = env.objects[env.object_id]
    place, bin_place = _body(env, env.obj_body_id[thing.name]), np.array(env.target_bin_placements[env.object_id])
    half = np.array(env.bin_size[:2]) / 4.0
    grip = np.array([0.0, 0.0, _GRIPPED.get(thing.name, 0.0)])

    def above() -> bool:
        return bool(np.all(np.abs(place()[:2] - bin_place[:2]) < half))

    return (*fetching(env, thing, place, lambda: place() + grip), ("above", above))


def _pick_place_all(env: Any) -> tuple[Stage, ...]:
    def arrived(count: int) -> Callable[[], bool]:
        def judge() -> bool:
            places = [env.sim.data.body_xpos[env.obj_body_id[thing.name]] for thing in env.objects]
            return sum(not env.not_in_bin(place, index) for index, place in enumerate(places)) >= count

        return judge

    return (
        ("held", lambda: any(held(env, thing) for thing in env.objects)),
        *((f"{name} there", arrived(count)) for count, name in ((1, "one"), (2, "two"), (3, "three"))),
    )


def _nut(env: Any) -> tuple[Stage, ...]:
    nut = env.nuts[env.nut_id]
    place, peg = _body(env, env.obj_body_id[nut.name]), _body(env, (env.peg1_body_id, env.peg2_body_id)[env.nut_id])
    handle = env.sim.model.site_name2id(nut.important_sites["handle"])
    grip = lambda: np.array(env.sim.data.site_xpos[handle])  # noqa: E731
    return (*fetching(env, nut, place, grip), ("above", _above(place, peg, 0.03)))


def _nuts(env: Any) -> tuple[Stage, ...]:
    def on_pegs(count: int) -> bool:
        places = [env.sim.data.body_xpos[env.obj_body_id[nut.name]] for nut in env.nuts]
        return sum(bool(env.on_peg(place, index)) for index, place in enumerate(places)) >= count

    def one_held() -> bool:
        return any(held(env, nut) for nut in env.nuts)

    # the other one, for the hand has to be off the first
    return (
        ("held", one_held),
        ("one there", lambda: on_pegs(1)),
        ("let go", lambda: not one_held()),
        ("other held", one_held),
    )


def _door(env: Any) -> tuple[Stage, ...]:
    def open_by(angle: float) -> Callable[[], bool]:
        return lambda: float(env.sim.data.qpos[env.hinge_qpos_addr]) > angle

    def at_handle() -> bool:
        return float(np.linalg.norm(hand(env) - env._handle_xpos)) < NEAR

    return (("at it", at_handle), ("ajar", open_by(0.03)), ("half open", open_by(0.15)))


def _wipe(env: Any) -> tuple[Stage, ...]:
    def wiped(share: float) -> Callable[[], bool]:
        return lambda: len(env.wiped_markers) >= share * env.num_markers

    return (("begun", wiped(0.01)), ("half", wiped(0.5)), ("nearly", wiped(0.9)))


def _two_arm_lift(env: Any) -> tuple[Stage, ...]:
    handles = (env.pot.handle0_geoms, env.pot.handle1_geoms)
    rest = float(env.sim.data.body_xpos[env.pot_body_id][2])

    def hold(count: int) -> Callable[[], bool]:
        def judge() -> bool:
            pairs = zip(env.robots, handles, strict=True)
            return sum(env._check_grasp(gripper=robot.gripper, object_geoms=geoms) for robot, geoms in pairs) >= count

        return judge

    def lifted() -> bool:
        return float(env.sim.data.body_xpos[env.pot_body_id][2]) > rest + LIFTED

    return (("one holds", hold(1)), ("both hold", hold(2)), ("lifted", lifted))


def _tool_hang(env: Any) -> tuple[Stage, ...]:
    frame, tool = _body(env, env.obj_body_id["frame"]), _body(env, env.obj_body_id["tool"])
    handle = env.sim.model.geom_name2id("frame_grip_frame")
    hook = env.sim.model.geom_name2id("frame_hook_frame")

    def at(geom: int) -> Callable[[], Array]:
        return lambda: np.array(env.sim.data.geom_xpos[geom])

    def ring() -> Array:
        return np.array(env.sim.data.site_xpos[env.obj_site_id["tool_hole1_center"]])

    return (
        *((f"frame {name}", reached) for name, reached in fetching(env, env.frame, frame, at(handle))),
        ("assembled", lambda: bool(env._check_frame_assembled())),
        *((f"tool {name}", reached) for name, reached in fetching(env, env.tool, tool)),
        ("above", _above(ring, at(hook), 0.02)),
    )


def _two_arm_transport(env: Any) -> tuple[Stage, ...]:
    group = env.transport
    payload = _body(env, group.payload_body_id)
    rest = float(payload()[2])
    covered = float(group.lid_handle_pos[0])
    return (
        ("uncovered", lambda: abs(float(group.lid_handle_pos[0]) - covered) > env.bin_size[0] / 2.0),
        ("trash out", lambda: bool(group.trash_in_trash_bin)),
        ("first holds", _holds(env, group.payload, 0)),
        ("lifted", lambda: float(payload()[2]) > rest + LIFTED),
        ("both hold", _holds(env, group.payload, 0, 1)),
        ("second holds", _holds(env, group.payload, 1)),
    )


def _two_arm_handover(env: Any) -> tuple[Stage, ...]:
    hammer = _body(env, env.hammer_body_id)
    rest = float(hammer()[2])
    return (
        ("first holds", _holds(env, env.hammer, 0)),
        ("lifted", lambda: float(hammer()[2]) > rest + LIFTED),
        ("both hold", _holds(env, env.hammer, 0, 1)),
    )


def _holds(env: Any, thing: Any, *arms: int) -> Callable[[], bool]:
    """Whether these arms hold a thing, and no other."""

    def judge() -> bool:
        grasps = [env._check_grasp(gripper=robot.gripper, object_geoms=thing) for robot in env.robots]
        return all(bool(grasp) == (arm in arms) for arm, grasp in enumerate(grasps))

    return judge


def _two_arm_peg_in_hole(env: Any) -> tuple[Stage, ...]:
    # the peg's axis to the hole's: metres beside it, and how well the two agree, as success asks
    def turned() -> bool:
        return bool(env._compute_orientation()[2] > 0.95)

    def in_line() -> bool:
        return turned() and bool(env._compute_orientation()[1] < 0.06)

    return (("turned", turned), ("in line", in_line))


_STAGES: dict[str, Callable[[Any], tuple[Stage, ...]]] = {
    "Lift": _lift,
    "Stack": _stack,
    "PickPlaceCan": _pick_place,
    "PickPlaceMilk": _pick_place,
    "PickPlaceBread": _pick_place,
    "PickPlaceCereal": _pick_place,
    "PickPlace": _pick_place_all,
    "NutAssemblySquare": _nut,
    "NutAssemblyRound": _nut,
    "NutAssembly": _nuts,
    "Wipe": _wipe,
    "TwoArmLift": _two_arm_lift,
    "TwoArmHandover": _two_arm_handover,
    "TwoArmPegInHole": _two_arm_peg_in_hole,
    "TwoArmTransport": _two_arm_transport,
    "ToolHang": _tool_hang,
    "Door": _door,
}
