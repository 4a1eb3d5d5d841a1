"""Towers of three coloured cubes.

`StackThreeCubes`: three cubes of 4 cm, red, green and blue; green has to stand on red and blue on green.

`StackColor`: the same cubes, but the observation lists them in a random order of slots with their colours, and which
has to stand on which is the episode's goal, given as an observation: three colours from bottom to top. Demonstrations
show four of the six orders in exact colours; evaluation asks for all six, with hues slightly shifted. An episode's
`ep_meta` says its order, its slots, and whether demonstrations show the order (its group: "seen" or "unseen"); set
before a reset, it decides them.
"""

import colorsys
import importlib
import itertools
from typing import Any

import numpy as np

from actrm_harness.wire import Array

_Stack: Any = importlib.import_module("robosuite.environments.manipulation.stack")
_Objects: Any = importlib.import_module("robosuite.models.objects")
_Observables: Any = importlib.import_module("robosuite.utils.observables")
_Base: Any = _Stack.Stack

COLORS = {"red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0), "blue": (0.0, 0.0, 1.0)}
ORDERS = tuple(itertools.permutations(COLORS))
# Every colour is seen at every height.
UNSEEN = (("red", "blue", "green"), ("green", "red", "blue"))
SEEN = tuple(order for order in ORDERS if order not in UNSEEN)

HALF = 0.02
REACH = 0.1
APART = 0.06
HUE_SHIFT = 0.05


def stands_on(upper: Array, lower: Array) -> bool:
    """Whether a cube stands on another: centres within 5 cm sideways and 1.5 cm of touching."""
    away = upper - lower
    return bool(np.linalg.norm(away[:2]) < 0.05 and abs(float(away[2]) - 2 * HALF) < 0.015)


class StackThreeCubes(_Base):
    """Green on red, blue on green; reward 0.5 for the first and 1.0 for both."""

    order: tuple[str, ...] = ("red", "green", "blue")

    def _load_model(self) -> None:
        super(_Base, self)._load_model()
        robot = self.robots[0].robot_model
        robot.set_base_xpos(robot.base_xpos_offset["table"](self.table_full_size[0]))
        arena = _Stack.TableArena(
            table_full_size=self.table_full_size,
            table_friction=self.table_friction,
            table_offset=self.table_offset,
        )
        arena.set_origin([0, 0, 0])
        self.cubes: dict[str, Any] = {
            name: _Objects.BoxObject(name=name, size=[HALF] * 3, rgba=[*color, 1.0]) for name, color in COLORS.items()
        }
        self.model = _Stack.ManipulationTask(
            mujoco_arena=arena, mujoco_robots=[robot], mujoco_objects=list(self.cubes.values())
        )

    def _setup_references(self) -> None:
        super(_Base, self)._setup_references()
        self.cube_ids: dict[str, int] = {
            name: self.sim.model.body_name2id(cube.root_body) for name, cube in self.cubes.items()
        }

    def _reset_internal(self) -> None:
        super(_Base, self)._reset_internal()
        if not self.deterministic_reset:
            for cube, place in zip(self.cubes.values(), self._places(), strict=True):
                self.sim.data.set_joint_qpos(cube.joints[0], place)

    def _places(self) -> list[Array]:
        """Poses of the cubes on the table, drawn until they are far enough from one another."""
        while True:
            flat = self.rng.uniform(-REACH, REACH, size=(len(COLORS), 2))
            if min(np.linalg.norm(a - b) for a, b in itertools.combinations(flat, 2)) >= APART:
                break
        turns = self.rng.uniform(0, 2 * np.pi, size=len(COLORS))
        height = self.table_offset[2] + HALF + 0.01
        return [
            np.array([x, y, height, np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
            for (x, y), turn in zip(flat, turns, strict=True)
        ]

    def position(self, name: str) -> Array:
        """Centre of a cube."""
        return np.array(self.sim.data.body_xpos[self.cube_ids[name]])

    def orientation(self, name: str) -> Array:
        """Orientation of a cube as (x, y, z, w)."""
        return np.array(self.sim.data.body_xquat[self.cube_ids[name]])[[1, 2, 3, 0]]

    def _hand(self) -> Array:
        return np.array(self.sim.data.site_xpos[self.robots[0].eef_site_id["right"]])

    def _setup_observables(self) -> dict[str, Any]:
        observables: dict[str, Any] = super(_Base, self)._setup_observables()
        if self.use_object_obs:
            for name, read in self._values().items():
                sensor = _Observables.sensor(modality="object")(_sensor(read))
                observables[name] = _Observables.Observable(name=name, sensor=sensor, sampling_rate=self.control_freq)
        return observables

    def _values(self) -> "dict[str, Any]":
        """What can be seen of the task, by name."""
        values: dict[str, Any] = {}
        for name in COLORS:
            values[f"{name}_pos"] = lambda name=name: self.position(name)
            values[f"{name}_quat"] = lambda name=name: self.orientation(name)
        for name in COLORS:
            values[f"gripper_to_{name}"] = lambda name=name: self.position(name) - self._hand()
        return values

    def reward(self, action: Array | None = None) -> float:
        """Half for the middle cube on the lowest, one for all three."""
        del action
        first, both = self.staged_rewards()
        return max(first, both) * (1.0 if self.reward_scale is None else self.reward_scale)

    def staged_rewards(self) -> tuple[float, float]:
        """Half where the middle cube stands on the lowest, one where all three stand."""
        bottom, middle, top = (self.position(name) for name in self.order)
        first = stands_on(middle, bottom)
        return 0.5 * first, 1.0 * (first and stands_on(top, middle))

    def _check_success(self) -> bool:
        return self.staged_rewards()[1] > 0.0

    def visualize(self, vis_settings: dict[str, bool]) -> None:
        """Nothing of the task is drawn into the scene."""
        super(_Base, self).visualize(vis_settings={**vis_settings, "grippers": False})


class StackColor(StackThreeCubes):
    """Stack in the order of colours that the goal names; which slot holds which cube has to be read."""

    demonstration: bool = False
    slots: tuple[str, ...] = tuple(COLORS)

    def _reset_internal(self) -> None:
        super()._reset_internal()
        if self.deterministic_reset:
            return
        orders = SEEN if self.demonstration else ORDERS
        self.order = orders[int(self.rng.integers(len(orders)))]
        self.slots = tuple(self.rng.permutation(list(COLORS)).tolist())
        given = self._ep_meta
        if given:
            self.order, self.slots = tuple(given["order"]), tuple(given["slots"])
        shifts = self.rng.uniform(-HUE_SHIFT, HUE_SHIFT, size=len(COLORS)) * (not self.demonstration)
        for name, shift in zip(COLORS, shifts, strict=True):
            hue, saturation, value = colorsys.rgb_to_hsv(*COLORS[name])
            color = colorsys.hsv_to_rgb((hue + shift) % 1.0, saturation, value)
            for geom in self.cubes[name].visual_geoms:
                self.sim.model.geom_rgba[self.sim.model.geom_name2id(geom)][:3] = color
        group = "unseen" if self.order in UNSEEN else "seen"
        self._ep_meta = {"order": list(self.order), "slots": list(self.slots), "group": group}

    def color(self, name: str) -> Array:
        """The colour that a cube shows."""
        geom = self.sim.model.geom_name2id(self.cubes[name].visual_geoms[0])
        return np.array(self.sim.model.geom_rgba[geom][:3], dtype=np.float64)

    def _values(self) -> "dict[str, Any]":
        values: dict[str, Any] = {}
        for index in range(len(COLORS)):
            values[f"slot{index}_pos"] = lambda index=index: self.position(self.slots[index])
            values[f"slot{index}_quat"] = lambda index=index: self.orientation(self.slots[index])
            values[f"slot{index}_rgb"] = lambda index=index: self.color(self.slots[index])
        for index in range(len(COLORS)):
            values[f"gripper_to_slot{index}"] = lambda index=index: self.position(self.slots[index]) - self._hand()
        values["goal_rgb"] = lambda: np.array([COLORS[name] for name in self.order]).ravel()
        return values


def _sensor(read: Any) -> Any:
    def sense(_: dict[str, Any]) -> Array:
        return read()

    return sense
