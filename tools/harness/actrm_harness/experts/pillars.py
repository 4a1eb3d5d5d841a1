"""The expert that goes around a pillar, on one side or the other."""

import numpy as np

from actrm_harness.experts.parts import DOWN, OPEN, Scene, Servo
from actrm_harness.wire import Array

# How far from the pillar's axis the hand goes around it, at least and at most.
ROUND = (0.085, 0.1)


class PillarExpert:
    """Along a tangent of a circle around the pillar, then to the goal as soon as the way is free.

    A coin, drawn once, says which side it begins with. Whoever is clearly on a side goes on there.
    """

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=0.7)
        self.side = 1.0 if rng.random() < 0.5 else -1.0
        self.round = rng.uniform(*ROUND)

    def act(self) -> Array:
        """The action for the current state."""
        hand, goal, pillar = self.scene.hand, self.scene.task.goal, self.scene.task.pillar
        return self.servo.move(np.array([*self._onward(hand[:2], goal[:2], pillar[:2]), goal[2]]), OPEN, DOWN)

    def _onward(self, hand: Array, goal: Array, pillar: Array) -> Array:
        """Where to go now, on the table's plane."""
        away = pillar - hand
        distance = float(np.linalg.norm(away))
        way = goal - hand
        length = float(np.linalg.norm(way))
        along = float(np.clip(away @ way / max(length, 1e-9), 0.0, length))
        if float(np.linalg.norm(hand + way * (along / max(length, 1e-9)) - pillar)) > self.round - 0.005:
            return goal
        # the tangent on this side; within the circle, outwards and around
        angle = self.side * float(np.arcsin(min(self.round / distance, 1.0)))
        c, s = np.cos(angle), np.sin(angle)
        tangent = np.array([c * away[0] - s * away[1], s * away[0] + c * away[1]]) / distance
        inside = max(self.round - distance, 0.0)
        return hand + 0.06 * tangent - 2.0 * inside * away / distance
