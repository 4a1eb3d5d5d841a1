"""robosuite's commonest sensors and its contact test, restated so that they cost less.

A sensor of robosuite fetches each number through two layers of properties. Those below read the
same numbers out of arrays that are fetched once, and give the same bits. A sensor is recognised by
the module and qualified name of its function; every other one is called as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from robosuite.models.base import MujocoModel

Sensor = Callable[[dict[str, Any]], Any]

_XYZW = np.array([1, 2, 3, 0])


def cheaper(sensor: Any, env: Any) -> Sensor | None:
    """A cheaper function with the values of `sensor`, or None if it is not known."""
    make = _MAKERS.get((sensor.__module__, sensor.__qualname__))
    return None if make is None else make(env, _Enclosed(sensor))


class _Enclosed:
    """What a sensor's function closes over, by name."""

    def __init__(self, sensor: Any) -> None:
        cells = sensor.__closure__ or ()
        self._values = dict(zip(sensor.__code__.co_freevars, (c.cell_contents for c in cells)))

    def __getattr__(self, name: str) -> Any:
        return self._values[name]


def _gather(array: np.ndarray, indices: Any) -> Sensor:
    places = np.array(indices, dtype=np.intp)
    take = array.take
    return lambda _cache: take(places)


def _row(array: np.ndarray, index: int) -> Sensor:
    copy = array[index].copy
    return lambda _cache: copy()


def _quaternion(array: np.ndarray, index: int) -> Sensor:
    take = array[index].take
    return lambda _cache: take(_XYZW)


def _data(env: Any) -> Any:
    return env.sim.data._data


def _object_body(env: Any, sensor: _Enclosed, name: str) -> int:
    return env.obj_body_id[getattr(sensor, name)]


_ROBOT = "robosuite.robots.robot"
_TASKS = "robosuite.environments.manipulation."

_MAKERS: dict[tuple[str, str], Callable[[Any, Any], Sensor]] = {
    (_ROBOT, "Robot.setup_observables.<locals>.joint_pos"): lambda env, s: _gather(
        _data(env).qpos, s.self._ref_joint_pos_indexes
    ),
    (_ROBOT, "Robot.setup_observables.<locals>.joint_vel"): lambda env, s: _gather(
        _data(env).qvel, s.self._ref_joint_vel_indexes
    ),
    (_ROBOT, "Robot.setup_observables.<locals>.joint_acc"): lambda env, s: _gather(
        _data(env).qacc, s.self._ref_joint_vel_indexes
    ),
    (_ROBOT, "Robot._create_arm_sensors.<locals>.eef_pos"): lambda env, s: _row(
        _data(env).site_xpos, s.self.eef_site_id[s.arm]
    ),
    (_ROBOT, "Robot._create_arm_sensors.<locals>.eef_quat"): lambda env, s: _quaternion(
        _data(env).xquat, env.sim.model.body_name2id(s.self.robot_model.eef_name[s.arm])
    ),
    (_ROBOT, "Robot._create_arm_sensors.<locals>.gripper_qpos"): lambda env, s: _gather(
        _data(env).qpos, s.self._ref_gripper_joint_pos_indexes[s.arm]
    ),
    (_ROBOT, "Robot._create_arm_sensors.<locals>.gripper_qvel"): lambda env, s: _gather(
        _data(env).qvel, s.self._ref_gripper_joint_vel_indexes[s.arm]
    ),
    (_TASKS + "pick_place", "PickPlace._create_obj_sensors.<locals>.obj_pos"): lambda env, s: _row(
        _data(env).xpos, _object_body(env, s, "obj_name")
    ),
    (
        _TASKS + "pick_place",
        "PickPlace._create_obj_sensors.<locals>.obj_quat",
    ): lambda env, s: _quaternion(_data(env).xquat, _object_body(env, s, "obj_name")),
    (
        _TASKS + "nut_assembly",
        "NutAssembly._create_nut_sensors.<locals>.nut_pos",
    ): lambda env, s: _row(_data(env).xpos, _object_body(env, s, "nut_name")),
    (
        _TASKS + "nut_assembly",
        "NutAssembly._create_nut_sensors.<locals>.nut_quat",
    ): lambda env, s: _quaternion(_data(env).xquat, _object_body(env, s, "nut_name")),
    (_TASKS + "door", "Door._setup_observables.<locals>.door_pos"): lambda env, _s: _row(
        _data(env).xpos, env.object_body_ids["door"]
    ),
    (_TASKS + "door", "Door._setup_observables.<locals>.handle_pos"): lambda env, _s: _row(
        _data(env).site_xpos, env.door_handle_site_id
    ),
    (_TASKS + "door", "Door._setup_observables.<locals>.hinge_qpos"): lambda env, _s: _gather(
        _data(env).qpos, [env.hinge_qpos_addr]
    ),
    (_TASKS + "door", "Door._setup_observables.<locals>.handle_qpos"): lambda env, _s: _gather(
        _data(env).qpos, [env.handle_qpos_addr]
    ),
}


def _cube(module: str, kind: str, cube: str) -> None:
    for what, make, array in (("pos", _row, "xpos"), ("quat", _quaternion, "xquat")):
        name = f"{kind}._setup_observables.<locals>.{cube}_{what}"
        _MAKERS[_TASKS + module, name] = lambda env, _s, make=make, array=array: make(
            getattr(_data(env), array), getattr(env, f"{cube}_body_id")
        )


_cube("lift", "Lift", "cube")
_cube("stack", "Stack", "cubeA")
_cube("stack", "Stack", "cubeB")


class ContactTest:
    """`env.check_contact` on the array of touching geoms instead of contact by contact."""

    def __init__(self, sim: Any) -> None:
        self._data = sim.data._data
        self._names = [sim.model.geom_id2name(i) for i in range(sim.model.ngeom)]
        self._masks: dict[tuple[str, ...], np.ndarray] = {}

    def _mask(self, geoms: Any) -> np.ndarray:
        if isinstance(geoms, MujocoModel):
            geoms = geoms.contact_geoms
        key = (geoms,) if isinstance(geoms, str) else tuple(geoms)
        mask = self._masks.get(key)
        if mask is None:
            mask = np.array([name in key for name in self._names])
            self._masks[key] = mask
        return mask

    def __call__(self, geoms_1: Any, geoms_2: Any = None) -> bool:
        if self._data.ncon == 0:
            return False
        pairs = self._data.contact.geom
        first = self._mask(geoms_1)[pairs]
        if geoms_2 is None:
            return bool(first.any())
        second = self._mask(geoms_2)[pairs]
        return bool(((first[:, 0] & second[:, 1]) | (first[:, 1] & second[:, 0])).any())
