"""A maze on the table: a peg in the hand is to be brought from start to goal between real walls.

`TableMaze` is laid out in 8 x 8 cells, `TableMaze10` in 10 x 10, all of 3 cm. The mazes are those of the puzzle half
(`mazes.json`, which the crate `puzzles` writes): open ones of the family open8, and perfect ones of dfs10.
Demonstrations take mazes of the split `train`, evaluations of `test`: walls of one are never those of the other.

Walls are 3 cm high and hold the peg back. Whoever lifts it above them ends the episode as "lifted"; within a wall's
cell it would be "crossed". The smaller maze lies in the middle of the larger one's table, so that a cell is the same
place and the same number of the observation in both. An episode's group is how many cells its shortest way has.
"""

import importlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from actrm_harness.environments.table import OnTable, Stack, Values
from actrm_harness.simulators.robosuite.stages import Stage
from actrm_harness.wire import Array

SIDE = 10
CELL = 0.03
WALL = 0.03
DEPTH = 0.012
"""How high above the table the peg's tip is carried."""
MOVES = ((0, 1), (1, 0), (0, -1), (-1, 0))

# Below the table, where a wall is that is not there.
AWAY = -0.5

_Xml: Any = importlib.import_module("robosuite.utils.mjcf_utils")


@cache
def mazes() -> dict[str, dict[str, list[str]]]:
    """Family, split, and a text for each maze: walls, start, goal."""
    return json.loads((Path(__file__).parent / "mazes.json").read_text())


def distances(walls: Array, goal: int) -> Array:
    """How many cells each cell is from the goal; -1 where there is no way."""
    found = np.full(SIDE * SIDE, -1)
    found[goal] = 0
    queue = [goal]
    for cell in queue:
        for down, right in MOVES:
            row, column = cell // SIDE + down, cell % SIDE + right
            onward = row * SIDE + column
            if 0 <= row < SIDE and 0 <= column < SIDE and not walls[onward] and found[onward] < 0:
                found[onward] = found[cell] + 1
                queue.append(onward)
    return found


class TableMaze(OnTable, Stack):
    """Bring the peg's tip to the goal's cell."""

    family = "open8"
    walls: Array
    start: int
    goal: int

    def make_things(self) -> dict[str, Any]:
        """Nothing lies about."""
        return {}

    def furnish(self, arena: Any, robot: Any) -> None:
        """Walls in every cell, and a frame; a peg below the hand."""
        half = CELL / 2
        for cell in range(SIDE * SIDE):
            self._wall(arena, f"wall{cell}", self.center(cell), [half, half, WALL / 2])
        edge = SIDE * half + 0.005
        for k, (x, y) in enumerate(((1, 0), (-1, 0), (0, 1), (0, -1))):
            size = [0.005 if x else edge + 0.005, 0.005 if y else edge + 0.005, WALL / 2]
            self._wall(arena, f"frame{k}", np.array([x * edge, y * edge, float(self.table_offset[2])]), size)
        eef = next(body for body in robot.root.iter("body") if body.get("name", "").endswith("right_eef"))
        peg = {"type": "capsule", "fromto": "0 0 0.02 0 0 0.072", "size": "0.004", "density": "100", "group": "1"}
        eef.append(_Xml.new_geom(name="peg", rgba="0.9 0.6 0.1 1", friction="0.1 0.005 0.0001", **peg))
        eef.append(_Xml.new_site(name="peg_tip", pos="0 0 0.076", size="0.002", rgba="0 0 0 0"))

    def _wall(self, arena: Any, name: str, place: Array, size: list[float]) -> None:
        place = place + np.array([0.0, 0.0, WALL / 2])
        body = _Xml.new_body(name=name, pos=_Xml.array_to_string(place))
        look = {"type": "box", "group": "1", "rgba": "0.45 0.3 0.2 1", "friction": "0.1 0.005 0.0001"}
        body.append(_Xml.new_geom(name=f"{name}_box", size=_Xml.array_to_string(size), **look))
        arena.worldbody.append(body)

    def center(self, cell: int) -> Array:
        """The middle of a cell, on the table."""
        row, column = divmod(cell, SIDE)
        x, y = ((k - (SIDE - 1) / 2) * CELL for k in (row, column))
        return np.array([x, y, float(self.table_offset[2])])

    def cell_of(self, place: Array) -> int:
        """The cell that a place is over; the nearest one outside of the maze."""
        row, column = (int(np.clip(round(float(v) / CELL + (SIDE - 1) / 2), 0, SIDE - 1)) for v in place[:2])
        return row * SIDE + column

    def tip(self) -> Array:
        """Where the peg's tip is."""
        return np.array(self.sim.data.site_xpos[self.sim.model.site_name2id("peg_tip")])

    def _reset_internal(self) -> None:
        if not self.deterministic_reset:
            self.draw()
        super()._reset_internal()

    def draw(self) -> None:
        """Draw a maze, or take the one that the episode's description holds, and put the peg at its start."""
        given = self._ep_meta
        texts = mazes()[self.family]["train" if self.demonstration else "test"]
        text = texts[int(self.rng.integers(len(texts)))]
        if given:
            text = str(given["maze"])
        walls, start, goal = text.split()
        side = round(len(walls) ** 0.5)
        rim = (SIDE - side) // 2
        inner = np.array([int(wall) for wall in walls]).reshape(side, side)
        self.walls = np.pad(inner, rim, constant_values=1).ravel()
        self.start, self.goal = ((int(cell) // side + rim) * SIDE + int(cell) % side + rim for cell in (start, goal))
        length = int(distances(self.walls, self.goal)[self.start])
        down, right = (abs(a - b) for a, b in zip(divmod(self.start, SIDE), divmod(self.goal, SIDE), strict=True))
        group = next(f"{low:02}-{low + 4:02} cells" for low in range(1, 100, 5) if length < low + 5)
        self._ep_meta = {"maze": text, "cells": length, "detour": length - down - right, "group": group}
        self.robots[0].init_qpos = self._reach(self.center(self.start) + np.array([0.0, 0.0, DEPTH]))

    def arrange(self) -> None:
        """Raise the walls that are there."""
        height = float(self.table_offset[2]) + WALL / 2
        for cell in range(SIDE * SIDE):
            body = self.sim.model.body_name2id(f"wall{cell}")
            self.sim.model.body_pos[body][2] = height if self.walls[cell] else AWAY

    def _reach(self, tip: Array) -> Array:
        """Joint angles with the peg's tip at a place, the hand pointing down: Newton steps, damped."""
        mujoco: Any = importlib.import_module("mujoco")
        model: Any = self.sim.model._model
        data = mujoco.MjData(model)
        robot: Any = self.robots[0].robot_model
        joints = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in robot.joints[:7]]
        places, columns = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "peg_tip")
        down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        angles = np.array(robot.init_qpos, dtype=np.float64)
        jacobian = np.zeros((6, model.nv))
        for _ in range(40):
            data.qpos[places] = angles
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
            rotation = data.site_xmat[site].reshape(3, 3)
            turn = 0.5 * np.sum(np.cross(rotation.T, down.T), axis=0)
            error = np.concatenate([tip - data.site_xpos[site], turn])
            own = jacobian[:, columns]
            angles = angles + own.T @ np.linalg.solve(own @ own.T + 1e-6 * np.eye(6), error)
            if float(np.abs(error).max()) < 1e-9:
                break
        return angles

    def reward(self, action: Array | None = None) -> float:
        """One at the goal."""
        del action
        return float(self._check_success()) * (1.0 if self.reward_scale is None else self.reward_scale)

    def _check_success(self) -> bool:
        away = np.abs((self.tip() - self.center(self.goal))[:2])
        return bool(np.all(away < CELL / 2 - 0.003)) and self.failure() is None

    def stages(self) -> list[Stage]:
        """A quarter, half and three quarters of the way."""
        away = distances(self.walls, self.goal)
        whole = float(away[self.start])

        def come(share: float) -> Stage:
            # the walls have no distance: nothing is come there
            return f"{share:.0%} of the way", lambda: 0 <= away[self.cell_of(self.tip())] <= (1.0 - share) * whole

        return [come(0.25), come(0.5), come(0.75)]

    def failure(self) -> str | None:
        """Why it is lost: "lifted" above the walls, or "crossed" into one."""
        tip = self.tip()
        if tip[2] - float(self.table_offset[2]) > WALL:
            return "lifted"
        return "crossed" if self.walls[self.cell_of(tip)] else None

    def values(self) -> Values:
        """Walls and goal cell by cell, 10 x 10 from the robot outwards; where the tip is, also in its own cell."""
        return {
            "maze_walls": lambda: self.walls.astype(np.float64),
            "maze_goal": lambda: np.eye(SIDE * SIDE)[self.goal],
            "peg_cell": lambda: np.eye(SIDE * SIDE)[self.cell_of(self.tip())],
            "peg_pos": self.tip,
            "goal_pos": lambda: self.center(self.goal),
            "peg_to_goal": lambda: self.center(self.goal) - self.tip(),
            "peg_in_cell": lambda: (self.tip() - self.center(self.cell_of(self.tip())))[:2],
        }


class TableMaze10(TableMaze):
    """The same in perfect mazes of 10 x 10 cells."""

    family = "dfs10"
