"""Experts for robosuite's tasks with other things than cubes."""

import numpy as np

from actrm_harness.experts import CLOSE, DOWN, Carry, Grasp, Scene, Servo, about_z, funnel, hand_yaw, nearest, yaw
from actrm_harness.wire import Array


class CanExpert:
    """Take the can out of one bin and drop it into its compartment of the other.

    The middle of the compartment is out of the arm's reach; the can is dropped over its near corner.
    """

    PLACE = np.array([0.145, 0.355, 0.91])

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=1.4)
        self.grasp = Grasp(scene, self.servo.style)
        self.carry = Carry(scene, self.grasp, clear=rng.uniform(0.99, 1.01))

    def act(self) -> Array:
        """The action for the current state."""
        can = self.scene.body("Can_main")
        goal = self.PLACE
        if self.carry.update(can, goal, flat=0.02, height=0.02, lost=0.15):
            target, grip = self.carry.let_go()
        else:
            target, grip = self.grasp.reach(can)
            if self.grasp.held:
                target = self.carry.bring(can, goal, near=0.015, far=0.04)
        return self.servo.move(target, grip, DOWN)


class SquareExpert:
    """Take the square nut by its handle, turn it to the peg and lower it around it.

    The peg is at the end of the arm's reach, so the handle has to point at the robot in the end, and the hand is then
    as it was at the start. Joint 7 lets the hand turn from about -120 to 210 degrees about the vertical; a handle just
    outside of that is taken a little askew and straightens as the fingers close.
    """

    LOWEST, HIGHEST = np.radians(-110), np.radians(205)

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=1.4)
        self.grasp = Grasp(scene, self.servo.style)
        self.carry = Carry(scene, self.grasp, clear=rng.uniform(0.99, 1.01))

    def act(self) -> Array:
        """The action for the current state."""
        scene = self.scene
        nut, rotation = scene.body("SquareNut_main"), scene.body_rotation("SquareNut_main")
        hand = self._unwrapped(hand_yaw(scene.hand_rotation))
        goal = np.array([*scene.body("peg1")[:2], 0.86])
        if self.carry.update(nut, goal, flat=0.01, height=0.01):
            target, grip = self.carry.let_go()
            wanted = hand
        else:
            wanted = min(self._unwrapped(yaw(rotation) - np.pi), self.HIGHEST)
            target, grip = self.grasp.reach(nut + rotation @ np.array([0.054, 0.0, 0.0]), wanted - hand)
            if self.grasp.held:
                target = self.carry.bring(nut, goal, near=0.005, far=0.012)
                wanted = hand + nearest(np.pi - yaw(rotation), 2 * np.pi, -hand)
        return self.servo.move(target, grip, about_z(hand + float(np.clip(wanted - hand, -1.0, 1.0))) @ DOWN)

    def _unwrapped(self, angle: float) -> float:
        return self.LOWEST + float((angle - self.LOWEST) % (2 * np.pi))


class DoorExpert:
    """Press the lever down from above with closed fingers, and draw the door open by what they press on.

    There is no room for the hand's width between the door's panel and the lever's far side, so the hand is turned
    along the door, and friction does the pulling: the lever's spring wants some 10 N, the door 3 N. Lever and door turn
    about axes that can be seen; the hand is led along the arc that the touched
    point would follow, a little ahead of it.
    """

    TOP = 0.02
    SIDE = -0.088

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=2.0)
        self.along = rng.uniform(0.12, 0.135)

    def act(self) -> Array:
        """The action for the current state."""
        scene, style = self.scene, self.servo.style
        data = scene.env.sim.data
        axis, door = scene.body("Door_latch"), scene.body_rotation("Door_door")
        pressed = float(data.get_joint_qpos("Door_latch_joint"))
        opened = float(data.get_joint_qpos("Door_hinge"))
        touched = axis + door @ self._on_lever(pressed)
        away = touched - scene.hand
        flat = float(np.linalg.norm(away[:2]))
        off = funnel(flat, 0.02, 0.05)
        target = touched + np.array([0.0, 0.0, style.hover * off])
        if pressed > 0.08 or (off == 0.0 and abs(float(away[2])) < 0.03):
            # Along the arc, a little towards the middle of the lever, and back with the door once the bolt is out.
            c, s = np.cos(pressed), np.sin(pressed)
            reached = float((door.T @ (scene.hand - axis)) @ np.array([c, 0.0, -s]))
            out = float(np.clip(self.along - reached, -0.02, 0.02))
            free = funnel(pressed, 1.0, 1.25) if opened < 0.02 else 1.0
            push = 0.08 - 0.02 * free
            side = (self.SIDE - float((door.T @ (scene.hand - axis))[1])) * (1.0 - free)
            target = scene.hand + door @ np.array([out * c - push * s, side, -out * s - push * c])
            hinge = scene.body("Door_door") + door @ np.array([0.255, 0.0, 0.0])
            lead = 0.06 + 0.12 * funnel(opened, 0.02, 0.06)
            target = target + free * (about_z(lead) @ (scene.hand - hinge) - (scene.hand - hinge))
        return self.servo.move(target, CLOSE, about_z(nearest(yaw(door), np.pi, 0.0) + np.pi / 2) @ DOWN)

    def _on_lever(self, angle: float) -> Array:
        """The touched point of the lever in the door's frame, when the lever is pressed by `angle`."""
        c, s = np.cos(angle), np.sin(angle)
        return np.array([self.along * c + self.TOP * s, self.SIDE, self.TOP * c - self.along * s])
