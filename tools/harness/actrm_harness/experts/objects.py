"""Experts for robosuite's tasks with other things than cubes."""

import numpy as np

from actrm_harness.experts.parts import (
    CLOSE,
    DOWN,
    OPEN,
    Carry,
    Grasp,
    Mishaps,
    Scene,
    Servo,
    about_z,
    funnel,
    hand_yaw,
    nearest,
    rotation_vector,
    yaw,
)
from actrm_harness.wire import Array


class CanExpert:
    """Take the can out of one bin and drop it into its compartment of the other.

    The middle of the compartment is out of the arm's reach; the can is dropped over its near corner. A can that a
    finger touches on the way down falls over, and few who learn from this expert pick it up again: so the fingers stay
    above it until they are around it.
    """

    PLACE = np.array([0.145, 0.355, 0.91])

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=1.4, mishaps=Mishaps(pushed=15.0))
        self.grasp = Grasp(scene, self.servo.style, tall=0.04, mouth=(0.006, 0.018))
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

    The peg is at the end of the arm's reach, so the handle has to point at the robot in the end, and the hand never
    reaches further out than it is then: a stretched elbow does not come back. The hand holds the handle either way
    round, as it was at the start or turned by half a circle in the end, whichever is the shorter way for joint 7.
    """

    # What joint 7 lets the hand turn about the vertical.
    LOWEST, HIGHEST = np.radians(-95), np.radians(200)
    FINAL = (0.0, np.pi)
    REACH = 0.185

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=1.4, turn=0.8, mishaps=Mishaps(pushed=15.0, fumbled=100.0))
        # the handle is long and thin: who waits for its very middle may wait for ever
        self.grasp = Grasp(scene, self.servo.style, tall=0.02, mouth=(0.012, 0.025), close=(0.018, 0.015))
        self.carry = Carry(scene, self.grasp, clear=rng.uniform(0.99, 1.01))
        self.final = min(self.FINAL, key=self._way)

    def act(self) -> Array:
        """The action for the current state."""
        scene = self.scene
        nut, rotation = scene.body("SquareNut_main"), scene.body_rotation("SquareNut_main")
        hand = self._hand()
        goal = np.array([*scene.body("peg1")[:2], 0.86])
        if self.carry.update(nut, goal, flat=0.01, height=0.01):
            target, grip = self.carry.let_go()
            wanted = hand
        else:
            if not self.grasp.closing:
                best = min(self.FINAL, key=self._way)
                self.final = best if self._way(best) < self._way(self.final) - 0.5 else self.final
            wanted = self._at_handle(self.final)
            target, grip = self.grasp.reach(nut + rotation @ np.array([0.054, 0.0, 0.0]), wanted - hand)
            if self.grasp.held:
                target = self.carry.bring(nut, goal, near=0.005, far=0.012)
                target[0] = min(float(target[0]), self.REACH)
                wanted = self.final + hand - nearest(self._at_handle(self.final), 2 * np.pi, hand)
        return self.servo.move(target, grip, about_z(hand + float(np.clip(wanted - hand, -1.0, 1.0))) @ DOWN)

    def _hand(self) -> float:
        return self._unwrapped(hand_yaw(self.scene.hand_rotation))

    def _at_handle(self, final: float) -> float:
        """The hand's angle on the handle that is `final` once the handle points at the robot."""
        return self._unwrapped(yaw(self.scene.body_rotation("SquareNut_main")) - np.pi + final)

    def _way(self, final: float) -> float:
        """How far the hand has to turn, to the handle and with it."""
        there = self._at_handle(final)
        far = 100.0 if there > self.HIGHEST else 0.0
        return abs(there - self._hand()) + abs(final - there) + far

    def _unwrapped(self, angle: float) -> float:
        return self.LOWEST + float((angle - self.LOWEST) % (2 * np.pi))


class DoorExpert:
    """Take the lever, turn it down with the hand, and draw the door open by it.

    The hand comes from above and in front, leaning so far that it does not touch the panel: one finger goes behind the
    lever and pulls. From then on the hand moves as if fixed to the lever. Lever and door turn about axes that can be
    seen, so the hand's pose for any two angles is known; it is led a little ahead of where they are.
    """

    LEAN = 1.15
    FREE = 1.25
    AHEAD = 0.4
    PULL = 0.2
    HINGE = np.array([0.255, 0.0, 0.0])
    CENTRE = -0.1

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=2.0, turn=1.0)
        self.along = rng.uniform(0.115, 0.13)
        self.closing = self.held = False

    def act(self) -> Array:
        """The action for the current state."""
        scene = self.scene
        data = scene.env.sim.data
        pressed = float(data.get_joint_qpos("Door_latch_joint"))
        opened = float(data.get_joint_qpos("Door_hinge"))
        place, rotation = self._pose(pressed, 0.0)
        away = place - scene.hand
        distance = float(np.linalg.norm(away))
        askew = float(np.linalg.norm(rotation_vector(rotation @ scene.hand_rotation.T)))
        if not self.closing and distance < 0.012 and askew < 0.2:
            self.closing = True
        elif self.closing and (distance > 0.06 or scene.gap < 0.03):
            self.closing = self.held = False
        if not self.closing:
            pointing = rotation[:, 2]
            aside = float(np.linalg.norm(away - pointing * (away @ pointing)))
            back = max(funnel(aside, 0.01, 0.04), funnel(askew, 0.15, 0.4))
            return self.servo.move(place - pointing * self.servo.style.hover * back, OPEN, rotation)
        self.held |= scene.gap < 0.062 and abs(scene.gap_speed) < 0.02
        if not self.held:
            return self.servo.move(place, CLOSE, rotation)
        free = funnel(pressed, self.FREE - 0.15, self.FREE) if opened < 0.03 else 1.0
        ahead = self.AHEAD if opened < 0.2 else 0.0
        place, rotation = self._pose(min(pressed + ahead, 1.5), self.PULL * free)
        return self.servo.move(place, CLOSE, rotation)

    def _pose(self, pressed: float, further: float) -> tuple[Array, Array]:
        """Position and rotation of a hand that holds the lever turned by `pressed`, the door `further` open."""
        scene = self.scene
        swing = about_z(further)
        frame, door = scene.body_rotation("Door_door"), scene.body("Door_door")
        hinge = door + frame @ self.HINGE
        axis = hinge + swing @ (scene.body("Door_latch") - hinge)
        frame = swing @ frame
        c, s = np.cos(pressed), np.sin(pressed)
        lever, top, inward = np.array([c, 0.0, -s]), np.array([s, 0.0, c]), np.array([0.0, 1.0, 0.0])
        pointing = np.sin(self.LEAN) * inward - np.cos(self.LEAN) * top
        opening = -np.cos(self.LEAN) * inward - np.sin(self.LEAN) * top
        rotation = np.stack([opening, np.cross(pointing, opening), pointing], axis=1)
        return axis + frame @ (self.along * lever + self.CENTRE * inward), frame @ rotation
