"""The expert that wipes a table."""

from typing import Any

import numpy as np

from actrm_harness.experts.parts import DOWN, OPEN, Mishaps, Scene, Servo, funnel
from actrm_harness.wire import Array

# How far below the table's top the hand aims, so that the tool presses.
DEPTH = 0.02

# How near to the dirt, sideways, the tool is pressed down.
NEAR = 0.08


class WipeExpert:
    """Put the tool on the nearer end of what is left of the dirt and follow it.

    Dirt is a line of markers; one is wiped where the pressed tool passes over its middle. The expert sees every marker.
    robosuite's low-dimensional observations hold the middle and the radius of what is left; pictures show it all.
    """

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, mishaps=Mishaps(pushed=40.0))

    def act(self) -> Array:
        """The action for the current state: no fingers, six numbers."""
        hand = self.scene.hand
        left = self._left()
        if left:
            target = min((left[0], left[-1]), key=lambda end: float(np.linalg.norm((end - hand)[:2])))
            away = float(np.linalg.norm((target - hand)[:2]))
            target[2] += self.servo.style.hover * funnel(away, NEAR, 0.14)
            if away < NEAR:
                # down at a pace that does not hit the table, and then into it
                target[2] = max(float(target[2]), float(hand[2])) - DEPTH
        else:
            target = hand + np.array([0.0, 0.0, 0.05])
        return self.servo.move(target, OPEN, DOWN)[:6]

    def _left(self) -> list[Array]:
        """Where the markers lie that were not wiped yet, along the line."""
        task: Any = self.scene.task
        wiped = set(task.wiped_markers)
        return [self.scene.body(marker.root_body) for marker in task.model.mujoco_arena.markers if marker not in wiped]
