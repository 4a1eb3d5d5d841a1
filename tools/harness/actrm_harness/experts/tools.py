"""The expert of ToolHang: a frame goes into its stand, and a wrench onto the frame's hook."""

import numpy as np

from actrm_harness.experts.parts import (
    CLOSE,
    ONE_PUSH,
    OPEN,
    Carry,
    Grasp,
    Mishaps,
    Scene,
    Servo,
    about,
    funnel,
    rotation_vector,
)
from actrm_harness.wire import Array

# In the frame's own axes, where z leads up its rod and -x along the hook: where it is held.
GRIP = np.array([0.04375, 0.0, 0.0525])

# How far the hand leans when it takes the frame: half of the quarter turn that stands the frame up is made before, so
# that the hand points down as much as it did when it lets go.
LEAN = 0.85
ALONG = np.array([[1.0, 0.0, 0.0], [0.0, -np.sin(LEAN), np.cos(LEAN)], [0.0, -np.cos(LEAN), -np.sin(LEAN)]])

# The frame in its stand, hook away from the robot.
STANDING = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
TABLE = 0.8

# Where the hand is while it stands the frame up: elsewhere the wrist comes to the end of its range.
UPRIGHT_AT = np.array([-0.08, -0.16])

# How far the wrench is tilted around the hook before it is let go, and where its ring is then, from the middle of the
# upturned end.
TILT = 1.15
TILTED = 0.75
AROUND = np.array([-0.008, 0.0, -0.012])

# The hand over the wrench, in the wrench's axes (z up, -x to the ring): it leans towards the ring, so that it does not
# have to lean as far the other way when the wrench is tilted.
OVER_LEAN = 0.2
OVER = np.array(
    [
        [0.0, -np.cos(OVER_LEAN), np.sin(OVER_LEAN)],
        [-1.0, 0.0, 0.0],
        [0.0, -np.sin(OVER_LEAN), -np.cos(OVER_LEAN)],
    ]
)

# How fast the hand turns, in actions: with the frame or at the hook a fast turn would carry it off its place.
FREE, GENTLE = 0.6, 0.2

# Lowering: how far the hand is asked to go down at once, how far beside its place and how crooked a thing may be where
# it begins, and how crooked once it is inside, at most so far to the side.
STEP = 0.014
BESIDE = (0.003, 0.007)
CROOKED = (0.04, 0.1)
BENT = (0.06, 0.15)
MISSED = 0.01

# From the stand's middle to just below the top of its mount; from the middle of the hook's upturned end to where a ring
# that lies flat is around it.
MOUNT = 0.073
UPTURNED = 0.007

# How much firmer the hand holds the ring's place, against the hook's friction.
FIRM = 2.5


class ToolHangExpert:
    """Take the frame off the table, stand it up and put it into the stand; then hang the wrench on its hook by a ring.

    The ring is laid flat around the hook's upturned end, the handle beyond: let go, the wrench swings down and hangs.
    """

    MISHAPS = ONE_PUSH

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.servo = Servo(scene, rng, pace=1.4, turn=FREE, mishaps=self.MISHAPS)
        style = self.servo.style
        self.frame = Grasp(scene, style, tall=0.02, mouth=(0.012, 0.03), close=(0.012, 0.012))
        self.tool = Grasp(scene, style, tall=0.05, mouth=(0.012, 0.03), close=(0.012, 0.012))
        self.insertion = Carry(scene, self.frame, clear=rng.uniform(0.985, 1.0))
        self.hanging = Carry(scene, self.tool, clear=rng.uniform(1.08, 1.095))
        self.high = rng.uniform(1.13, 1.15)
        self.left = False

    def act(self) -> Array:
        """The action for the current state."""
        frame, rotation = self.scene.body("frame_root"), self.scene.body_rotation("frame_root")
        tip = self._site("frame_tip_site")
        mouth = self.scene.body("stand_root") + np.array([0.0, 0.045, 0.0])
        goal = np.array([*mouth[:2], TABLE + 0.026])
        grip = frame + rotation @ GRIP
        if not self.insertion.update(tip, goal, flat=0.006, height=0.018, lost=0.06):
            self.left = False
            return self._insert(grip, rotation, tip, goal)
        self.left |= float(np.linalg.norm(self.scene.hand - grip)) > 0.1
        return self._hang() if self.left else self._leave()

    def _insert(self, grip: Array, rotation: Array, tip: Array, goal: Array) -> Array:
        """Take the frame, stand it up as it rises, and lower it into the stand."""
        hand = self.scene.hand_rotation
        wanted = rotation @ ALONG
        askew = float(np.linalg.norm(rotation_vector(wanted @ hand.T)))
        target, fingers = self.frame.reach(grip + np.array([0.0, 0.0, 0.004]), askew)
        if not self.frame.held:
            return self.servo.move(target, fingers, wanted)
        left = rotation_vector(STANDING @ rotation.T)
        # the tip stays above the table while the rod is stood up
        room = float(tip[2]) - TABLE - 0.015
        # a rod between walls turns in the fingers rather than with the hand: then it is the hand that is kept straight
        top = float(self.scene.body("stand_root")[2]) + MOUNT
        inside = float(tip[2]) < top and float(np.linalg.norm((goal - tip)[:2])) < MISSED
        wanted = STANDING @ ALONG if inside else about(left) @ hand if room > 0.0 else hand
        crooked = float(np.linalg.norm(left))
        self.servo.turn = GENTLE
        target = self._lower(tip, goal, self.insertion.clear, top, crooked)
        if inside:
            # the walls hold the tip, so the hand brings the rod's upper end over it; gently, as the walls are a
            # millimetre thick and a rod that is pressed into them comes out on the other side
            target[:2] = (self.scene.hand + goal - grip)[:2]
        aside = funnel(crooked, 0.15, 0.4)
        target[:2] += (UPRIGHT_AT - target[:2]) * aside
        return self.servo.move(target, fingers, wanted)

    def _lower(self, thing: Array, goal: Array, clear: float, top: float, crooked: float) -> Array:
        """Where the hand should go to take `thing` over `goal` and, once it is straight, slowly down to it.

        It is taken there at the height `clear`, and below `top` it is inside.
        """
        away = goal - thing
        flat, rise = float(np.linalg.norm(away[:2])), clear - float(thing[2])
        inside = float(thing[2]) < top and flat < MISSED
        off = funnel(crooked, *(BENT if inside else CROOKED))
        if inside:
            down = -STEP * (1.0 - off)
        else:
            off = max(off, funnel(flat, *BESIDE))
            down = -STEP * (1.0 - off) + rise * off
            away = away * (1.0 - funnel(rise, 0.01, 0.05) * off)
        return self.scene.hand + np.array([*away[:2], down])

    def _leave(self) -> Array:
        """Open, and draw back the way that the hand points, as the hook is above it."""
        rotation = self.scene.hand_rotation
        back = -rotation[:, 2] * np.array([1.0, 1.0, 0.4])
        return self.servo.move(self.scene.hand + 0.12 * funnel(self.scene.gap, 0.05, 0.07) * back, OPEN, rotation)

    def _hang(self) -> Array:
        """Take the wrench, turn its ring to the hook and lay it around the upturned end."""
        scene = self.scene
        tool, rotation = scene.body("tool_root"), scene.body_rotation("tool_root")
        ring, hook = self._site("tool_hole1_center"), self._geom("frame_hook_frame")
        tilted = self.hanging.released or lean_of(rotation) > TILTED
        if tilted and self.hanging.update(ring, hook + AROUND, flat=0.005, height=0.006, lost=0.06):
            target, fingers = self.hanging.let_go()
            target[2] = min(float(target[2]), self.high)
            return self.servo.move(target, fingers, scene.hand_rotation)
        wanted = rotation @ OVER
        askew = float(np.linalg.norm(rotation_vector(wanted @ scene.hand_rotation.T)))
        target, fingers = self.tool.reach(tool + np.array([0.0, 0.0, 0.003]), askew)
        if self.tool.held:
            return self._hook(ring, hook, rotation)
        if not self.tool.closing and scene.hand[1] > tool[1] + 0.12:
            target = self._over(target)
        self.servo.turn = FREE
        return self.servo.move(target, fingers, wanted)

    def _hook(self, ring: Array, hook: Array, rotation: Array) -> Array:
        """Lay the ring around the upturned end, and tilt the wrench once it is."""
        around = float(ring[2] - hook[2]) < 0.003 and float(np.linalg.norm((ring - hook)[:2])) < MISSED
        tilt = np.array([0.0, TILT, 0.0]) if around else np.zeros(3)
        left = rotation_vector(about(tilt) @ rotation.T)
        lean = lean_of(rotation)
        goal = hook + np.array([0.004 * lean - 0.013 * funnel(lean, 0.55, 0.8), 0.0, -0.001 - 0.0135 * lean])
        self.servo.turn = GENTLE if around else FREE
        if around:
            target = self.scene.hand + FIRM * (goal - ring)
        else:
            crooked = float(np.linalg.norm(left))
            target = self._lower(ring, goal, self.hanging.clear, float(hook[2]) + UPTURNED, crooked)
        return self.servo.move(target, CLOSE, about(left) @ self.scene.hand_rotation)

    def _over(self, target: Array) -> Array:
        """On the way to the wrench: up first, then across above the frame."""
        hand = self.scene.hand
        across = 1.0 - funnel(self.high - float(hand[2]), 0.01, 0.05)
        return np.array([*(hand + (target - hand) * across)[:2], self.high])

    def _site(self, name: str) -> Array:
        data, model = self.scene.env.sim.data, self.scene.env.sim.model
        return np.array(data.site_xpos[model.site_name2id(name)])

    def _geom(self, name: str) -> Array:
        data, model = self.scene.env.sim.data, self.scene.env.sim.model
        return np.array(data.geom_xpos[model.geom_name2id(name)])


class RecoveringToolHangExpert(ToolHangExpert):
    """Pushed all the while: what brings the hand back where little is forgiven, at the stand and at the hook."""

    MISHAPS = Mishaps(pushed=18.0)

    @property
    def erring(self) -> bool:
        """Whether the last action was a push."""
        return self.servo.erring


def lean_of(tool: Array) -> float:
    """How far the wrench's handle hangs down from its ring: 0 where it lies flat, 1 where it hangs."""
    return float(np.clip(-tool[2, 0], 0.0, 1.0))
