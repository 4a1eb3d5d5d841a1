"""The expert that brings a peg through a maze on the table."""

from typing import Any

import numpy as np

from actrm_harness.experts.parts import DOWN, OPEN, Scene, Servo
from actrm_harness.wire import Array

# Beside the line between two cells by more than this, the peg goes back to the middle of its own first.
ASTRAY = 0.006


class MazeExpert:
    """From cell to cell along a shortest way, found anew at every step from where the peg is."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        from actrm_harness.environments.mazes import DEPTH, MOVES, SIDE, distances

        self.scene = scene
        self.servo = Servo(scene, rng, pace=0.6)
        self.depth, self.moves, self.side = DEPTH, MOVES, SIDE
        self.away = distances(scene.task.walls, scene.task.goal)

    def act(self) -> Array:
        """The action for the current state."""
        task: Any = self.scene.task
        tip: Array = task.tip()
        here: int = task.cell_of(tip)
        middle: Array = task.center(here)
        target = middle
        onward = self._onward(here)
        if onward is not None:
            ahead: Array = task.center(onward)
            across = np.abs((tip - middle)[:2])[(np.abs((ahead - middle)[:2]) < 1e-6)]
            if float(across.max(initial=0.0)) < ASTRAY:
                target = ahead
        wanted = np.array([*target[:2], target[2] + self.depth])
        return self.servo.move(self.scene.hand + wanted - tip, OPEN, DOWN)

    def _onward(self, here: int) -> int | None:
        """The next cell of a shortest way; None at the goal."""
        row, column = divmod(here, self.side)
        for down, right in self.moves:
            if 0 <= row + down < self.side and 0 <= column + right < self.side:
                cell = here + down * self.side + right
                if 0 <= self.away[cell] < self.away[here]:
                    return cell
        return None
