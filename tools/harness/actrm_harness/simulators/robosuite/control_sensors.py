"""robosuite's commonest sensors and its contact test, restated so that they cost less.

A sensor of robosuite fetches each number through two layers of properties. Those below read the same numbers out of
arrays that are fetched once, and give the same bits. A sensor is recognised by the module and qualified name of its
function; every other one is called as it is.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from actrm_harness.wire import Array

Sensor = Callable[[dict[str, Any]], Array]
Maker = Callable[[Any, dict[str, Any]], Sensor]

_XYZW = np.array([1, 2, 3, 0])


def cheaper(sensor: Any, env: Any) -> Sensor | None:
    """A cheaper function with the values of `sensor`, or None if it is not known."""
    make = _MAKERS.get(f"{sensor.__module__}.{sensor.__qualname__}")
    if make is None:
        return None
    cells = sensor.__closure__ or ()
    enclosed = dict(zip(sensor.__code__.co_freevars, (cell.cell_contents for cell in cells), strict=True))
    return make(env, enclosed)


def _gather(array: Array, indices: list[int]) -> Sensor:
    places = np.array(indices, dtype=np.intp)
    return lambda _cache: array.take(places)


def _row(array: Array, index: int) -> Sensor:
    row = array[index]
    return lambda _cache: row.copy()


def _quaternion(array: Array, index: int) -> Sensor:
    row = array[index]
    return lambda _cache: row.take(_XYZW)


def _of_joints(field: str, indices: str) -> Maker:
    """Numbers of the robot's joints; `indices` is the robot's attribute that says where they are."""

    def make(env: Any, enclosed: dict[str, Any]) -> Sensor:
        places = getattr(enclosed["self"], indices)
        return _gather(getattr(env.sim.data._data, field), places[enclosed["arm"]] if "arm" in enclosed else places)

    return make


def _of_joint(address: str) -> Maker:
    """One joint's position, whose place is an attribute of the environment."""
    return lambda env, _: _gather(env.sim.data._data.qpos, [getattr(env, address)])


def _of_body(kind: Callable[[Array, int], Sensor], field: str, body: Callable[[Any, dict[str, Any]], int]) -> Maker:
    """A row of a field of bodies or sites."""
    return lambda env, enclosed: kind(getattr(env.sim.data._data, field), body(env, enclosed))


def _hand(_: Any, enclosed: dict[str, Any]) -> int:
    return enclosed["self"].eef_site_id[enclosed["arm"]]


def _hand_body(env: Any, enclosed: dict[str, Any]) -> int:
    return env.sim.model.body_name2id(enclosed["self"].robot_model.eef_name[enclosed["arm"]])


def _named(closed_over: str) -> Callable[[Any, dict[str, Any]], int]:
    return lambda env, enclosed: env.obj_body_id[enclosed[closed_over]]


def _cube(name: str) -> Callable[[Any, dict[str, Any]], int]:
    return lambda env, _: getattr(env, f"{name}_body_id")


_JOINTS = "robosuite.robots.robot.Robot.setup_observables.<locals>."
_ARM = "robosuite.robots.robot.Robot._create_arm_sensors.<locals>."
_TASK = "robosuite.environments.manipulation."
_LIFT = f"{_TASK}lift.Lift._setup_observables.<locals>."
_STACK = f"{_TASK}stack.Stack._setup_observables.<locals>."
_OBJECT = f"{_TASK}pick_place.PickPlace._create_obj_sensors.<locals>."
_NUT = f"{_TASK}nut_assembly.NutAssembly._create_nut_sensors.<locals>."
_DOOR = f"{_TASK}door.Door._setup_observables.<locals>."

_MAKERS: dict[str, Maker] = {
    f"{_JOINTS}joint_pos": _of_joints("qpos", "_ref_joint_pos_indexes"),
    f"{_JOINTS}joint_vel": _of_joints("qvel", "_ref_joint_vel_indexes"),
    f"{_JOINTS}joint_acc": _of_joints("qacc", "_ref_joint_vel_indexes"),
    f"{_ARM}gripper_qpos": _of_joints("qpos", "_ref_gripper_joint_pos_indexes"),
    f"{_ARM}gripper_qvel": _of_joints("qvel", "_ref_gripper_joint_vel_indexes"),
    f"{_ARM}eef_pos": _of_body(_row, "site_xpos", _hand),
    f"{_ARM}eef_quat": _of_body(_quaternion, "xquat", _hand_body),
    f"{_LIFT}cube_pos": _of_body(_row, "xpos", _cube("cube")),
    f"{_LIFT}cube_quat": _of_body(_quaternion, "xquat", _cube("cube")),
    f"{_STACK}cubeA_pos": _of_body(_row, "xpos", _cube("cubeA")),
    f"{_STACK}cubeA_quat": _of_body(_quaternion, "xquat", _cube("cubeA")),
    f"{_STACK}cubeB_pos": _of_body(_row, "xpos", _cube("cubeB")),
    f"{_STACK}cubeB_quat": _of_body(_quaternion, "xquat", _cube("cubeB")),
    f"{_OBJECT}obj_pos": _of_body(_row, "xpos", _named("obj_name")),
    f"{_OBJECT}obj_quat": _of_body(_quaternion, "xquat", _named("obj_name")),
    f"{_NUT}nut_pos": _of_body(_row, "xpos", _named("nut_name")),
    f"{_NUT}nut_quat": _of_body(_quaternion, "xquat", _named("nut_name")),
    f"{_DOOR}door_pos": _of_body(_row, "xpos", lambda env, _: env.object_body_ids["door"]),
    f"{_DOOR}handle_pos": _of_body(_row, "site_xpos", lambda env, _: env.door_handle_site_id),
    f"{_DOOR}hinge_qpos": _of_joint("hinge_qpos_addr"),
    f"{_DOOR}handle_qpos": _of_joint("handle_qpos_addr"),
}


class WatchedCache(dict[str, Any]):
    """The cache that an update of all sensors shares; notices when one reads what another has yet to write in it."""

    def __init__(self, cache: dict[str, Any], awaited: set[str]) -> None:
        super().__init__(cache)
        self.late_reads = False
        self._awaited = awaited

    def __getitem__(self, name: str) -> Any:
        self.late_reads |= name in self._awaited
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """As a dictionary's own, which would not come through here."""
        self.late_reads |= name in self._awaited
        return super().get(name, default)

    def __setitem__(self, name: str, value: Any) -> None:
        self._awaited.discard(name)
        super().__setitem__(name, value)


class ContactTest:
    """`env.check_contact` on the array of touching geoms instead of contact by contact."""

    def __init__(self, sim: Any) -> None:
        self._data = sim.data._data
        self._names = [sim.model.geom_id2name(geom) for geom in range(sim.model.ngeom)]
        self._masks: dict[tuple[str, ...], Array] = {}

    def _mask(self, geoms: Any) -> Array:
        # a model of robosuite, one name or several
        geoms = getattr(geoms, "contact_geoms", geoms)
        key = (geoms,) if isinstance(geoms, str) else tuple(geoms)
        mask = self._masks.get(key)
        if mask is None:
            mask = np.array([name in key for name in self._names])
            self._masks[key] = mask
        return mask

    def __call__(self, geoms_1: Any, geoms_2: Any = None) -> bool:
        """Whether any geom of the first group touches one of the second (or anything)."""
        if self._data.ncon == 0:
            return False
        pairs = self._data.contact.geom
        first = self._mask(geoms_1)[pairs]
        if geoms_2 is None:
            return bool(first.any())
        second = self._mask(geoms_2)[pairs]
        return bool(((first[:, 0] & second[:, 1]) | (first[:, 1] & second[:, 0])).any())
