"""What the scripted experts share: the view of the scene, the servo and the variety.

An expert is closed-loop: every action follows from what can be observed now, so that it recovers from a push, and so
that a policy which sees the same observations can learn it. Episodes differ by a `Style` drawn once (speed, height and
side of the approach), by correlated noise on the command, by pushes of a few steps that it has to make up for, and by
who shows them (`skills`).
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from actrm_harness.experts.skills import SKILLS, USUAL, Demonstrator, Manner, Slips
from actrm_harness.simulators.robosuite.suite import Env
from actrm_harness.wire import Array

# OSC_POSE: an action of 1 asks for 5 cm or 0.5 rad.
METRES_PER_UNIT = 0.05
RADIANS_PER_UNIT = 0.5

OPEN, CLOSE = -1.0, 1.0

# The hand pointing straight down, its fingers opening along the world's y axis.
DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class Expert(Protocol):
    """A scripted controller for one episode."""

    def act(self) -> Array:
        """The action for the current state, before it is clipped to +-1."""
        ...


@runtime_checkable
class Marking(Protocol):
    """An expert that says whether the action it gave last is a mistake: to be made up for, not to be learned."""

    erring: bool


@dataclass(frozen=True, slots=True)
class Style:
    """How this episode's expert moves."""

    gain: float
    speed: float
    hover: float
    side: Array
    noise: float

    @staticmethod
    def draw(rng: np.random.Generator) -> "Style":
        """A style near the middle of what still works well."""
        return Style(
            gain=rng.uniform(0.75, 1.0),
            speed=rng.uniform(0.45, 0.75),
            hover=rng.uniform(0.05, 0.10),
            side=rng.uniform(-0.012, 0.012, size=2),
            noise=rng.uniform(0.01, 0.05),
        )

    def of(self, demonstrator: Demonstrator) -> "Style":
        """What this style becomes in the hands of a demonstrator."""
        return replace(self, speed=self.speed * demonstrator.speed, hover=self.hover * demonstrator.height)


PADS_MEET = 0.0126
"""Metres between the middles of the pads of a closed Robotiq gripper."""


class Scene:
    """What an expert may look at: gripper, fingers and named bodies, in world coordinates.

    `robot` says whose gripper and fingers, where there are several; `shown_by` who moves them, a good demonstrator
    unless somebody else is named.
    """

    def __init__(self, env: Env, robot: int = 0, shown_by: Demonstrator | None = None) -> None:
        self.env = env
        self.shown_by = shown_by or Demonstrator(SKILLS[USUAL], np.random.default_rng(0))
        self._robot: Any = env.robots[robot]
        self._site = int(self._robot.eef_site_id["right"])
        self._fingers: list[int] = list(self._robot._ref_gripper_joint_pos_indexes["right"] or [])
        self._finger_speeds: list[int] = list(self._robot._ref_gripper_joint_vel_indexes["right"] or [])
        # of a gripper whose fingers turn, the distance is that of their pads
        gripper = self._robot.gripper["right"] if len(self._fingers) > 2 else None
        geoms: dict[str, list[str]] = gripper.important_geoms if gripper else {}
        self._pads = [geoms.get(f"{side}_fingerpad", []) for side in ("left", "right")]

    @property
    def task(self) -> Any:
        """The environment, for what only an environment of our own can say."""
        return self.env

    @property
    def hand(self) -> Array:
        """Position of the grip site."""
        return np.array(self.env.sim.data.site_xpos[self._site])

    @property
    def hand_rotation(self) -> Array:
        """Rotation matrix of the grip site."""
        return np.array(self.env.sim.data.site_xmat[self._site]).reshape(3, 3)

    @property
    def base(self) -> Array:
        """Position of the robot's base."""
        return np.array(self._robot.base_pos)

    @property
    def base_rotation(self) -> Array:
        """Rotation matrix of the robot's base: what an action asks for is as the robot sees it."""
        return np.array(self._robot.base_ori)

    @property
    def gap(self) -> float:
        """Distance between the finger tips in metres (0.08 when open)."""
        if len(self._fingers) != 2:
            left, right = (self._pad(side)[0] for side in self._pads)
            return max(0.0, float(np.linalg.norm(left - right)) - PADS_MEET)
        left, right = self.env.sim.data.qpos[self._fingers]
        return float(left - right)

    @property
    def gap_speed(self) -> float:
        """How fast the fingers open (positive) or close, in metres a second."""
        if len(self._fingers) != 2:
            (left, left_speed), (right, right_speed) = (self._pad(side) for side in self._pads)
            apart = left - right
            return float((left_speed - right_speed) @ apart / max(1e-9, float(np.linalg.norm(apart))))
        left, right = self.env.sim.data.qvel[self._finger_speeds]
        return float(left - right)

    def _pad(self, geoms: list[str]) -> tuple[Array, Array]:
        """Position and velocity of a finger's pad."""
        model, data = self.env.sim.model, self.env.sim.data
        places = [data.geom_xpos[model.geom_name2id(name)] for name in geoms]
        return np.mean(places, axis=0), np.mean([data.get_geom_xvelp(name) for name in geoms], axis=0)

    def body(self, name: str) -> Array:
        """Position of a body."""
        return np.array(self.env.sim.data.body_xpos[self.env.sim.model.body_name2id(name)])

    def body_rotation(self, name: str) -> Array:
        """Rotation matrix of a body."""
        return np.array(self.env.sim.data.body_xmat[self.env.sim.model.body_name2id(name)]).reshape(3, 3)


@dataclass(frozen=True, slots=True)
class Mishaps:
    """What befalls an expert, each every so many steps on average; more, the slower who shows it.

    A push moves the hand for three steps. A fumble makes the fingers do the opposite of what they should for 4 to 13:
    a thing is lost, or they close on nothing. What the expert does to make up for them is what a policy learns from to
    make up for errors of its own, where little is forgiven.
    """

    pushed: float = math.inf
    """Infinite: one push an episode."""
    fumbled: float = math.inf


ONE_PUSH = Mishaps()


class Servo:
    """Turns a target pose of the hand into an action, with this episode's style, noise, mishaps and demonstrator."""

    def __init__(
        self,
        scene: Scene,
        rng: np.random.Generator,
        pace: float = 1.0,
        turn: float = 0.5,
        mishaps: Mishaps = ONE_PUSH,
    ) -> None:
        self.scene = scene
        self.style = Style.draw(rng).of(scene.shown_by)
        self.manner = Manner(scene.shown_by)
        self.pace = pace
        self.turn = turn * scene.shown_by.speed
        self.upright = about_z(scene.shown_by.askew) @ scene.hand_rotation
        self._rng = rng
        self._noise = np.zeros(6)
        self._time = 0
        # whether the last action was a push or a fumble
        self.erring = False
        self._pushed = mishaps.pushed * scene.shown_by.slowness
        self._push_at: int = 3 + int(37 * rng.random())
        self._push = self._draw_push()
        self._fumbled = mishaps.fumbled * scene.shown_by.slowness
        self._fumble: tuple[int, int] = self._draw_fumble()

    def _draw_fumble(self) -> tuple[int, int]:
        """The steps between which the fingers do the opposite next."""
        if not math.isfinite(self._fumbled):
            return (-1, -1)
        begin = self._time + int(2 * self._fumbled * self._rng.random())
        return begin, begin + 4 + int(10 * self._rng.random())

    def _draw_push(self) -> Array:
        push = self._rng.normal(size=3)
        return push * (self._rng.uniform(0.2, 0.6) / np.linalg.norm(push))

    def move(self, target: Array, grip: float, rotation: Array | None = None) -> Array:
        """A step towards `target` (and `rotation`, else as the hand was at the start)."""
        style = self.style
        target = self.manner.onward(self.scene.hand, target, grip, self.scene.base)
        haste = self.manner.haste()
        fastest = style.speed * self.pace
        wanted = limit((target - self.scene.hand) / METRES_PER_UNIT * style.gain, fastest) * haste
        noise = style.noise * self.manner.tremble(float(np.linalg.norm(wanted)) / fastest)
        goal = self.upright if rotation is None else rotation
        turn = limit(rotation_vector(goal @ self.scene.hand_rotation.T) / RADIANS_PER_UNIT, self.turn) * haste
        self._noise = 0.7 * self._noise + self._rng.normal(size=6) * noise * np.repeat([1.0, 0.3], 3)
        self.erring = self._push_at <= self._time < self._push_at + 3
        if self.erring:
            wanted = wanted + self._push
        elif self._time == self._push_at + 3 and math.isfinite(self._pushed):
            self._push_at += 4 + int(2 * (self._pushed - 4) * self._rng.random())
            self._push = self._draw_push()
        if self._fumble[0] <= self._time < self._fumble[1]:
            grip, self.erring = -grip, True
        elif self._time == self._fumble[1]:
            self._fumble = self._draw_fumble()
        self._time += 1
        own = self.scene.base_rotation.T
        return np.concatenate([np.concatenate([own @ wanted, own @ turn]) + self._noise, [grip]])


def limit(vector: Array, length: float) -> Array:
    """The vector, shortened to `length` where it is longer."""
    norm = float(np.linalg.norm(vector))
    return vector if norm <= length else vector * (length / norm)


def rotation_vector(matrix: Array) -> Array:
    """Axis times angle of a rotation matrix (of any angle below pi)."""
    axis = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    sine = float(np.linalg.norm(axis)) / 2
    cosine = (float(np.trace(matrix)) - 1) / 2
    if sine < 1e-9:
        return axis / 2
    return axis / (2 * sine) * float(np.arctan2(sine, cosine))


def about(vector: Array) -> Array:
    """Rotation matrix of an axis times an angle: what `rotation_vector` reads."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-9:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def about_z(angle: float) -> Array:
    """Rotation matrix about the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw(rotation: Array) -> float:
    """Angle about the vertical of a body that lies flat."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def hand_yaw(rotation: Array) -> float:
    """Angle about the vertical of a hand that points down; 0 for `DOWN`."""
    return yaw(rotation @ DOWN.T)


def nearest(angle: float, period: float, reference: float) -> float:
    """The angle equal to `angle` up to a multiple of `period` that is nearest to `reference`."""
    return angle + period * round((reference - angle) / period)


def funnel(distance: float, near: float, far: float) -> float:
    """0 within `near`, 1 beyond `far`, straight in between."""
    return float(np.clip((distance - near) / (far - near), 0.0, 1.0))


class Grasp:
    """Reaching for a thing and holding it: where to go, and what the fingers do.

    `held` is read off the fingers: they were told to close, have stopped, and stopped before they met. `tall` is how
    far the thing stands up above the point that is gripped: the hand comes from that much higher, and goes down only
    where it is beside the thing by less than `mouth` (down to the first, down not at all from the second on). Within
    `close` of the point, sideways and in height, the fingers close.
    """

    THINNEST, WIDEST = 0.01, 0.07
    # Where a hand that cannot get to a point beside the thing gives up.
    NEAR = 0.05

    def __init__(
        self,
        scene: Scene,
        style: Style,
        tall: float = 0.0,
        mouth: tuple[float, float] = (0.008, 0.03),
        close: tuple[float, float] = (0.01, 0.012),
    ) -> None:
        self.scene = scene
        self.style = style
        # what is tall falls over where fingers touch it: a hand that misses it closes above
        self.slips = Slips(scene.shown_by, tall, beside=tall == 0.0)
        self.close = close
        self.hover = style.hover + tall
        self.mouth = mouth
        self.closing = False
        self.held = False

    def reach(self, point: Array, askew: float = 0.0) -> tuple[Array, float]:
        """Where the hand should go now to have `point` between its fingers, and what the fingers do.

        `askew` is the angle by which the hand still has to turn; it stays above until that is small.
        """
        hand, rotation = self.scene.hand, self.scene.hand_rotation
        back = self.slips.back(hand, rotation, self.scene.gap)
        if back is not None:
            return back, OPEN
        point = point + self.slips.off(rotation)
        offset = point - hand
        flat, height = float(np.linalg.norm(offset[:2])), abs(float(offset[2]))
        if not self.closing and flat < self.close[0] and height < self.close[1]:
            self.closing = True
        elif self.closing and (flat > 0.035 or height > 0.035 or self.scene.gap < self.THINNEST):
            self.closing = self.held = False
            if self.scene.gap < self.THINNEST:
                self.slips.missed()
        elif not self.closing and max(flat, height) < self.NEAR:
            self.slips.near()
        gap = self.scene.gap
        if self.closing and self.THINNEST < gap < self.WIDEST and abs(self.scene.gap_speed) < 0.01:
            self.held, taken = True, not self.held
            if taken and self.slips.lets_go():
                self.closing = self.held = False
        target = np.array(point)
        if not self.closing:
            lift = max(funnel(flat, *self.mouth), funnel(abs(askew), 0.15, 0.4))
            target[2] += self.hover * lift
            target[:2] += self.style.side * lift
        return target, CLOSE if self.closing else OPEN


class Carry:
    """Bringing a held thing to a place, over what stands in between, and letting go of it there.

    `off` is how far the fingers are open when they begin to be off it, and when they are.
    """

    def __init__(self, scene: Scene, grasp: Grasp, clear: float, off: tuple[float, float] = (0.05, 0.07)) -> None:
        self.scene = scene
        self.grasp = grasp
        self.clear = clear
        self.off = off
        self.released = False

    def bring(self, thing: Array, goal: Array, near: float = 0.012, far: float = 0.06, askew: float = 0.0) -> Array:
        """Where the hand should go to take `thing` to `goal`: up, across, and down once it is within `near` of it.

        It stays up, too, while it is `askew`: 0 is good enough to go down, 1 is not.
        """
        away = goal - thing
        high = max(funnel(float(np.linalg.norm(away[:2])), near, far), askew)
        height = float(goal[2]) + max(self.clear - float(goal[2]), 0.0) * high
        across = 1.0 - funnel(height - float(thing[2]), 0.01, 0.05) * high
        wanted = np.array([*(thing[:2] + away[:2] * across), height])
        return wanted + self.scene.hand - thing

    def let_go(self) -> tuple[Array, float]:
        """Open, and leave upwards once the fingers are off."""
        up = 0.12 * funnel(self.scene.gap, *self.off)
        return self.scene.hand + np.array([0.0, 0.0, up]), OPEN

    def update(self, thing: Array, goal: Array, flat: float, height: float, lost: float = 0.04) -> bool:
        """Whether the thing has been let go at the goal: from when it is close until it is away again."""
        away = thing - goal
        distance = float(np.linalg.norm(away[:2]))
        if self.grasp.held and distance < flat and abs(float(away[2])) < height:
            self.released = True
            self.grasp.closing = self.grasp.held = False
        elif self.released and (distance > lost or abs(float(away[2])) > lost):
            self.released = False
        return self.released


class Misreach:
    """A reach that goes wrong, on purpose: the hand comes beside and above a thing, turned away from it.

    There it may close on nothing, and may set out with that as if it held the thing, before it opens and comes back.
    It stays above the thing, for what falls over is lost.
    """

    NEAR = 0.12
    """How near to the thing the hand is when it begins, in metres."""
    ASIDE = 0.03
    ABOVE = (0.075, 0.105)
    """How far beside the thing at most, and how far above where it is taken: metres."""
    AMISS = 1.0
    """By how much the hand is turned away at most, in radians."""
    LOWEST, HIGHEST = -math.inf, math.inf
    """The angles about the vertical that it is kept between."""
    CLOSES = 0.5
    """How often it closes on nothing."""
    ONWARD = 60
    """For how many steps it goes on with that at most."""
    THERE = 0.02
    PATIENCE = 30
    """Within how many metres of its wrong place, or after how many steps, it is there."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self._rng = rng
        self._miss: Array | None = None
        self._turn = 0.0
        self._closes = False
        self._tried = self._onward = 0

    @property
    def under_way(self) -> bool:
        """Whether the hand errs now."""
        return self._miss is not None or self._onward > 0

    def near(self, point: Array) -> bool:
        """Whether the hand is where a reach for `point` may begin to go wrong."""
        return float(np.linalg.norm(point - self.scene.hand)) < self.NEAR

    def begin(self) -> None:
        """Draw where the hand goes, how it is turned there, and whether it closes."""
        rng = self._rng
        angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(0, self.ASIDE)
        self._miss = np.array([far * np.cos(angle), far * np.sin(angle), rng.uniform(*self.ABOVE)])
        turn = hand_yaw(self.scene.hand_rotation) + rng.uniform(-self.AMISS, self.AMISS)
        self._turn = float(np.clip(turn, self.LOWEST, self.HIGHEST))
        self._closes = bool(rng.random() < self.CLOSES)
        self._tried = 0

    def go_on(self, point: Array, bring: Array) -> tuple[Array, float, Array | None]:
        """Where the hand goes, what its fingers do, and its rotation where that is wrong.

        `point` is where the thing would be taken, `bring` where the hand would go now if it held the thing.
        """
        if self._miss is None:
            self._onward -= 1
            return bring, CLOSE, None
        target = point + self._miss
        self._tried += 1
        there = float(np.linalg.norm(target - self.scene.hand)) < self.THERE or self._tried > self.PATIENCE
        met = self.scene.gap < Grasp.THINNEST
        if met or (there and not self._closes):
            self._miss = None
            self._onward = int(self._rng.choice(self.ONWARD + 1)) * met
        return target, CLOSE if there and self._closes else OPEN, about_z(self._turn) @ DOWN
