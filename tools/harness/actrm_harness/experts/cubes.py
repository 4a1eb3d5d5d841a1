"""Experts for the tasks with cubes on a table."""

import numpy as np

from actrm_harness.experts.parts import DOWN, Carry, Grasp, Mishaps, Scene, Servo, about_z, hand_yaw
from actrm_harness.wire import Array

TABLE = 0.8

# From a finger to the middle of another cube, and the turns of the hand that are tried, the least first.
CLEAR = 0.055
TURNS = tuple(np.radians(side * degrees) for degrees in range(0, 91, 6) for side in (1, -1))


# A cube that is held by two of its edges is 5.7 cm wide.
OFF = (0.062, 0.076)

# What befalls the builder of towers: how often a cube is set down beside its place, and how far.
TOWER_MISHAPS = Mishaps(pushed=80.0, fumbled=250.0)
CLUMSY = 0.12
BESIDE = (0.02, 0.032)


def clear_yaw(here: Array, others: list[Array]) -> float:
    """The least turn of a hand at a cube that keeps its fingers clear of the other cubes, whichever way the cube lies.

    Closing turns the cube between the fingers. What is asked of the hand follows from places alone, and is nothing at
    all where there is room: that is far easier to learn than a quarter turn's symmetry.
    """

    def wanting(angle: float) -> float:
        fingers = [here + about_z(angle) @ np.array([0.0, side, 0.0]) for side in (-0.055, 0.055)]
        gaps = [float(np.linalg.norm((finger - other)[:2])) for finger in fingers for other in others]
        return max(CLEAR - min(gaps, default=1.0), 0.0)

    return min(TURNS, key=wanting)


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


class StackExpert:
    """Take the small cube and put it on the large one."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=1.3, mishaps=Mishaps(pushed=15.0))
        self.grasp = Grasp(scene, self.servo.style)
        self.carry = Carry(scene, self.grasp, TABLE + rng.uniform(0.12, 0.14), OFF)

    def act(self) -> Array:
        """The action for the current state."""
        cube, below = self.scene.body("cubeA_main"), self.scene.body("cubeB_main")
        goal = below + np.array([0.0, 0.0, 0.046])
        hand = hand_yaw(self.scene.hand_rotation)
        turn = hand
        if self.carry.update(cube, goal, flat=0.012, height=0.006):
            target, grip = self.carry.let_go()
        else:
            turn = clear_yaw(cube, [below])
            target, grip = self.grasp.reach(cube, turn - hand)
            if self.grasp.held:
                target = self.carry.bring(cube, goal)
                turn = hand
        return self.servo.move(target, grip, about_z(turn) @ DOWN)


class TowerExpert:
    """Build a tower of three cubes in the order that the environment asks for.

    Little is forgiven here, so its demonstrations show how to make up for errors: the hand is pushed and its fingers
    fumble (`Mishaps`), and in some episodes a cube is set down so far beside its place that it falls, now and then
    with what it was put on.
    """

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=1.4, mishaps=TOWER_MISHAPS)
        self.grasp = Grasp(scene, self.servo.style)
        order: tuple[str, ...] = scene.task.order
        self.order = tuple(f"{name}_main" for name in order)
        rise = rng.uniform(0.12, 0.14)
        self.carries = [Carry(scene, self.grasp, TABLE + rise + 0.04 * level, OFF) for level in range(2)]
        self.level = 0
        self.above = TABLE + rise + 0.12
        self.beside = self._draw_beside(rng)

    def _draw_beside(self, rng: np.random.Generator) -> list[Array]:
        """How far beside their places the cubes are set down the first time, a level each; mostly not at all."""
        beside: list[Array] = []
        for _ in range(2):
            bad, angle, far = rng.random() < CLUMSY, rng.uniform(0, 2 * np.pi), rng.uniform(*BESIDE)
            beside.append(np.array([far * np.cos(angle), far * np.sin(angle), 0.0]) * bad)
        return beside

    def act(self) -> Array:
        """The action for the current state."""
        scene = self.scene
        bottom, middle, top = self.order
        # The hand leaves a cube before it is off to the next.
        if not self.grasp.held and self._left(middle if self.level == 0 else top):
            self.level = int(self._stands(middle, bottom))
        level = self.level
        cube, below = (top, middle) if level else (middle, bottom)
        carry = self.carries[level]
        thing, goal = scene.body(cube), scene.body(below) + np.array([0.0, 0.0, 0.041]) + self.beside[level]
        hand = hand_yaw(scene.hand_rotation)
        turn = hand
        if carry.update(thing, goal, flat=0.01, height=0.006):
            target, grip = carry.let_go()
            if scene.gap > OFF[1]:
                # from the second time on with care
                self.beside[level] = np.zeros(3)
        else:
            turn = self._grip_yaw(cube)
            target, grip = self.grasp.reach(thing, turn - hand)
            if level and not self.grasp.closing and np.linalg.norm((thing - scene.hand)[:2]) > 0.05:
                target[2] = self.above
            if self.grasp.held:
                target = carry.bring(thing, goal, near=0.008, far=0.04)
                turn = hand
        return self.servo.move(target, grip, about_z(turn) @ DOWN)

    def _stands(self, upper: str, lower: str) -> bool:
        away = self.scene.body(upper) - self.scene.body(lower)
        return bool(np.linalg.norm(away[:2]) < 0.03 and abs(float(away[2]) - 0.04) < 0.008)

    def _left(self, cube: str) -> bool:
        return float(np.linalg.norm(self.scene.hand - self.scene.body(cube))) > 0.06

    def _grip_yaw(self, cube: str) -> float:
        here = self.scene.body(cube)
        others = [self.scene.body(name) for name in self.order if name != cube]
        return clear_yaw(here, [other for other in others if float(other[2]) > float(here[2]) - 0.03])
