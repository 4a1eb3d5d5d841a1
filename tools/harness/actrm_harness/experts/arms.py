"""The experts of tasks with two arms."""

from typing import Any

import numpy as np

from actrm_harness.experts.parts import (
    DOWN,
    ONE_PUSH,
    OPEN,
    Carry,
    Grasp,
    Mishaps,
    Misreach,
    Scene,
    Servo,
    about,
    about_z,
    funnel,
    hand_yaw,
    nearest,
    yaw,
)
from actrm_harness.wire import Array

# In the pot's frame, where the first arm holds its handle: one of the two bars that lead away from the pot. The second
# arm's is across the pot, so that the pot's weight is between the hands.
BAR = np.array([0.045, 0.115, 0.06])
ACROSS = np.array([-1.0, -1.0, 1.0])

# A point and a direction.
Line = tuple[Array, Array]

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


# Along the hammer's handle, from its middle to where the first and the second hand hold it; a hand is 6.4 cm thick.
APART = {1.0: 0.035, -1.0: 0.055}

# How far from its handle's end a hammer is held at least.
END = 0.012

# How far up or down a hand is asked to go at once.
STEADY = 0.03

# How many times further than it is away a hand that closes deep in a bin is asked to go.
LEAN = 2.0

# The fingers' height over the walls of the bins.
OVER_WALLS = 1.04


class Hammer:
    """A hammer that lies flat, seen from two arms that face each other along y, each holding an end of its handle."""

    def __init__(self, scene: Scene, thing: Any) -> None:
        self.scene = scene
        self.name: str = thing.root_body
        self.apart = {side: min(apart, float(thing.handle_length) / 2 - END) for side, apart in APART.items()}

    @property
    def middle(self) -> Array:
        """The middle of the handle."""
        return self.scene.body(self.name)

    def along(self, side: float) -> Array:
        """The handle's direction, away from the arm on the side of -y (`side` 1) or of +y (-1)."""
        way = self.scene.body_rotation(self.name)[:, 2]
        return way if way[1] * side > 0.0 else -way

    def grip(self, side: float) -> Array:
        """Where that arm holds it."""
        return self.middle - self.apart[side] * self.along(side)

    def turn(self, side: float, hand: float) -> float:
        """The turn of that arm's hand, from which the handle leads away."""
        way = self.along(side)
        return nearest(float(np.arctan2(way[1], way[0])), 2 * np.pi, hand)


class _HandingExpert:
    """Two arms that hand a hammer over: the first brings it to where they meet, and opens once both hold it.

    Both hold it by its handle from above, side by side, in the middle between the tables. There the hands are near the
    end of their range, towards their own bases: they are led back to the line between them and not only up.
    """

    MEET = np.array([0.0, 0.0, 1.1])
    # where each arm waits, the second beside the place where they meet
    BACK = np.array([0.0, -0.3, 1.2])
    WAITING = np.array([0.0, 0.14, 1.2])

    MISHAPS = ONE_PUSH

    def __init__(self, scene: Scene, other: Scene, rng: np.random.Generator, hammer: Any, tall: float) -> None:
        """`tall`: how far up above the hammer the way to it is barred for the first arm."""
        self.scenes = [scene, other]
        self.servos = [Servo(each, rng, pace=1.4, mishaps=self.MISHAPS) for each in self.scenes]
        self.servos[1].style = self.servos[0].style
        self.hammer = Hammer(scene, hammer)
        style = self.servos[0].style
        self.holds = [
            Grasp(scene, style, tall=tall, mouth=(0.012, 0.04 if tall else 0.03), close=(0.012, 0.012)),
            Grasp(other, style, mouth=(0.012, 0.03), close=(0.012, 0.012)),
        ]
        self.meet = self.MEET + np.array([0.0, 0.0, rng.uniform(-0.02, 0.02)])
        self.fetch = Carry(scene, self.holds[0], clear=float(self.meet[2]))
        self.given = False

    def act(self) -> Array:
        """The action for the current state, the first arm's before the second's."""
        self.given |= self.holds[0].held and self.holds[1].held
        return np.concatenate([self._first(), self._second()])

    def _first(self) -> Array:
        return self._bring()

    def _second(self) -> Array:
        return self._keep() if self.given else self._take()

    def _move(self, servo: Servo, target: Array, fingers: float, rotation: Array) -> Array:
        """A step that leaves some of the speed for keeping to the line: who only goes down drifts towards the base."""
        step = target - servo.scene.hand
        step[2] = np.clip(step[2], -STEADY, STEADY)
        return servo.move(servo.scene.hand + step, fingers, rotation)

    def _straight(self, arm: int) -> Array:
        """The rotation of a hand that looks straight ahead, from the table's side."""
        ahead = (np.pi / 2, -np.pi / 2)[arm]
        return about_z(nearest(ahead, 2 * np.pi, hand_yaw(self.scenes[arm].hand_rotation))) @ DOWN

    def _bring(self) -> Array:
        """The first arm's step: to the hammer, with it to where they meet, and away once it is given."""
        scene, servo = self.scenes[0], self.servos[0]
        hand = hand_yaw(scene.hand_rotation)
        if self.given:
            # up off the handle, and back from it
            target, fingers = self.fetch.let_go()
            if float(scene.hand[2]) > float(self.hammer.middle[2]) + 0.05 or float(scene.hand[1]) < -0.15:
                target = self.BACK
            return self._move(servo, target, fingers, self._straight(0))
        turn = self.hammer.turn(1.0, hand)
        target, fingers = self.holds[0].reach(self.hammer.grip(1.0), turn - hand)
        if not self.holds[0].held:
            return self._move(servo, self._around(target), fingers, about_z(turn) @ DOWN)
        middle = self.hammer.middle
        target = self.fetch.bring(middle, self.meet, near=0.01, far=0.05)
        target = self._led_out(target, middle)
        return self._move(servo, target, fingers, about_z(hand + nearest(np.pi / 2, 2 * np.pi, turn) - turn) @ DOWN)

    def _around(self, target: Array) -> Array:
        """The way to the hammer, around what stands in it."""
        return target

    def _led_out(self, target: Array, middle: Array) -> Array:
        """The way from where the hammer lay, around what stands in it."""
        return target

    def _take(self) -> Array:
        """The second arm's step until it holds the hammer: it waits until it is offered."""
        scene, servo = self.scenes[1], self.servos[1]
        offered = self.hammer.middle - self.meet
        if self.holds[0].held and float(np.linalg.norm(offered)) < 0.03:
            hand = hand_yaw(scene.hand_rotation)
            turn = self.hammer.turn(-1.0, hand)
            target, fingers = self.holds[1].reach(self.hammer.grip(-1.0), turn - hand)
            return self._move(servo, target, fingers, about_z(turn) @ DOWN)
        return self._move(servo, self.WAITING, OPEN, self._straight(1))

    def _keep(self) -> Array:
        """The second arm's step once it holds the hammer."""
        target, fingers = self.holds[1].reach(self.hammer.grip(-1.0))
        return self._move(self.servos[1], target, fingers, self._straight(1))


class TwoArmHandoverExpert(_HandingExpert):
    """The first arm takes the hammer off the table and hands it over; handles are of 10 to 25 cm."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, Scene(scene.env, 1, scene.shown_by), rng, scene.task.hammer, tall=0.0)


class TwoArmTransportExpert(_HandingExpert):
    """The first arm uncovers and fetches the hammer while the second throws out the trash; then they hand it over.

    The second lays the hammer into its bin once the first is away.
    """

    LID = np.array([-0.2, -0.45, 0.826])

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        # the first reaches into a bin for the hammer
        super().__init__(scene, Scene(scene.env, 1, scene.shown_by), rng, scene.task.transport.payload, tall=0.19)
        style = self.servos[0].style
        self.lid = Grasp(scene, style, tall=0.02, mouth=(0.012, 0.03))
        self.trash = Grasp(self.scenes[1], style, tall=0.19, mouth=(0.012, 0.04))
        clear = rng.uniform(1.03, 1.05)
        self.uncover = Carry(scene, self.lid, clear)
        self.throw = Carry(self.scenes[1], self.trash, clear)
        self.lay = Carry(self.scenes[1], self.holds[1], clear=float(self.meet[2]))
        self.uncovered = self.thrown = False

    def _first(self) -> Array:
        if self.uncovered:
            return self._bring()
        scene, servo, straight = self.scenes[0], self.servos[0], self._straight(0)
        lid, handle = scene.body("transport_start_bin_lid_root"), _geom(scene, "transport_start_bin_lid_handle")
        if self.uncover.update(lid, self.LID, flat=0.04, height=0.012, lost=0.1):
            target, fingers = self.uncover.let_go()
            target[1] = self.LID[1]
            self.uncovered = float(scene.hand[2] - handle[2]) > 0.08
            return self._move(servo, target, fingers, straight)
        target, fingers = self.lid.reach(handle)
        if self.lid.held:
            target = self.uncover.bring(lid, self.LID, near=0.03, far=0.08)
            target[1] = self.LID[1]
        return self._move(servo, target, fingers, straight)

    def _around(self, target: Array) -> Array:
        hand = self.scenes[0].hand
        if self.holds[0].closing:
            # deep in the bin the hand drifts towards its base while the fingers close: to the handle's very end
            target[:2] += LEAN * (target - hand)[:2]
        elif float(np.linalg.norm((target - hand)[:2])) > 0.05:
            # out of the lid's place and over the bin's wall
            target[:2] += (hand - target)[:2] * funnel(OVER_WALLS - float(hand[2]), 0.01, 0.05)
        return target

    def _led_out(self, target: Array, middle: Array) -> Array:
        low = funnel(float(self.meet[2] - middle[2]), 0.01, 0.05)
        target[:2] += low * (_geom(self.scenes[0], "transport_start_bin_base") - middle)[:2]
        return target

    def _second(self) -> Array:
        return super()._second() if self.thrown else self._throw_out()

    def _keep(self) -> Array:
        scene, servo, straight = self.scenes[1], self.servos[1], self._straight(1)
        goal = _geom(scene, "transport_target_bin_base") + np.array([0.0, 0.0, 0.03])
        if self.lay.update(self.hammer.middle, goal, flat=0.03, height=0.01):
            target, fingers = self.lay.let_go()
            target[:2] = goal[:2] - self.hammer.apart[-1.0] * self.hammer.along(-1.0)[:2]
            return self._move(servo, target, fingers, straight)
        target, fingers = self.holds[1].reach(self.hammer.grip(-1.0))
        away = float(np.linalg.norm(self.scenes[0].hand - self.hammer.grip(1.0))) > 0.06
        if self.holds[1].held and away:
            target = self.lay.bring(self.hammer.middle, goal, near=0.02, far=0.06)
        return self._move(servo, target, fingers, straight)

    def _throw_out(self) -> Array:
        scene, servo, straight = self.scenes[1], self.servos[1], self._straight(1)
        trash, rotation = scene.body("trash_main"), scene.body_rotation("trash_main")
        goal = self._trash_goal()
        away = np.abs(trash - goal)
        inside = float(trash[2]) < float(goal[2]) - 0.03 and float(away[:2].max()) < 0.12
        if self.throw.update(trash, goal, flat=0.04, height=0.02, lost=0.2) or inside:
            target, fingers = self.throw.let_go()
            target[:2] = goal[:2]
            self.thrown = float(scene.hand[2]) > 1.02
            return self._move(servo, target, fingers, straight)
        hand = hand_yaw(scene.hand_rotation)
        turn = nearest(yaw(rotation), np.pi / 2, hand)
        target, fingers = self.trash.reach(trash, turn - hand)
        if self.trash.held:
            return self._move(servo, self._over_to_bin(trash), fingers, straight)
        return self._move(servo, target, fingers, about_z(turn) @ DOWN)

    def _trash_goal(self) -> Array:
        """Where the trash is let fall."""
        return _geom(self.scenes[1], "transport_trash_bin_base") + np.array([0.0, 0.0, 0.07])

    def _over_to_bin(self, trash: Array) -> Array:
        """Where the second hand goes with the trash, over to its bin."""
        goal = self._trash_goal()
        target = self.throw.bring(trash, goal, near=0.03, far=0.08)
        target[1] = goal[1]
        return target


class RecoveringTransportExpert(TwoArmTransportExpert):
    """Both arms are pushed all the while, and some reaches for the trash go wrong; all of it is marked."""

    MISHAPS = Mishaps(pushed=22.0)
    # How often the second hand misses the trash: never, once, twice.
    MISREACHES = (0.3, 0.5, 0.2)

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, rng)
        self.misreaches = int(rng.choice(3, p=self.MISREACHES))
        self.misreach = Misreach(self.scenes[1], rng)
        self.erring = False

    def act(self) -> Array:
        """The action for the current state, the first arm's before the second's."""
        wrong = self.misreach.under_way
        action = super().act()
        self.erring = wrong or any(servo.erring for servo in self.servos)
        return action

    def _throw_out(self) -> Array:
        trash = self.scenes[1].body("trash_main")
        if self.misreach.under_way:
            target, fingers, rotation = self.misreach.go_on(trash, self._over_to_bin(self.scenes[1].hand))
            return self._move(self.servos[1], target, fingers, self._straight(1) if rotation is None else rotation)
        action = super()._throw_out()
        busy = self.trash.closing or self.throw.released
        if self.misreaches and not busy and self.misreach.near(trash):
            self.misreaches -= 1
            self.misreach.begin()
        return action


class TwoArmPegInHoleExpert:
    """Each hand leans over by about half a right angle, so that the peg points through the hole; then it goes in.

    The plate hangs from the second hand like a wall. It waits behind the place where they meet until the peg is on the
    line through that place, a peg's length away. The peg comes no nearer before it points at the hole's middle.
    """

    MEET = np.array([0.0, 0.0, 0.95])
    # from there to where the plate waits
    BEHIND = np.array([0.0, 0.2, 0.0])
    # from the hole's middle to the peg's along its axis, before and after: a peg is 26 cm long
    OUTSIDE, INSIDE = 0.23, 0.02
    # from the plate's body to the middle of its hole, in its frame
    MIDDLE = np.array([0.1, 0.0, 0.0])

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scenes = [scene, Scene(scene.env, 1, scene.shown_by)]
        self.servos = [Servo(each, rng, pace=1.4) for each in self.scenes]
        self.servos[1].style = self.servos[0].style
        self.meet = self.MEET + rng.uniform(-0.03, 0.03, size=3)
        lean = rng.uniform(0.4, 0.6) * np.pi / 2
        self.leans = (-lean, np.pi / 2 - lean)
        self.line = about(np.array([0.0, -lean, 0.0])) @ np.array([0.0, 0.0, -1.0])

    def act(self) -> Array:
        """The action for the current state, the first arm's before the second's: no fingers, twelve numbers."""
        leaning = [
            about(np.array([0.0, lean, 0.0])) @ scene.base_rotation @ DOWN
            for lean, scene in zip(self.leans, self.scenes, strict=True)
        ]
        first, second = self.scenes
        peg = (first.body("peg_main"), first.body_rotation("peg_main")[:, 2])
        turned = second.body_rotation("hole_main")
        hole = second.body("hole_main") + turned @ self.MIDDLE
        waiting = _off(peg, (self.meet, self.line), 0.03, 0.3)
        missing = funnel(float(np.linalg.norm(hole - self.meet)), 0.02, 0.05)
        if missing < 1.0:
            normal = turned[:, 2] * np.sign(turned[:, 2] @ peg[1])
            off = max(missing, _off(peg, (hole, normal), 0.01, 0.2))
            goal = hole - (self.INSIDE + (self.OUTSIDE - self.INSIDE) * off) * normal
        else:
            goal = self.meet - self.OUTSIDE * self.line
        targets = [first.hand + goal - peg[0], second.hand + self.meet + self.BEHIND * waiting - hole]
        moves = zip(self.servos, targets, leaning, strict=True)
        return np.concatenate([servo.move(target, OPEN, rotation)[:6] for servo, target, rotation in moves])


def _off(thing: Line, line: Line, aside: float, askew: float) -> float:
    """How far a thing is from lying on a line: 0 within `aside` (m) and a third of `askew` (rad), then up to 1."""
    (place, axis), (point, way) = thing, line
    away = point - place
    beside = float(np.linalg.norm(away - (away @ way) * way))
    angle = float(np.arccos(np.clip(way @ axis, -1.0, 1.0)))
    return max(funnel(beside, aside, 3 * aside), funnel(angle, askew / 3, askew))


def _geom(scene: Scene, name: str) -> Array:
    """Position of a shape."""
    return np.array(scene.env.sim.data.geom_xpos[scene.env.sim.model.geom_name2id(name)])
