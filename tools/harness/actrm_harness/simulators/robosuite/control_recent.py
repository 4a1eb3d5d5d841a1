"""The robot's buffers of recent values (`recent_qpos`, `recent_ee_vel`, ...), filled when somebody looks.

robosuite pushes into them at every control step, mostly for nobody. Here a step leaves a note of the few numbers that
they are made of, and reading any of them replays the notes in order, by robosuite's own arithmetic.
"""

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from actrm_harness.wire import Array

_ARM = "right"
_MOST_NOTES = 1000
_PLAIN = ("recent_qpos", "recent_actions", "recent_torques")
_OF_ARM = (
    "recent_ee_forcetorques",
    "recent_ee_pose",
    "recent_ee_vel",
    "recent_ee_vel_buffer",
    "recent_ee_acc",
)


@dataclass(slots=True)
class _Note:
    """What one control step leaves."""

    qpos: Array
    action: Array
    wrench: Array
    site: Array
    """Position, orientation, velocity and angular velocity of the grip site."""


class _LateBuffer:
    """Stands for a buffer of robosuite's; brings all of them up to date before anything is read from it."""

    def __init__(self, buffer: Any, recent: "Recent") -> None:
        self.late_buffer = buffer
        self.late_recent = recent

    def __getattr__(self, name: str) -> Any:
        self.late_recent.catch_up()
        return getattr(self.late_buffer, name)


class Recent:
    """The buffers of one robot from one reset to the next."""

    def __init__(self, robot: Any, data: Any) -> None:
        self._robot = robot
        self._notes: list[_Note] = []
        self._qpos: Array = data.qpos
        self._sensors: Array = data.sensordata
        self._joints = np.array(robot._ref_joint_pos_indexes, dtype=np.intp)
        self._wrench = np.concatenate([_places(robot, name) for name in ("force_ee", "torque_ee")])
        self._mat2quat = importlib.import_module("robosuite.utils.transform_utils").mat2quat
        self._buffers: dict[str, Any] = {}
        for name in _PLAIN:
            self._buffers[name] = _late(getattr(robot, name))
            setattr(robot, name, _LateBuffer(self._buffers[name], self))
        for name in _OF_ARM:
            of_arm = getattr(robot, name)
            self._buffers[name] = _late(of_arm[_ARM])
            of_arm[_ARM] = _LateBuffer(self._buffers[name], self)

    def before(self) -> tuple[Array, Array]:
        """The numbers of a note that a control step changes: joint angles, then force and torque at the hand."""
        return self._qpos.take(self._joints), self._sensors.take(self._wrench)

    def note(self, before: tuple[Array, Array], action: Array, site: Array) -> None:
        """Remember a control step."""
        self._notes.append(_Note(before[0], action.copy(), before[1], site.copy()))
        if len(self._notes) == _MOST_NOTES:
            self.catch_up()

    def catch_up(self) -> None:
        """Push what was noted, as `FixedBaseRobot.control` pushes it."""
        notes, self._notes = self._notes, []
        buffers, robot = self._buffers, self._robot
        for note in notes:
            buffers["recent_qpos"].push(note.qpos)
            buffers["recent_actions"].push(note.action)
            buffers["recent_torques"].push(robot.torques)
            buffers["recent_ee_forcetorques"].push(note.wrench)
            quaternion = self._mat2quat(note.site[3:12].reshape(3, 3))
            buffers["recent_ee_pose"].push(np.concatenate((note.site[:3], quaternion)))
            velocity = note.site[12:18]
            buffers["recent_ee_vel"].push(velocity)
            buffers["recent_ee_vel_buffer"].push(velocity)
            acceleration = buffers["recent_ee_acc"]
            steps = robot.control_freq * np.diff(buffers["recent_ee_vel_buffer"].buf, axis=0)
            columns = np.vstack([acceleration.current, steps]).transpose()
            acceleration.push(np.array([_mean(column) for column in columns]))


def _mean(column: Array) -> float:
    return float(np.convolve(column, np.ones(10) / 10.0, mode="valid")[0])


def _late(buffer: Any) -> Any:
    """The buffer itself, up to date, where it is already stood for."""
    if not isinstance(buffer, _LateBuffer):
        return buffer
    buffer.late_recent.catch_up()
    return buffer.late_buffer


def _places(robot: Any, kind: str) -> Array:
    """Where a sensor of the gripper has its numbers in `sensordata`."""
    model = robot.sim.model
    sensor = model.sensor_name2id(robot.gripper[_ARM].important_sensors[kind])
    first = int(np.sum(model.sensor_dim[:sensor]))
    return np.arange(first, first + int(model.sensor_dim[sensor]))
