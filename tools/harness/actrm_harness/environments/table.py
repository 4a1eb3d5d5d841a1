"""What our environments share: things on robosuite's table, seen by name.

`OnTable` goes before robosuite's Stack among the bases of an environment (`class Mine(OnTable, Stack)`): Stack lends
its arguments, and nothing of what it does with its two cubes is left. It is no environment itself, so that robosuite
does not list it as one.
"""

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np

from actrm_harness.wire import Array

_Stack: Any = importlib.import_module("robosuite.environments.manipulation.stack")
Stack: Any = _Stack.Stack
Objects: Any = importlib.import_module("robosuite.models.objects")
_Observables: Any = importlib.import_module("robosuite.utils.observables")

Values = dict[str, Callable[[], Array]]


class OnTable:
    """Loads, places and shows things; what they are, a subclass says."""

    # robosuite's, where Stack stands behind
    sim: Any
    robots: list[Any]
    rng: Any
    table_full_size: Any
    table_friction: Any
    table_offset: Any
    deterministic_reset: bool
    control_freq: float
    reward_scale: float | None
    use_object_obs: bool
    _ep_meta: dict[str, Any]

    demonstration: bool = False
    """Whether the next episode is to be learned from."""
    things: dict[str, Any]
    joined: bool = True
    """Whether what can be seen is given as one observation "object" too, as robosuite's tasks give it."""
    parts: frozenset[str] = frozenset()
    """The names of what can be seen."""

    def make_things(self) -> dict[str, Any]:
        """The objects, by name."""
        raise NotImplementedError

    def furnish(self, arena: Any, robot: Any) -> None:
        """Add what does not move to the scene, or something to the robot; nothing, mostly."""

    def arrange(self) -> None:
        """Draw an episode: put the things in their places, and whatever else there is to draw."""
        raise NotImplementedError

    def values(self) -> Values:
        """What can be seen of the task, by name."""
        raise NotImplementedError

    def told(self) -> Values:
        """What a policy may be told in training beside, by name; no part of "object"."""
        return {}

    def position(self, name: str) -> Array:
        """Centre of a thing."""
        return np.array(self.sim.data.body_xpos[self.body_ids[name]])

    def orientation(self, name: str) -> Array:
        """Orientation of a thing as (x, y, z, w)."""
        return np.array(self.sim.data.body_xquat[self.body_ids[name]])[[1, 2, 3, 0]]

    def hand(self) -> Array:
        """Where the grip site is."""
        return np.array(self.sim.data.site_xpos[self.robots[0].eef_site_id["right"]])

    def put(self, name: str, place: Array, turn: float) -> None:
        """Put a thing at a place, turned about the vertical."""
        pose = np.array([*place, np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
        self.sim.data.set_joint_qpos(self.things[name].joints[0], pose)

    def paint(self, geom: str, color: Any) -> None:
        """Give a geom a colour, for cameras."""
        self.sim.model.geom_rgba[self.sim.model.geom_name2id(geom)][:3] = color

    def _load_model(self) -> None:
        super(Stack, self)._load_model()  # pyright: ignore[reportUnknownMemberType, reportAttributeAccessIssue]
        robot = self.robots[0].robot_model
        robot.set_base_xpos(robot.base_xpos_offset["table"](self.table_full_size[0]))
        arena = _Stack.TableArena(
            table_full_size=self.table_full_size,
            table_friction=self.table_friction,
            table_offset=self.table_offset,
        )
        arena.set_origin([0, 0, 0])
        self.things = self.make_things()
        self.furnish(arena, robot)
        self.model = _Stack.ManipulationTask(
            mujoco_arena=arena, mujoco_robots=[robot], mujoco_objects=list(self.things.values())
        )

    def _setup_references(self) -> None:
        super(Stack, self)._setup_references()  # pyright: ignore[reportUnknownMemberType, reportAttributeAccessIssue]
        self.body_ids: dict[str, int] = {
            name: self.sim.model.body_name2id(thing.root_body) for name, thing in self.things.items()
        }

    def _reset_internal(self) -> None:
        super(Stack, self)._reset_internal()  # pyright: ignore[reportUnknownMemberType, reportAttributeAccessIssue]
        if not self.deterministic_reset:
            self.arrange()

    def _setup_observables(self) -> dict[str, Any]:
        observables: dict[str, Any] = super(Stack, self)._setup_observables()  # pyright: ignore
        if self.use_object_obs:
            for modality, values in (("object", self.values()), ("told", self.told())):
                self.parts |= frozenset(values)
                for name, read in values.items():
                    sensor = _Observables.sensor(modality=modality)(_sensor(read))
                    seen = _Observables.Observable(name=name, sensor=sensor, sampling_rate=self.control_freq)
                    observables[name] = seen
        return observables

    def visualize(self, vis_settings: dict[str, bool]) -> None:
        """Nothing of the task is drawn into the scene."""
        super(Stack, self).visualize(vis_settings={**vis_settings, "grippers": False})  # pyright: ignore


def _sensor(read: Callable[[], Array]) -> Any:
    def sense(_: dict[str, Any]) -> Array:
        return read()

    return sense
