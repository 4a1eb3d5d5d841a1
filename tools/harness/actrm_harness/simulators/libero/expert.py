"""The scripted expert of LIBERO's tasks: it takes the thing that the goal names, and puts it where the goal says.

How a thing is held follows from the shape of its collision geometry, not from its name. The expert sees the simulator's
own state. Its moves, its noise and its mishaps are those of robosuite's experts (`experts.parts`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from actrm_harness.experts.parts import DOWN, Carry, Grasp, Scene, Servo, about_z, hand_yaw, nearest, yaw
from actrm_harness.experts.skills import Demonstrator
from actrm_harness.protocol import RequestError
from actrm_harness.wire import Array

WIDEST = 0.066
"""What fits between the fingers, in metres; open, they are 8 cm apart."""
DEPTH = 0.05
"""How far down from its top a tall thing is held: the palm is 10 cm above the finger tips."""
LOWEST = 0.009
"""The lowest height over its support at which a thing is held."""
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
class Hold:
    """Where and how a thing is held."""

    point: Array
    turn: float
    """The hand's angle about the vertical."""
    tall: float
    """How far the thing stands up above the point."""


def hold(shape: Box, place: Array, rotation: Array, hand: float) -> Hold:
    """How to hold a thing of this shape from above, with the least turn of a hand at the angle `hand`.

    The fingers close along one of the thing's level axes, one that they can span; where there is none, the narrowest.
    """
    corners = place + shape.corners() @ rotation.T
    low, top = float(corners[:, 2].min()), float(corners[:, 2].max())
    middle = place + rotation @ (shape.low + shape.high) / 2
    height = max(float(middle[2]), top - DEPTH, low + LOWEST)
    level = [axis for axis in range(3) if abs(rotation[2, axis]) < LEVEL]
    widths = {axis: float((shape.high - shape.low)[axis]) for axis in level}
    spanned = [axis for axis in level if widths[axis] <= WIDEST] or sorted(level, key=widths.__getitem__)[:1]
    # the fingers of a hand at 0 open along y
    angles = [np.arctan2(rotation[1, axis], rotation[0, axis]) - np.pi / 2 for axis in spanned]
    turns = [nearest(float(angle), np.pi, hand) for angle in angles]
    turn = min(turns, key=lambda each: abs(each - hand), default=hand)
    return Hold(np.array([middle[0], middle[1], height]), turn, top - height)


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
        """robosuite 1.4 moves the hand along the world's axes."""
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

    def shape(self, name: str) -> Box:
        """The box around what collides of a thing."""
        model, data = self.env.sim.model._model, self.env.sim.data._data
        body = self.env.obj_body_id[name]
        place, rotation = self.thing(name)
        of = model.geom_bodyid
        below = {each for each in range(model.nbody) if model.body_rootid[each] == model.body_rootid[body]}
        solid = (model.geom_contype > 0) | (model.geom_conaffinity > 0)
        geoms = [each for each in range(model.ngeom) if solid[each] and int(of[each]) in below]
        places = (data.geom_xpos[geoms] - place) @ rotation
        rotations = np.einsum("ji,njk->nik", rotation, data.geom_xmat[geoms].reshape(-1, 3, 3))
        return box(model.geom_aabb[geoms], places, rotations)


DROP = 0.02
"""How far above the floor of a container a thing is let go, if the hand reaches down there."""
WALL = 0.015
"""How far above a container's walls the hand stays, and a thing that is carried over them."""


class PickAndPlace:
    """Take a thing and lay it into a container, or onto another thing."""

    def __init__(self, scene: LiberoScene, rng: np.random.Generator, thing: str, region: str) -> None:
        self.scene = scene
        self.name = thing
        self.region = region
        self.container: str = scene.env.object_sites_dict[region].parent_name
        self.servo = Servo(scene, rng, pace=1.4)
        self.shape = scene.shape(thing)
        place, rotation = scene.thing(thing)
        self.grasp = Grasp(
            scene,
            self.servo.style,
            tall=hold(self.shape, place, rotation, 0.0).tall,
            mouth=(0.006, 0.018),
            close=(0.008, 0.008),
        )
        self.carry = Carry(scene, self.grasp, clear=0.0)
        self.margin = rng.uniform(0.03, 0.05)
        walls = scene.shape(self.container)
        self.walls = float((scene.thing(self.container)[0] + walls.high)[2])

    def act(self) -> Array:
        """The action for the current state."""
        scene = self.scene
        place, rotation = scene.thing(self.name)
        hand = hand_yaw(scene.hand_rotation)
        goal = self.goal(place, rotation)
        if self.carry.update(place, goal, flat=0.02, height=0.02, lost=0.2):
            target, grip = self.carry.let_go()
            return self.servo.move(target, grip, about_z(0.0) @ DOWN)
        how = hold(self.shape, place, rotation, 0.0)
        target, grip = self.grasp.reach(how.point, how.turn - hand)
        if self.grasp.held:
            # open by so much more, the fingers are off it
            self.carry.off = (scene.gap + 0.004, scene.gap + 0.012)
            self.carry.clear = self.walls + self.margin + float(place[2] - self.lowest(place, rotation))
            target = self.carry.bring(place, goal, near=0.02, far=0.06)
        return self.servo.move(target, grip, about_z(how.turn) @ DOWN)

    def lowest(self, place: Array, rotation: Array) -> float:
        """The height of a thing's lowest point."""
        return float((place + self.shape.corners() @ rotation.T)[:, 2].min())

    def goal(self, place: Array, rotation: Array) -> Array:
        """Where the thing is let go: in the middle of the region, as deep as the hand gets."""
        middle, _ = self.scene.site(self.region)
        below = float(place[2]) - self.lowest(place, rotation)
        floor = self.scene.thing(self.container)[0][2]
        held_at = float(self.scene.hand[2] - place[2]) if self.grasp.held else 0.0
        height = max(float(floor) + DROP + below, self.walls + WALL - held_at)
        return np.array([middle[0], middle[1], height])


def expert(scene: LiberoScene, rng: np.random.Generator) -> PickAndPlace:
    """The expert of the environment's goal; RequestError where there is none."""
    goal = scene.env.parsed_problem["goal_state"]
    if len(goal) == 1 and goal[0][0] == "in" and goal[0][1] in scene.env.objects_dict:
        return PickAndPlace(scene, rng, goal[0][1], goal[0][2])
    raise RequestError("no_expert", f"no scripted expert for the goal {goal}")
