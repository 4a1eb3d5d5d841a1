"""Lift the cube by 20 cm instead of 4: `--env-module example_env --task LiftHigh`."""

import importlib
from typing import Any

import numpy as np

from actrm_harness.experts.cubes import LiftExpert
from actrm_harness.experts.parts import Scene
from actrm_harness.tasks import Task, register

Lift: Any = importlib.import_module("robosuite").environments.manipulation.lift.Lift


class LiftHigh(Lift):
    """robosuite registers every environment class by its name as soon as it is defined."""

    def _check_success(self) -> bool:
        height = float(self.sim.data.body_xpos[self.cube_body_id][2])
        return height > float(self.model.mujoco_arena.table_offset[2]) + 0.2

    def get_ep_meta(self) -> dict[str, Any]:
        """Optional: the part of an evaluation's report that this episode belongs to."""
        left = float(self.sim.data.body_xpos[self.cube_body_id][1]) < 0.0
        return {"group": "left" if left else "right"}


class HighExpert(LiftExpert):
    """Optional: an expert, so that demonstrations can be collected."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, rng)
        self.top += 0.15


register(Task("LiftHigh", expert=HighExpert))
