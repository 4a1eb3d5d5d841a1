"""The expert that lifts the cube which the environment asks for, among others."""

import numpy as np

from actrm_harness.experts.cubes import TABLE
from actrm_harness.experts.parts import Grasp, Scene, Servo
from actrm_harness.wire import Array


class PickExpert:
    """Reach the cube from above, close, lift. The others lie far enough away."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng)
        self.grasp = Grasp(scene, self.servo.style, mouth=(0.008, 0.025))
        self.top = TABLE + rng.uniform(0.08, 0.11)
        self.cube = f"cube{scene.task.target}_main"

    def act(self) -> Array:
        """The action for the current state."""
        target, grip = self.grasp.reach(self.scene.body(self.cube))
        if self.grasp.held:
            target = np.array([*self.scene.hand[:2], self.top])
        return self.servo.move(target, grip)
