"""Experts for robosuite's tasks with other things than cubes."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from actrm_harness.experts.cubes import CLEAR, TURNS
from actrm_harness.experts.parts import (
    CLOSE,
    DOWN,
    OPEN,
    Carry,
    Grasp,
    Mishaps,
    Misreach,
    Scene,
    Servo,
    about_z,
    funnel,
    hand_yaw,
    nearest,
    rotation_vector,
    yaw,
)
from actrm_harness.experts.skills import Slips
from actrm_harness.wire import Array


@dataclass(frozen=True, slots=True)
class Thing:
    """A thing of the bins: how it is held, and where it is let go."""

    name: str
    place: tuple[float, float, float]
    """Over its compartment; where the middle of that is out of the arm's reach, over its near corner."""
    grip: float = 0.0
    """How far above its origin it is held."""
    rise: float = 0.0
    """How much higher than the can it is carried over the walls."""
    back: float = 0.0
    """How far the hand draws back, for every metre that it rises when it leaves: a stretched elbow stays so."""
    flat: bool = False
    """Whether it is wider than the fingers open one way, so that the hand has to turn to it."""
    low: bool = False
    """Whether it lies so low that the hand, wide as it is, has to turn where the bin's wall is near."""


# The inside of the bin that things lie in, and how far the hand reaches to either side.
BIN = np.array([[-0.09, -0.49], [0.29, -0.01]])
HALF_HAND = 0.11

# From the grip site to an open finger.
FINGER = 0.055

# How far above the place where it let go the hand has left a thing, and how near to its place a thing is there.
LEFT = 0.08
ARRIVED = np.array([0.09, 0.10, 0.12])

MILK = Thing("Milk", (0.01, 0.15, 0.905), grip=0.045)
BREAD = Thing("Bread", (0.155, 0.145, 0.89), grip=0.01, low=True)
CEREAL = Thing("Cereal", (0.01, 0.37, 0.912), grip=0.04, rise=0.03, flat=True)
CAN = Thing("Can", (0.145, 0.355, 0.91))


class BinsExpert:
    """Take things out of one bin, one after the other, and drop each into its compartment of the other.

    A thing that a finger touches on the way down falls over, and few who learn from this expert pick it up again: so
    the fingers stay above it until they are around it. The hand turns for what it cannot hold any way round, and back
    while it carries: the wrist's range does not reach as far over the other bin.
    """

    THINGS: tuple[Thing, ...]

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=1.4, mishaps=Mishaps(pushed=15.0))
        self.grasp = Grasp(scene, self.servo.style, tall=0.04, mouth=(0.006, 0.018))
        clear = rng.uniform(0.99, 1.01)
        self.carries = [Carry(scene, self.grasp, clear + thing.rise) for thing in self.THINGS]
        self.at = 0

    def act(self) -> Array:
        """The action for the current state."""
        self.at = self._next()
        thing, carry = self.THINGS[self.at], self.carries[self.at]
        place, rotation = self._pose(thing)
        goal = np.array(thing.place)
        turn = 0.0
        if carry.update(place, goal, flat=0.02, height=0.02, lost=0.15):
            target, grip = carry.let_go()
            back = (self.scene.base - target)[:2]
            target[:2] += thing.back * (target[2] - self.scene.hand[2]) * back / np.linalg.norm(back)
        else:
            turn = self._turned(thing, place, rotation)
            askew = turn - hand_yaw(self.scene.hand_rotation)
            target, grip = self.grasp.reach(place + rotation @ np.array([0.0, 0.0, thing.grip]), askew)
            if self.grasp.held:
                target = carry.bring(place, goal, near=0.015, far=0.04)
                turn = 0.0
        return self.servo.move(target, grip, about_z(turn) @ DOWN)

    def _pose(self, thing: Thing) -> tuple[Array, Array]:
        body = f"{thing.name}_main"
        return self.scene.body(body), self.scene.body_rotation(body)

    def _next(self) -> int:
        """The first thing that is not in its compartment; the one at hand until the hand has left it."""
        thing, carry = self.THINGS[self.at], self.carries[self.at]
        up = float(self.scene.hand[2]) - thing.place[2] - thing.grip
        if self.grasp.closing or (carry.released and up < LEFT):
            return self.at
        out = [index for index, thing in enumerate(self.THINGS) if not self._arrived(thing)]
        return out[0] if out else self.at

    def _arrived(self, thing: Thing) -> bool:
        away = self._pose(thing)[0] - np.array(thing.place)
        return bool(np.all(np.abs(away) < ARRIVED))

    def _turned(self, thing: Thing, place: Array, rotation: Array) -> float:
        """How the hand has to be turned to take the thing; mostly not at all, which is easiest to learn."""
        if thing.flat:
            return nearest(yaw(rotation), np.pi, hand_yaw(self.scene.hand_rotation))
        others = [self._pose(other)[0] for other in self.THINGS if other != thing]
        return roomy_yaw(place, [other for other in others if BIN[1, 1] > other[1]], thing.low)


def roomy_yaw(place: Array, others: list[Array], low: bool) -> float:
    """The least turn of a hand that keeps its fingers clear of others and, at a low thing, itself inside the bin."""

    def wanting(angle: float) -> float:
        way = np.array([-np.sin(angle), np.cos(angle)])
        ends = np.array([place[:2] - HALF_HAND * way, place[:2] + HALF_HAND * way])
        outside = float(np.maximum(np.maximum(BIN[0] - ends, ends - BIN[1]), 0.0).max()) if low else 0.0
        fingers = [place[:2] + side * FINGER * way for side in (-1.0, 1.0)]
        gaps = [float(np.linalg.norm(finger - other[:2])) for finger in fingers for other in others]
        return outside + max(CLEAR - min(gaps, default=1.0), 0.0)

    # mostly there is room without a turn
    return TURNS[0] if wanting(TURNS[0]) <= 0.0 else min(TURNS, key=wanting)


class AllThingsExpert(BinsExpert):
    """All four, the tall ones first, so that the hand never reaches down between things that are taller."""

    THINGS = (replace(CEREAL, rise=0.09), MILK, replace(CAN, place=(0.14, 0.33, 0.91), back=2.0), BREAD)


class WrongTurn(Misreach):
    """The hand turned by anything, down to the thing's top."""

    ABOVE = (0.035, 0.105)
    AMISS = 1.7
    # joint 7's range, with some room
    LOWEST, HIGHEST = -1.5, 2.5


class RecoveringThingsExpert(AllThingsExpert):
    """Some reaches go wrong, which is marked, and every one is made up for.

    Most go wrong at what the hand has to turn to: at a right angle two ways to turn are as good, and policies came down
    there without turning. So the hand comes turned by anything, and shows the way on; that alone has not cured it.
    """

    # How often, for each thing: never, once, twice; then the same for what the hand has to turn to.
    MISREACHES = (0.4, 0.5, 0.1)
    WRONG_TURNS = (0.0, 0.5, 0.5)

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, rng)
        chances = [self.WRONG_TURNS if thing.flat else self.MISREACHES for thing in self.THINGS]
        self.left = [int(rng.choice(3, p=each)) for each in chances]
        self.misreaches = [(WrongTurn if thing.flat else Misreach)(scene, rng) for thing in self.THINGS]
        self.erring = False

    def act(self) -> Array:
        """The action for the current state."""
        thing, carry, misreach = self.THINGS[self.at], self.carries[self.at], self.misreaches[self.at]
        if misreach.under_way:
            self.erring = True
            bring = carry.bring(self.scene.hand, np.array(thing.place), near=0.015, far=0.04)
            target, grip, rotation = misreach.go_on(self._held_at(), bring)
            return self.servo.move(target, grip, DOWN if rotation is None else rotation)
        action = super().act()
        self.erring = self.servo.erring
        busy = self.grasp.closing or self.carries[self.at].released
        if self.left[self.at] and not busy and self.misreaches[self.at].near(self._held_at()):
            self.left[self.at] -= 1
            self.misreaches[self.at].begin()
        return action

    def _held_at(self) -> Array:
        thing = self.THINGS[self.at]
        place, rotation = self._pose(thing)
        return place + rotation @ np.array([0.0, 0.0, thing.grip])


class CanExpert(BinsExpert):
    """The can alone."""

    THINGS = (CAN,)


class MilkExpert(BinsExpert):
    """The milk alone."""

    THINGS = (MILK,)


class BreadExpert(BinsExpert):
    """The bread alone."""

    THINGS = (BREAD,)


class CerealExpert(BinsExpert):
    """The cereal alone."""

    THINGS = (CEREAL,)


class NutExpert:
    """Take the nut by its handle, turn it to the peg and lower it around it.

    The peg is at the end of the arm's reach, so the handle has to point at the robot in the end, and the hand never
    reaches further out than it is then: a stretched elbow does not come back. The hand holds the handle either way
    round, as it was at the start or turned by half a circle in the end, whichever is the shorter way for joint 7.
    """

    NUT: str
    PEG: str
    HANDLE: float
    """From the nut's middle to where it is held."""
    # What joint 7 lets the hand turn about the vertical.
    LOWEST, HIGHEST = np.radians(-95), np.radians(200)
    FINAL = (0.0, np.pi)
    REACH = 0.185

    def __init__(self, scene: Scene, rng: np.random.Generator, fumbled: float = 100.0) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=1.4, turn=0.8, mishaps=Mishaps(pushed=15.0, fumbled=fumbled))
        # the handle is long and thin: who waits for its very middle may wait for ever
        self.grasp = Grasp(scene, self.servo.style, tall=0.02, mouth=(0.012, 0.025), close=(0.018, 0.015))
        self.carry = Carry(scene, self.grasp, clear=rng.uniform(0.99, 1.01))
        self.final = min(self.FINAL, key=self._way)
        self.handle = self.HANDLE
        # what an expert that errs on purpose adds: an angle and a way to its grasp, a way to the nut's place
        self.askew = 0.0
        self.miss = np.zeros(3)
        self.beside = np.zeros(3)

    def act(self) -> Array:
        """The action for the current state."""
        scene = self.scene
        nut, rotation = scene.body(self.NUT), scene.body_rotation(self.NUT)
        hand = self._hand()
        goal = np.array([*scene.body(self.PEG)[:2], 0.86])
        if self.carry.update(nut, goal, flat=0.01, height=0.01):
            target, grip = self.carry.let_go()
            wanted = hand
        else:
            if not self.grasp.closing:
                best = min(self.FINAL, key=self._way)
                self.final = best if self._way(best) < self._way(self.final) - 0.5 else self.final
            wanted = self._at_handle(self.final) + self.askew
            held_at = nut + rotation @ np.array([self.handle, 0.0, 0.0])
            target, grip = self.grasp.reach(held_at + self.miss, wanted - hand)
            if self.grasp.held:
                handle = nearest(self._at_handle(self.final), 2 * np.pi, hand)
                target = self.carry.bring(nut, goal + self.beside, near=0.005, far=0.012, askew=self._too_askew(handle))
                target[0] = min(float(target[0]), self.REACH)
                wanted = self._turned(hand, handle)
        return self.servo.move(target, grip, about_z(hand + float(np.clip(wanted - hand, -1.0, 1.0))) @ DOWN)

    def _turned(self, hand: float, handle: float) -> float:
        """The hand's angle at which a nut that it holds, its handle at this angle now, is as it should be."""
        return self.final + hand - handle

    def _too_askew(self, handle: float) -> float:
        """Whether a nut with its handle at this angle may not go down yet: who does not err comes turned enough."""
        return 0.0

    def _hand(self) -> float:
        return self._unwrapped(hand_yaw(self.scene.hand_rotation))

    def _at_handle(self, final: float) -> float:
        """The hand's angle on the handle that is `final` once the handle points at the robot."""
        return self._unwrapped(yaw(self.scene.body_rotation(self.NUT)) - np.pi + final)

    def _way(self, final: float) -> float:
        """How far the hand has to turn, to the handle and with it."""
        there = self._at_handle(final)
        far = 100.0 if there > self.HIGHEST else 0.0
        return abs(there - self._hand()) + abs(final - there) + far

    def _unwrapped(self, angle: float) -> float:
        return self.LOWEST + float((angle - self.LOWEST) % (2 * np.pi))


class SquareExpert(NutExpert):
    """The square nut."""

    NUT, PEG, HANDLE = "SquareNut_main", "peg1", 0.054


class RecoveringSquareExpert(SquareExpert):
    """Make mistakes on the way, and show how each is made up for.

    The handle is taken anywhere along it and askew, so that where the hand is no longer says where the nut is. And the
    nut is brought down beside the peg or turned, and comes to rest on the peg's top: then it is lifted and brought
    again. What is done next follows from where the nut is, the mistakes apart, which it marks.
    """

    ALONG = (-0.006, 0.012)
    ASKEW = 0.2
    BESIDE = (0.010, 0.024)
    TURNED = 0.25
    # How often the nut is brought down wrong: never, once, twice.
    MISSES = (0.5, 0.4, 0.1)

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, rng)
        self.rng = rng
        self.misses = int(rng.choice(3, p=self.MISSES))
        self.height = 0.0
        self.resting = 0
        self.turned = 0.0
        self.erring = False
        self._draw_grasp()
        self._draw_place()

    def act(self) -> Array:
        """The action for the current state."""
        held = self.grasp.held
        action = super().act()
        self.erring = self.servo.erring or (self.grasp.held and bool(self.beside.any()))
        height = float(self.scene.body(self.NUT)[2])
        if self.grasp.held and self.misses:
            away = self.scene.body(self.NUT)[:2] - self.scene.body(self.PEG)[:2] - self.beside[:2]
            rests = abs(height - self.height) < 0.0005 and float(np.linalg.norm(away)) < 0.012
            self.resting = (self.resting + 1) * rests
            if self.resting == 4:
                self.misses -= 1
                self._draw_place()
        elif held and not self.grasp.held:
            self._draw_grasp()
        self.height = height
        return action

    def _turned(self, hand: float, handle: float) -> float:
        return hand + (self.final + self.turned - handle)

    def _too_askew(self, handle: float) -> float:
        return funnel(abs(self.final + self.turned - handle), 0.1, 0.2)

    def _draw_grasp(self) -> None:
        self.handle = self.HANDLE + self.rng.uniform(*self.ALONG)
        self.askew = self.rng.uniform(-self.ASKEW, self.ASKEW)

    def _draw_place(self) -> None:
        self.resting = 0
        angle, far = self.rng.uniform(0, 2 * np.pi), self.rng.uniform(*self.BESIDE)
        wrong = bool(self.misses)
        self.beside = np.array([far * np.cos(angle), far * np.sin(angle), 0.0]) * wrong
        self.turned = self.rng.uniform(-self.TURNED, self.TURNED) * wrong


class AmissSquareExpert(RecoveringSquareExpert):
    """Reach for a place that is not the handle, now and then, and show how that is made up for.

    The hand comes as it should, and errs only where it is near, so that little of a demonstration is marked. It is
    wrong until it is stuck, its fingers opened again, or it was long enough; then it reaches for the handle.
    """

    ASIDE: tuple[float, float]
    """How far beside the handle it reaches."""
    AMISS: float
    """How far it turns wrong."""
    NEAR: float
    """How near the handle it begins to be wrong."""
    PATIENCE: int
    """For how many steps it is wrong at most."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, rng)
        self.misreaches = self._count()
        self.missing = False
        self.before = scene.hand
        self.low = self.tried = 0

    def act(self) -> Array:
        """The action for the current state."""
        closing = self.grasp.closing
        action = super().act()
        self.erring = self.erring or self.missing
        hand = self.scene.hand
        if self.missing:
            down = not self.grasp.closing and float(hand[2]) < float(self.scene.body(self.NUT)[2]) + 0.05
            self.low = (self.low + 1) * (down and float(np.linalg.norm(hand - self.before)) < 0.0006)
            self.tried += 1
            lost = closing and not self.grasp.closing
            if self._was_held() or self.low == 4 or lost or self.tried == self.PATIENCE:
                self._reach_well()
        elif self.misreaches and not self.grasp.closing and not self.carry.released:
            handle = self.scene.body_rotation(self.NUT) @ np.array([self.HANDLE, 0.0, 0.0])
            if float(np.linalg.norm(self.scene.body(self.NUT) + handle - hand)) < self.NEAR:
                self._reach_wrong()
        self.before = hand
        return action

    def _count(self) -> int:
        """How many reaches go wrong."""
        raise NotImplementedError

    def _was_held(self) -> bool:
        """Whether what the hand holds at a wrong place was held for long enough."""
        return self.grasp.held

    def _reach_wrong(self) -> None:
        self.misreaches -= 1
        self.missing, self.low, self.tried = True, 0, 0
        angle, far = self.rng.uniform(0, 2 * np.pi), self.rng.uniform(*self.ASIDE)
        self.miss = np.array([far * np.cos(angle), far * np.sin(angle), 0.0])
        self.askew = self.rng.uniform(-self.AMISS, self.AMISS)

    def _reach_well(self) -> None:
        self.missing = False
        self.miss = np.zeros(3)
        self._draw_grasp()


class RegraspingSquareExpert(AmissSquareExpert):
    """Reach beside the handle and askew as well: come down on the nut or close on nothing, rise and reach again.

    Whoever sees the nut in pictures is often a centimetre or two beside its handle, and stays there, hand closed on
    nothing, unless it was shown the way on. At the peg, too, the hand errs only where it is near.
    """

    # How often a reach for the handle goes wrong: never, once, twice.
    MISREACHES = (0.4, 0.4, 0.2)
    ASIDE = (0.012, 0.035)
    AMISS = 0.5
    NEAR = 0.09
    NEAR_PEG = 0.05
    PATIENCE = 30

    def act(self) -> Array:
        """The action for the current state."""
        away = self.scene.body(self.NUT) - self.scene.body(self.PEG)
        near = float(np.linalg.norm(away[:2])) < self.NEAR_PEG or bool(self.beside.any())
        self.beside, self.turned = self.place if near else (np.zeros(3), 0.0)
        return super().act()

    def _count(self) -> int:
        return int(self.rng.choice(3, p=self.MISREACHES))

    def _draw_place(self) -> None:
        super()._draw_place()
        self.place = (self.beside, self.turned)
        self.beside, self.turned = np.zeros(3), 0.0


class RisingGrasp(Grasp):
    """A grasp that leaves a wrong place upwards, fingers open, before it goes on."""

    ASIDE, LOW = 0.02, 0.045
    """Farther than this beside its point and less than this above it, an open hand is in a wrong place."""

    def reach(self, point: Array, askew: float = 0.0) -> tuple[Array, float]:
        """As any grasp, but out of a wrong place straight up."""
        target, grip = super().reach(point, askew)
        away = self.scene.hand - point
        if grip == OPEN and float(np.linalg.norm(away[:2])) > self.ASIDE and float(away[2]) < self.LOW:
            return self.scene.hand + np.array([0.0, 0.0, 0.08 * funnel(self.scene.gap, 0.05, 0.07)]), OPEN
        return target, grip


class MisreachingSquareExpert(AmissSquareExpert):
    """Take hold of the nut at a wrong place, or of nothing, let go and reach again.

    Whoever sees the nut in pictures takes it for turned now and then, and holds on to its ring. So the hand comes near,
    goes down anywhere around the handle, turned by anything, and closes; the fingers open, the hand rises and reaches
    for the handle.
    """

    WRONG = 0.7
    """How often the first reach goes wrong."""
    ASIDE = (0.025, 0.11)
    AMISS = 0.8
    NEAR = 0.13
    PATIENCE = 40
    HOLDS = (2, 10)
    """For how many steps the fingers stay where they closed."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, rng)
        self.grasp = RisingGrasp(scene, self.servo.style, tall=0.02, mouth=(0.012, 0.025), close=(0.018, 0.015))
        self.carry.grasp = self.grasp
        self.holds = 0

    def _count(self) -> int:
        return int(self.rng.random() < self.WRONG)

    def _was_held(self) -> bool:
        self.holds -= self.grasp.held
        return self.holds == 0

    def _reach_wrong(self) -> None:
        rng: Any = self.rng
        self.holds = int(rng.integers(*self.HOLDS))
        super()._reach_wrong()

    def _reach_well(self) -> None:
        self.grasp.closing = self.grasp.held = False
        super()._reach_well()


class RoundExpert(NutExpert):
    """The round nut."""

    NUT, PEG, HANDLE = "RoundNut_main", "peg2", 0.06


class AllNutsExpert:
    """Both nuts, the square one first; the next is reached for once the hand is over the peg's top.

    A nut that is let fall may come to lie on its edge, its back or askew on the peg, where no hand takes it: so the
    fingers do not fumble here.
    """

    NUTS = (SquareExpert, RoundExpert)
    OVER = 0.97
    FUMBLED = math.inf

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        # both nuts at the pace of the first
        self.experts = [nut(scene, rng, self.FUMBLED) for nut in self.NUTS]
        for expert in self.experts[1:]:
            expert.servo.style = self.experts[0].servo.style
        self.at = 0

    def act(self) -> Array:
        """The action for the current state."""
        expert = self.experts[self.at]
        if not expert.grasp.closing and float(self.scene.hand[2]) > self.OVER:
            missing = [index for index, each in enumerate(self.experts) if not self._on_peg(each)]
            self.at = missing[0] if missing else self.at
        return self.experts[self.at].act()

    def _on_peg(self, expert: NutExpert) -> bool:
        away = self.scene.body(expert.NUT) - self.scene.body(expert.PEG)
        return bool(np.all(np.abs(away[:2]) < 0.03)) and float(self.scene.body(expert.NUT)[2]) < 0.87


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
        self.slips = Slips(scene.shown_by, above=0.01, beside=False)
        self.closing = self.held = False

    def act(self) -> Array:
        """The action for the current state."""
        scene = self.scene
        data = scene.env.sim.data
        pressed = float(data.get_joint_qpos("Door_latch_joint"))
        opened = float(data.get_joint_qpos("Door_hinge"))
        place, rotation = self._pose(pressed, 0.0)
        back = self.slips.back(scene.hand, rotation, scene.gap)
        if back is not None:
            return self.servo.move(back, OPEN, rotation)
        place = place + self.slips.off(rotation)
        away = place - scene.hand
        distance = float(np.linalg.norm(away))
        askew = float(np.linalg.norm(rotation_vector(rotation @ scene.hand_rotation.T)))
        if not self.closing and distance < 0.012 and askew < 0.2:
            self.closing = True
        elif self.closing and (distance > 0.06 or scene.gap < 0.03):
            self.closing = self.held = False
            self.slips.missed()
        if not self.closing:
            pointing = rotation[:, 2]
            aside = float(np.linalg.norm(away - pointing * (away @ pointing)))
            back = max(funnel(aside, 0.01, 0.04), funnel(askew, 0.15, 0.4))
            return self.servo.move(place - pointing * self.servo.style.hover * back, OPEN, rotation)
        taken = not self.held and scene.gap < 0.062 and abs(scene.gap_speed) < 0.02
        self.held |= taken
        if taken and self.slips.lets_go():
            self.closing = self.held = False
            return self.servo.move(place, OPEN, rotation)
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
