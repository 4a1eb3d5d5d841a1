"""How the scripted experts moved before there were skills, word for word: what a good demonstrator is held to.

Nothing here is to be changed with `experts.parts`: a good demonstrator's episodes stay the bytes that they were.
"""

import math

import numpy as np

from actrm_harness.experts.objects import DoorExpert
from actrm_harness.experts.parts import (
    CLOSE,
    METRES_PER_UNIT,
    ONE_PUSH,
    OPEN,
    RADIANS_PER_UNIT,
    Mishaps,
    Scene,
    Style,
    funnel,
    limit,
    rotation_vector,
)
from actrm_harness.wire import Array


class PlainServo:
    """`parts.Servo` before."""

    def __init__(
        self,
        scene: Scene,
        rng: np.random.Generator,
        pace: float = 1.0,
        turn: float = 0.5,
        mishaps: Mishaps = ONE_PUSH,
    ) -> None:
        self.scene = scene
        self.style = Style.draw(rng)
        self.pace = pace
        self.turn = turn
        self.upright = scene.hand_rotation
        self._rng = rng
        self._noise = np.zeros(6)
        self._time = 0
        self._pushed = mishaps.pushed
        self._push_at: int = 3 + int(37 * rng.random())
        self._push = self._draw_push()
        self._fumbled = mishaps.fumbled
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
        wanted = limit((target - self.scene.hand) / METRES_PER_UNIT * style.gain, style.speed * self.pace)
        goal = self.upright if rotation is None else rotation
        turn = limit(rotation_vector(goal @ self.scene.hand_rotation.T) / RADIANS_PER_UNIT, self.turn)
        self._noise = 0.7 * self._noise + self._rng.normal(size=6) * style.noise * np.repeat([1.0, 0.3], 3)
        if self._push_at <= self._time < self._push_at + 3:
            wanted = wanted + self._push
        elif self._time == self._push_at + 3 and math.isfinite(self._pushed):
            self._push_at += 4 + int(2 * (self._pushed - 4) * self._rng.random())
            self._push = self._draw_push()
        if self._fumble[0] <= self._time < self._fumble[1]:
            grip = -grip
        elif self._time == self._fumble[1]:
            self._fumble = self._draw_fumble()
        self._time += 1
        own = self.scene.base_rotation.T
        return np.concatenate([np.concatenate([own @ wanted, own @ turn]) + self._noise, [grip]])


class PlainGrasp:
    """`parts.Grasp` before."""

    THINNEST, WIDEST = 0.01, 0.07

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
        self.close = close
        self.hover = style.hover + tall
        self.mouth = mouth
        self.closing = False
        self.held = False

    def reach(self, point: Array, askew: float = 0.0) -> tuple[Array, float]:
        """Where the hand goes and what the fingers do."""
        hand = self.scene.hand
        offset = point - hand
        flat, height = float(np.linalg.norm(offset[:2])), abs(float(offset[2]))
        if not self.closing and flat < self.close[0] and height < self.close[1]:
            self.closing = True
        elif self.closing and (flat > 0.035 or height > 0.035 or self.scene.gap < self.THINNEST):
            self.closing = self.held = False
        gap = self.scene.gap
        if self.closing and self.THINNEST < gap < self.WIDEST and abs(self.scene.gap_speed) < 0.01:
            self.held = True
        target = np.array(point)
        if not self.closing:
            lift = max(funnel(flat, *self.mouth), funnel(abs(askew), 0.15, 0.4))
            target[2] += self.hover * lift
            target[:2] += self.style.side * lift
        return target, CLOSE if self.closing else OPEN


class PlainDoorExpert(DoorExpert):
    """`objects.DoorExpert` before."""

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
