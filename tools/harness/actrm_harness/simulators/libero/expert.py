"""The scripted expert of LIBERO's tasks: it takes the thing that the goal names, and puts it where the goal says.

How a thing is held follows from the shape of its collision geometry, not from its name. The expert sees the simulator's
own state. Its moves, its noise and its mishaps are those of robosuite's experts (`experts.parts`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from actrm_harness.experts.parts import DOWN, Carry, Grasp, Scene, Servo, about_z, hand_yaw, nearest
from actrm_harness.experts.skills import Demonstrator
from actrm_harness.protocol import RequestError
from actrm_harness.wire import Array

WIDEST = 0.066
"""What fits between the fingers, in metres; open, they are 8 cm apart."""
DEPTH = 0.028
"""How far down from its top a tall thing is held: the palm is 34 mm above that point."""
LOWEST = 0.009
"""The lowest height over its support at which a thing is held."""
RIM, RIM_DEPTH = 0.006, 0.012
"""How far inside a wide thing's box its rim is held, and how far below its top."""
PALM, PALM_ABOVE = np.array([0.034, 0.105]), 0.03
"""Half of the palm, across the fingers and along the way that they open, and how far it is above the grip site."""
FINGERS = np.array([0.012, 0.065])
"""Half of the room that open fingers take."""
PAD = 0.012
"""Half the width of a finger, and how far it reaches down below the grip site."""
CLEAR = 0.01
"""How far a hand stays away from what stands beside a thing."""
POINTS, POINT = 5, 0.01
"""How many points along each side stand for a part of a fixture, and for how much around them."""
SHIFT = 0.025
"""How far from its middle a thing is held at most."""
TURNS = (0.0, -0.25, 0.25)
NARROW = 0.05
"""A hand may be askew to a thing that is narrower than this."""
LEVEL = 0.5
"""An axis that rises by less than this, as a sine, lies flat."""


@dataclass(frozen=True, slots=True)
class Box:
    """A box around a thing, in the frame of its body."""

    low: Array
    high: Array

    def corners(self) -> Array:
        """Its corners, one a row."""
        grid = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
        return self.low + grid * (self.high - self.low)


def box(boxes: Array, places: Array, rotations: Array) -> Box:
    """The box around boxes (center, half size), each at a place and rotation in the body's frame."""
    corners: list[Array] = []
    for each, place, rotation in zip(boxes, places, rotations, strict=True):
        own = Box(each[:3] - each[3:], each[:3] + each[3:]).corners()
        corners.append(own @ rotation.T + place)
    every = np.concatenate(corners)
    return Box(every.min(axis=0), every.max(axis=0))


@dataclass(frozen=True, slots=True)
class Around:
    """What stands around a thing, as cylinders: one a row."""

    places: Array
    radii: Array
    tops: Array

    @staticmethod
    def of(things: Sequence[tuple[Box, Array, Array]], points: Array | None = None) -> "Around":
        """The cylinders that stand for things of a shape, at a place and rotation, and for points of larger ones."""
        corners = [place + shape.corners() @ rotation.T for shape, place, rotation in things]
        low = np.array([each.min(axis=0) for each in corners]).reshape(-1, 3)
        high = np.array([each.max(axis=0) for each in corners]).reshape(-1, 3)
        points = np.zeros((0, 3)) if points is None else points
        return Around(
            np.concatenate([(low + high)[:, :2] / 2, points[:, :2]]),
            np.concatenate([(high - low)[:, :2].sum(axis=1) / 4, np.full(len(points), POINT)]),
            np.concatenate([high[:, 2], points[:, 2]]),
        )


@dataclass(frozen=True, slots=True)
class Hold:
    """How a thing is held: where, in the frame of its body seen from above, and by which of its axes."""

    axis: int
    turn: float
    """Added to the axis's angle about the vertical."""
    shift: Array
    """From the middle of the thing, in the frame of its body."""
    rim: bool = False
    """Whether one finger is inside the thing."""

    def point(self, shape: Box, place: Array, rotation: Array) -> Array:
        """Where the fingers close."""
        corners = place + shape.corners() @ rotation.T
        low, top = float(corners[:, 2].min()), float(corners[:, 2].max())
        middle = place + rotation @ ((shape.low + shape.high) / 2 + self.shift)
        height = top - RIM_DEPTH if self.rim else max((low + top) / 2, top - DEPTH, low + LOWEST)
        return np.array([middle[0], middle[1], height])

    def angle(self, rotation: Array, hand: float) -> float:
        """The hand's angle about the vertical, near its present one; the fingers of a hand at 0 open along y."""
        axis = rotation[:, self.axis]
        return nearest(float(np.arctan2(axis[1], axis[0])) - np.pi / 2, np.pi, hand) + self.turn


def hold(shape: Box, place: Array, rotation: Array, around: Around | None = None, base: Array | None = None) -> Hold:
    """How to hold a thing from above: clear of its neighbours, in its middle, and with the least turn of the hand.

    Of two sides of a rim it is the one near the robot's base.

    The fingers close along one of the thing's level axes that they can span; where there is none, on its rim.
    """
    size = shape.high - shape.low
    level = [axis for axis in range(3) if abs(rotation[2, axis]) < LEVEL] or [0]
    spanned = [axis for axis in level if size[axis] <= WIDEST]

    def wanting(one: Hold) -> float:
        point, angle = one.point(shape, place, rotation), one.angle(rotation, 0.0)
        near = 0.0 if around is None else max(0.0, CLEAR - room(point, angle, around))
        far = 0.0 if base is None else float(np.linalg.norm((point - base)[:2]))
        return 50.0 * near + far + 0.1 * abs(angle) + abs(one.turn) + 10.0 * float(np.abs(one.shift).sum())

    def holds() -> Iterator[Hold]:
        for axis in spanned:
            across = [each for each in level if each != axis]
            reach = max(0.0, min(SHIFT, float(size[across[0]]) / 2 - PAD)) if across else 0.0
            for share in (0.0, -0.5, 0.5, -1.0, 1.0):
                shift = np.zeros(3)
                shift[across] = share * reach
                for turn in TURNS if size[axis] <= NARROW else TURNS[:1]:
                    yield Hold(axis, turn, shift)
        for axis in level if not spanned else []:
            for side in (-1.0, 1.0):
                shift = np.zeros(3)
                shift[axis] = side * (float(size[axis]) / 2 - RIM)
                yield Hold(axis, 0.0, shift, rim=True)

    return min(holds(), key=wanting)


def room(point: Array, angle: float, around: Around) -> float:
    """How far a hand that closes at this point is from what stands around; negative where it would touch it."""
    seen = np.abs((around.places - point[:2]) @ about_z(angle)[:2, :2])
    least = 1.0
    for half, above in ((PALM, PALM_ABOVE), (FINGERS, -PAD)):
        away = np.linalg.norm(np.maximum(seen - half, 0.0), axis=1) - around.radii
        least = min(least, float(away[around.tops > point[2] + above].min(initial=1.0)))
    return least


class LiberoScene(Scene):
    """What the expert may look at, in robosuite 1.4."""

    def __init__(self, env: Any, shown_by: Demonstrator | None = None) -> None:
        self.env = env
        self.shown_by = shown_by or Demonstrator.draw(None, 0)
        self._robot = env.robots[0]
        self._site = int(self._robot.eef_site_id)
        self._fingers = list(self._robot._ref_gripper_joint_pos_indexes)
        self._finger_speeds = list(self._robot._ref_gripper_joint_vel_indexes)
        self._pads = []

    @property
    def base_rotation(self) -> Array:
        """The identity: robosuite 1.4 moves the hand along the world's axes."""
        return np.eye(3)

    def thing(self, name: str) -> tuple[Array, Array]:
        """Position and rotation of a thing or a fixture."""
        body = self.env.obj_body_id[name]
        data = self.env.sim.data
        return np.array(data.body_xpos[body]), np.array(data.body_xmat[body]).reshape(3, 3)

    def site(self, name: str) -> tuple[Array, Array]:
        """Position and rotation of a region."""
        site = self.env.sim.model.site_name2id(name)
        data = self.env.sim.data
        return np.array(data.site_xpos[site]), np.array(data.site_xmat[site]).reshape(3, 3)

    def around(self, name: str) -> Around:
        """What stands around a thing."""
        others = [(self.shape(each), *self.thing(each)) for each in self.env.objects_dict if each != name]
        return Around.of(others, self.fixtures())

    def fixtures(self) -> Array:
        """Points of all that collides of the fixtures, one a row."""
        grid = np.array(np.meshgrid(*[np.linspace(-1.0, 1.0, POINTS)] * 3)).reshape(3, -1).T
        model, data = self.env.sim.model._model, self.env.sim.data._data
        points = [np.zeros((0, 3))]
        for geom in (geom for each in self.env.fixtures_dict for geom in self.solid(each)):
            own = model.geom_aabb[geom, :3] + grid * model.geom_aabb[geom, 3:]
            points.append(data.geom_xpos[geom] + own @ data.geom_xmat[geom].reshape(3, 3).T)
        return np.concatenate(points)

    def solid(self, name: str) -> list[int]:
        """The geoms of a thing that collide."""
        model = self.env.sim.model._model
        root = model.body_rootid[self.env.obj_body_id[name]]
        collides = (model.geom_contype > 0) | (model.geom_conaffinity > 0)
        return [int(each) for each in np.flatnonzero(collides & (model.body_rootid[model.geom_bodyid] == root))]

    def shape(self, name: str) -> Box:
        """The box around what collides of a thing."""
        model, data = self.env.sim.model._model, self.env.sim.data._data
        place, rotation = self.thing(name)
        geoms = self.solid(name)
        places = (data.geom_xpos[geoms] - place) @ rotation
        rotations = rotation.T @ data.geom_xmat[geoms].reshape(-1, 3, 3)
        return box(model.geom_aabb[geoms], places, rotations)


ABOVE_FLOOR = 0.01
"""How far above the floor of a container a thing is let go, if the hand reaches down there."""
INTO = 0.01
"""How far below the top of a container's walls the grip site goes."""
BESIDE = 0.06
"""What is nearer than this to a way stands in it."""
AMISS, LEFT = 0.03, 0.1
"""A thing that lies so far from its place is taken again, once the hand is so far above it."""
MOVED = 0.02
"""A thing that has moved so far since it was looked at is looked at again."""
FALLEN, STUCK = 0.012, 20
"""A thing has left the fingers where it is so far below where they held it; they wait for that for so many steps."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a thing goes."""

    middle: Array
    """The middle of what it lies on."""
    walls: float
    """The height of what stands around that."""


class RimGrasp(Grasp):
    """A grasp of something thin."""

    THINNEST = 0.0015


class PickAndPlace:
    """Take a thing and lay it into a container, onto a region, or onto another thing."""

    def __init__(self, scene: LiberoScene, rng: np.random.Generator, thing: str, onto: str) -> None:
        self.scene = scene
        self.name = thing
        self.onto = onto
        self.servo = Servo(scene, rng, pace=1.4)
        self.margin = rng.uniform(0.03, 0.05)
        self.shape = scene.shape(thing)
        self.how, self.seen = self.look()
        place, rotation = scene.thing(thing)
        point = self.how.point(self.shape, place, rotation)
        top = float((place + self.shape.corners() @ rotation.T)[:, 2].max())
        kind = RimGrasp if self.how.rim else Grasp
        self.grasp = kind(scene, self.servo.style, tall=top - point[2], mouth=(0.006, 0.018), close=(0.008, 0.008))
        # down from above what is in the way
        self.grasp.hover = max(self.grasp.hover, self.over(scene.hand, place) - float(point[2]))
        self.carry = Carry(scene, self.grasp, clear=self.over(place, self.place().middle))
        self.held_at = self.turn = 0.0
        self.waited = 0

    def over(self, start: Array, end: Array) -> float:
        """The height over all that stands along a way."""
        scene = self.scene
        names = [*scene.env.objects_dict, *scene.env.fixtures_dict]
        things = Around.of([(scene.shape(each), *scene.thing(each)) for each in names if each != self.name])
        way = (end - start)[:2]
        along = np.clip((things.places - start[:2]) @ way / max(1e-9, float(way @ way)), 0.0, 1.0)
        away = np.linalg.norm(start[:2] + along[:, None] * way - things.places, axis=1) - things.radii
        return float(things.tops[away < BESIDE].max(initial=0.0)) + self.margin

    def place(self) -> Place:
        """Where the thing goes, as it is now."""
        scene, env = self.scene, self.scene.env
        if self.onto in env.object_sites_dict:
            middle, _ = scene.site(self.onto)
            holder = str(getattr(env.object_sites_dict[self.onto], "parent_name", ""))
            if holder not in env.objects_dict:
                return Place(middle, float(middle[2]))
            floor = scene.thing(holder)[0]
            return Place(np.array([middle[0], middle[1], floor[2]]), float((floor + scene.shape(holder).high)[2]))
        floor, _ = scene.thing(self.onto)
        return Place(floor, float((floor + scene.shape(self.onto).high)[2]))

    def look(self) -> tuple[Hold, Array]:
        """How to hold the thing where it is now."""
        place, rotation = self.scene.thing(self.name)
        return hold(self.shape, place, rotation, self.scene.around(self.name), self.scene.base), place

    def act(self) -> Array:
        """The action for the current state."""
        scene = self.scene
        place, rotation = scene.thing(self.name)
        hand = hand_yaw(scene.hand_rotation)
        goal = self.goal(place, rotation)
        off = float(np.linalg.norm((place - goal)[:2])) > AMISS
        if off and float(scene.hand[2] - place[2]) > self.held_at + LEFT:
            # it fell beside its place
            self.carry.released = False
        if self.carry.update(place, goal, flat=0.02, height=0.015, lost=0.25):
            return self.leave(place)
        self.waited = 0
        if not self.grasp.closing and float(np.linalg.norm(place - self.seen)) > MOVED:
            self.how, self.seen = self.look()
        if not self.grasp.held:
            # what is held turns with the hand
            self.turn = self.how.angle(rotation, 0.0)
        target, grip = self.grasp.reach(self.how.point(self.shape, place, rotation), self.turn - hand)
        if self.grasp.held:
            self.held_at = float(scene.hand[2] - place[2])
            # open by so much more, the fingers are off it
            self.carry.off = (scene.gap + 0.004, scene.gap + 0.012)
            carried = self.carry.clear
            self.carry.clear = carried + float(place[2]) - self.lowest(place, rotation)
            target = self.carry.bring(place, goal, near=0.015, far=0.05)
            self.carry.clear = carried
        return self.servo.move(target, grip, about_z(self.turn) @ DOWN)

    def leave(self, place: Array) -> Array:
        """Open, and go up once the thing has left the fingers; it may hang on one of them, off their middle."""
        target, grip = self.carry.let_go()
        self.waited += 1
        hangs = float(self.scene.hand[2] - place[2]) < self.held_at + FALLEN
        if hangs and not self.how.rim and self.waited < STUCK:
            target = np.array([place[0], place[1], self.scene.hand[2]])
        return self.servo.move(target, grip, about_z(hand_yaw(self.scene.hand_rotation)) @ DOWN)

    def lowest(self, place: Array, rotation: Array) -> float:
        """The height of a thing's lowest point."""
        return float((place + self.shape.corners() @ rotation.T)[:, 2].min())

    def goal(self, place: Array, rotation: Array) -> Array:
        """Where the thing is let go: over the middle, as low as the hand gets."""
        there = self.place()
        below = float(place[2]) - self.lowest(place, rotation)
        height = max(float(there.middle[2]) + ABOVE_FLOOR + below, there.walls - INTO - self.held_at)
        return np.array([there.middle[0], there.middle[1], height])


def expert(scene: LiberoScene, rng: np.random.Generator) -> PickAndPlace:
    """The expert of the environment's goal; RequestError where there is none."""
    goal: list[list[str]] = scene.env.parsed_problem["goal_state"]
    things, regions = scene.env.objects_dict, scene.env.object_sites_dict
    if len(goal) == 1 and goal[0][0] in ("in", "on") and goal[0][1] in things:
        _, thing, onto = goal[0]
        # what is in a fixture is behind a door or in a drawer
        if goal[0][0] == "on" or getattr(regions.get(onto), "parent_name", "") in things:
            return PickAndPlace(scene, rng, thing, onto)
    text = "; ".join(" ".join(condition) for condition in goal)
    raise RequestError("no_expert", f"there is no scripted expert for a goal like this one: {text}")
