"""The experts of tasks with two arms."""

import numpy as np

from actrm_harness.experts.parts import DOWN, Grasp, Scene, Servo, about_z, hand_yaw, nearest, yaw
from actrm_harness.wire import Array

# In the pot's frame, where the first arm holds its handle: one of the two bars that lead away from the pot. The second
# arm's is across the pot, so that the pot's weight is between the hands.
BAR = np.array([0.045, 0.115, 0.06])
ACROSS = np.array([-1.0, -1.0, 1.0])

# No hand is ahead of the other by more than this on the way up.
AHEAD = 0.025


class TwoArmLiftExpert:
    """Each arm takes its handle of the pot by a bar; once both hold, they lift, side by side.

    The bars need the least turn of the hands, whichever way the pot stands.
    """

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scenes = [scene, Scene(scene.env, 1, scene.shown_by)]
        self.servos = [Servo(each, rng) for each in self.scenes]
        # both at the pace of the first
        self.servos[1].style = self.servos[0].style
        self.grasps = [Grasp(each, self.servos[0].style) for each in self.scenes]
        self.bars = [BAR, BAR * ACROSS]
        self.top = rng.uniform(1.06, 1.08)

    def act(self) -> Array:
        """The action for the current state, the first arm's before the second's."""
        lifting = all(grasp.held for grasp in self.grasps)
        lowest = min(float(scene.hand[2]) for scene in self.scenes)
        actions: list[Array] = []
        for scene, servo, grasp, bar in zip(self.scenes, self.servos, self.grasps, self.bars, strict=True):
            pot, rotation = scene.body("pot_root"), scene.body_rotation("pot_root")
            hand = hand_yaw(scene.hand_rotation)
            turn = nearest(yaw(rotation) - np.pi / 2, np.pi, hand)
            target, grip = grasp.reach(pot + rotation @ bar, turn - hand)
            if lifting:
                target = np.array([*scene.hand[:2], min(self.top, lowest + AHEAD)])
                turn = hand
            actions.append(servo.move(target, grip, about_z(turn) @ DOWN))
        return np.concatenate(actions)
