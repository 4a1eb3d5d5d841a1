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

# The same where recoveries are to be shown: some stay where they are, askew; and how often the tower is knocked down.
SLOPPY = 0.3
BESIDE_OR_FALLEN = (0.008, 0.032)
KNOCKING = 0.25


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
        # how far beside a cube it reaches
        self.miss = np.zeros(3)

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
            target, grip = self.grasp.reach(thing + self.miss, turn - hand)
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


class MisreachingTowerExpert(TowerExpert):
    """Build the tower; once near, half of the reaches go wrong: the hand comes down beside the cube, and reaches again.

    What is wrong is marked from there on only, so that every reach shows the way to its cube, and how a hand that came
    down in the wrong place, on nothing or on another cube, finds back.
    """

    NEAR = 0.13
    MISSING = 0.5
    ASIDE = (0.012, 0.08)
    PATIENCE = 45
    """For how many steps a reach is wrong at most: a hand may push a cube before it, or hang on one."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, rng)
        self.rng = rng
        self.rest = Rest(scene)
        self.reached = 0
        self.tried = 0
        self.erring = False

    def act(self) -> Array:
        """The action for the current state."""
        closing, missing = self.grasp.closing, bool(self.miss.any())
        action = super().act()
        self.erring = self.servo.erring or missing
        away = self.scene.body(self.order[1 + self.level]) - self.scene.hand
        if self.reached == self.level and not self.grasp.held and float(np.linalg.norm(away)) < self.NEAR:
            self.reached += 1
            self.tried = 0
            angle, far = self.rng.uniform(0, 2 * np.pi), self.rng.uniform(*self.ASIDE)
            far *= self.rng.random() < self.MISSING
            self.miss = np.array([far * np.cos(angle), far * np.sin(angle), 0.0])
        self.tried += 1
        there = self.rest.reached(self.grasp) or self.grasp.held or (closing and not self.grasp.closing)
        if there or self.tried > self.PATIENCE:
            self.miss = np.zeros(3)
        return action


class Rest:
    """Tells when a hand that goes down with open fingers is stuck on something."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.before = scene.hand
        self.steps = 0

    def reached(self, grasp: Grasp) -> bool:
        """Whether it has been stuck for four steps, asked once a step."""
        hand = self.scene.hand
        low = float(hand[2]) < TABLE + 0.07 and not grasp.closing
        self.steps = (self.steps + 1) * (low and float(np.linalg.norm(hand - self.before)) < 0.0006)
        self.before = hand
        return self.steps == 4


class RecoveringTowerExpert(TowerExpert):
    """Build the tower, make more mistakes on the way, and show how each is made up for.

    Cubes are set down a little or far beside their places, the one that is held knocks down what stands already, and
    whatever lies on a cube that is needed is put aside on the table first. What nothing was done to is set down with
    more care than `TowerExpert` takes. Held cube or none, what is done next follows from where the cubes are.
    """

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, rng)
        self.aside = Carry(scene, self.grasp, self.above - 0.06, OFF)
        self.knocks = bool(rng.random() < KNOCKING)
        self.cube = self.order[1]
        self.spot: Array | None = None
        self.leaving = False
        # whether it is about to do wrong on purpose
        self.wrong = False

    def _draw_beside(self, rng: np.random.Generator) -> list[Array]:
        beside: list[Array] = []
        for _ in range(2):
            bad, angle, far = rng.random() < SLOPPY, rng.uniform(0, 2 * np.pi), rng.uniform(*BESIDE_OR_FALLEN)
            beside.append(np.array([far * np.cos(angle), far * np.sin(angle), 0.0]) * bad)
        return beside

    def act(self) -> Array:
        """The action for the current state."""
        scene = self.scene
        bottom, middle, _ = self.order
        stands = self._stands(middle, bottom)
        self._choose(stands)
        thing = scene.body(self.cube)
        carry, goal, level = self._job(stands)
        beside = level is not None and bool(self.beside[level].any())
        hand = hand_yaw(scene.hand_rotation)
        turn = hand
        if carry.update(thing, goal, flat=0.006, height=0.006):
            target, grip = carry.let_go()
            self.leaving = True
            if level is not None and scene.gap > OFF[1]:
                self.beside[level] = np.zeros(3)
        else:
            turn = self._grip_yaw(self.cube)
            target, grip = self.grasp.reach(thing + self.miss, turn - hand)
            if stands and not self.grasp.closing and np.linalg.norm((thing - scene.hand)[:2]) > 0.05:
                target[2] = self.above
            if self.grasp.held:
                target = carry.bring(thing, goal, near=0.006, far=0.04)
                turn = hand
                if level == 1 and self.knocks:
                    # sideways against what stands
                    target = scene.hand + (scene.body(middle) - thing) * (1.0 if thing[2] > TABLE + 0.05 else 0.0)
                    target[2] += 0.05 * float(thing[2] < TABLE + 0.055)
        carrying = self.grasp.held or carry.released
        self.wrong = beside or (level == 1 and self.knocks) if carrying else bool(self.miss.any())
        return self.servo.move(target, grip, about_z(turn) @ DOWN)

    def _choose(self, stands: bool) -> None:
        """Which cube is next, and where to put it aside if its place is not ready."""
        bottom, middle, top = self.order
        if not stands:
            self.knocks &= self.cube != top or not self.grasp.held
        if self.grasp.held or (self.leaving and not self._left(self.cube)):
            # in the hand while its place was lost
            if self.grasp.held and self.cube == top and not stands and self.spot is None:
                self.spot = self._free_spot()
            return
        self.leaving = False
        lying = [cube for cube in (top, bottom) if any(self._lies_on(cube, other) for other in self.order)]
        if stands:
            chosen, self.spot = top, None
        elif lying:
            chosen = lying[0]
            self.spot = self._free_spot() if chosen != self.cube or self.spot is None else self.spot
        else:
            chosen, self.spot = middle, None
        if chosen != self.cube:
            self.cube = chosen
            for carry in (*self.carries, self.aside):
                carry.released = False

    def _job(self, stands: bool) -> tuple[Carry, Array, int | None]:
        """How the chosen cube is carried, where to, and on which level of the tower if on any."""
        bottom, middle, top = self.order
        if self.spot is not None:
            return self.aside, self.spot, None
        level = int(self.cube == top and stands)
        below = self.scene.body(middle if level else bottom)
        return self.carries[level], below + np.array([0.0, 0.0, 0.041]) + self.beside[level], level

    def _lies_on(self, cube: str, other: str) -> bool:
        """Whether a cube lies on another or leans on it."""
        away = self.scene.body(cube) - self.scene.body(other)
        return cube != other and bool(np.linalg.norm(away[:2]) < 0.045 and float(away[2]) > 0.012)

    def _free_spot(self) -> Array:
        """The place on the table that is nearest to the chosen cube and away from the others."""
        here = self.scene.body(self.cube)
        others = [self.scene.body(name) for name in self.order if name != self.cube]
        steps = np.linspace(-0.1, 0.1, 9)
        places = [np.array([x, y, TABLE + 0.021]) for x in steps for y in steps]
        free = [p for p in places if min(float(np.linalg.norm((p - other)[:2])) for other in others) > 0.085]
        return min(free, key=lambda p: float(np.linalg.norm((p - here)[:2])))


class RegraspingTowerExpert(RecoveringTowerExpert):
    """Reach beside cubes as well: come to rest on a neighbour, or close on nothing, then rise and reach again.

    Cubes that fell lie close together, and a hand that comes down a little beside one stands on another and is stuck
    there for ever, unless it was shown that the way on leads up. What it does wrong it marks.
    """

    MISSING = 0.5
    ASIDE = (0.012, 0.04)

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, rng)
        self.rng = rng
        self.reached = ""
        self.rest = Rest(scene)
        self.erring = False

    def act(self) -> Array:
        """The action for the current state."""
        closing = self.grasp.closing
        action = super().act()
        self.erring = self.servo.erring or self.wrong
        if self.cube != self.reached:
            self.reached = self.cube
            self._draw_miss()
        if self.rest.reached(self.grasp) or self.grasp.held or (closing and not self.grasp.closing):
            self.miss = np.zeros(3)
        return action

    def _draw_miss(self) -> None:
        """Towards another cube as often as anywhere."""
        here = self.scene.body(self.cube)
        others = [self.scene.body(name) - here for name in self.order if name != self.cube]
        away = min(others, key=lambda other: float(np.linalg.norm(other[:2])))
        angle = self.rng.uniform(0, 2 * np.pi)
        if self.rng.random() < 0.5:
            angle = float(np.arctan2(away[1], away[0]))
        far = self.rng.uniform(*self.ASIDE) * (self.rng.random() < self.MISSING)
        self.miss = np.array([far * np.cos(angle), far * np.sin(angle), 0.0])
