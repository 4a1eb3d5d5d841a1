"""Experts for the tasks with cubes on a table."""

import numpy as np

from actrm_harness.experts import Grasp, Scene, Servo
from actrm_harness.wire import Array

TABLE = 0.8


class LiftExpert:
    """Reach the cube from above, close, lift."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng)
        self.grasp = Grasp(scene, self.servo.style)
        self.top = TABLE + rng.uniform(0.10, 0.13)

    def act(self) -> Array:
        """The action for the current state."""
        cube = self.scene.body("cube_main")
        target, grip = self.grasp.reach(cube)
        if self.grasp.held:
            target = np.array([*self.scene.hand[:2], self.top])
        return self.servo.move(target, grip)
