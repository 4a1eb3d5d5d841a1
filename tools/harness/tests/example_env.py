"""An environment of one's own, as the documentation shows it: `--env-module example_env --task LiftHigh`."""

import importlib
from typing import Any

Lift: Any = importlib.import_module("robosuite").environments.manipulation.lift.Lift


class LiftHigh(Lift):
    """Lift the cube by 20 cm instead of 4."""

    def _check_success(self) -> bool:
        height = float(self.sim.data.body_xpos[self.cube_body_id][2])
        return height > float(self.model.mujoco_arena.table_offset[2]) + 0.2
