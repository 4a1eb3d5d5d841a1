"""How able whoever shows a task is: good, middling or poor.

A skill changes how an expert moves and what goes wrong on the way, not what it wants: its actions still follow from
what can be observed, and it makes up for what its demonstrator did. What a demonstrator draws comes from a generator of
its own, so that a good one's episode is the same whoever else shows others.
"""

import math
from dataclasses import dataclass

import numpy as np

from actrm_harness.protocol import RequestError
from actrm_harness.wire import Array

Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Skill:
    """How able somebody is. Ranges are drawn from once an episode, chances are taken whenever they matter."""

    name: str
    speed: Range = (1.0, 1.0)
    """Factor of the style's speed."""
    tremble: Range = (1.0, 1.0)
    """Factor of the style's noise at full speed: whoever moves slowly trembles no more than others."""
    height: Range = (1.0, 1.0)
    """Factor of the height from which a thing is approached."""
    askew: float = 0.0
    """How far the hand may be turned about the vertical, in radians, where an expert leaves it as it was."""
    unsteady: float = 0.0
    """The share of its speed by which the hand is slower now, and half of it by which it is faster then."""
    paused: float = math.inf
    """Steps between two hesitations on average."""
    detours: float = 0.0
    """Chance that a way leads over a point beside or beyond it."""
    misses: float = 0.0
    """Chance that the fingers close on nothing."""
    regrasps: float = 0.0
    """Chance that what was just taken is let go and taken again."""


SKILLS = {
    skill.name: skill
    for skill in (
        Skill("good"),
        Skill(
            "middling",
            speed=(0.75, 1.0),
            tremble=(1.0, 1.4),
            height=(0.9, 1.5),
            askew=0.3,
            unsteady=0.3,
            paused=60.0,
            detours=0.3,
            misses=0.2,
            regrasps=0.1,
        ),
        Skill(
            "poor",
            speed=(0.6, 0.9),
            tremble=(1.2, 1.8),
            height=(0.8, 1.6),
            askew=0.6,
            unsteady=0.5,
            paused=40.0,
            detours=0.5,
            misses=0.35,
            regrasps=0.15,
        ),
    )
}

# Who may show an episode, by what a collection asks for.
SHOWN_BY = {"good": ("good",), "mixed": ("good", "middling", "poor"), "poor": ("poor",)}

USUAL = "good"

# How long a hesitation lasts, how often an unsteady hand changes its speed, how long it draws back at least: steps.
PAUSE = (4, 14)
STEADY = (3, 9)
BACK = (4, 9)
# It draws back until its fingers are this far open, but no longer than so many steps more.
OPENED, OPENING = 0.075, 12

# A way gets a detour where it leads this far sideways and in all; how far beside and beyond it that is. Metres.
SIDEWAYS, FAR = 0.04, 0.08
BESIDE, BEYOND, HIGHER = (0.05, 0.12), (0.03, 0.06), (0.0, 0.05)
BESIDES = 0.7
"""Share of the detours that are beside the way; the others overshoot."""

# Within this of a detour's point, or after so many steps, the hand goes on.
PASSED, PATIENCE = 0.02, 40

# How far beside a thing, and how far above its top, the fingers close on nothing.
MISSED_BESIDE, MISSED_ABOVE = (0.042, 0.05), (0.03, 0.045)
# Where the hand cannot get there, it gives up after so many steps.
TIRED = 15


class Demonstrator:
    """Who shows an episode: a skill, and what is drawn of it once."""

    def __init__(self, skill: Skill, rng: np.random.Generator) -> None:
        self.skill = skill
        self.rng = rng
        self.speed = rng.uniform(*skill.speed)
        self.tremble = rng.uniform(*skill.tremble)
        self.height = rng.uniform(*skill.height)
        self.askew = rng.uniform(-skill.askew, skill.askew)
        self.side = 1.0 if rng.random() < 0.5 else -1.0
        # a slow hand's detours and second tries take longer, too
        self.slowness = self.speed**-2.0
        """How much longer this demonstrator's episodes are, about: so much rarer are mishaps that come from outside."""
        self.arms = 0
        """How many arms move in this demonstrator's manner."""

    @staticmethod
    def draw(asked: str | None, seed: int) -> "Demonstrator":
        """Who shows the episode of a seed where a collection asks for this skill; RequestError where there is none."""
        names = SHOWN_BY.get(USUAL if asked is None else asked)
        if names is None:
            raise RequestError("no_skill", f"unknown skill {asked!r}; known: {', '.join(SHOWN_BY)}")
        rng = np.random.default_rng([seed, 2])
        return Demonstrator(SKILLS[names[int(len(names) * rng.random())]], rng)

    def chance(self, share: float) -> bool:
        """Whether something happens that does so this often."""
        return bool(self.rng.random() < share)

    def steps(self, least: int, most: int) -> int:
        """A number of steps, both ends included."""
        return least + int((most + 1 - least) * self.rng.random())


class Manner:
    """How a demonstrator moves one arm: hesitating, unsteady, and over points beside the way."""

    def __init__(self, shown_by: Demonstrator) -> None:
        self.shown_by = shown_by
        shown_by.arms += 1
        self._until_pause = self._draw_pause()
        self._still = 0
        self._haste, self._kept = 1.0, 0
        self._grip = 0.0
        self._decided = False
        self._via: Array | None = None
        self._patience = 0

    def _draw_pause(self) -> float:
        return 1.0 + 2.0 * self.shown_by.skill.paused * self.shown_by.rng.random()

    def haste(self) -> float:
        """The factor of the hand's speed in this step: 0 while it hesitates, 1 throughout for a good demonstrator."""
        if self._still > 0:
            self._still -= 1
            return 0.0
        self._until_pause -= 1.0
        if self._until_pause <= 0.0:
            self._still, self._until_pause = self.shown_by.steps(*PAUSE), self._draw_pause()
        self._kept -= 1
        if self._kept < 0:
            self._kept = self.shown_by.steps(*STEADY)
            self._haste = 1.0 + self.shown_by.skill.unsteady * self.shown_by.rng.uniform(-1.0, 0.5)
        return self._haste

    def onward(self, hand: Array, target: Array, grip: float, base: Array) -> Array:
        """Where the hand goes now on its way to `target`: there, or to a detour's point.

        A way ends where the fingers are told otherwise. What is held, or let go, is not moved sideways before it is
        high enough to be carried, because its expert does not ask for that either.
        """
        if grip != self._grip:
            self._grip, self._via, self._decided = grip, None, False
        if self._via is not None:
            self._patience -= 1
            if self._patience <= 0 or float(np.linalg.norm(self._via - hand)) < PASSED:
                # the rest of the way may have another
                self._via, self._decided = None, False
        way = target - hand
        if not self._decided and np.linalg.norm(way[:2]) > SIDEWAYS and np.linalg.norm(way) > FAR:
            self._decided = True
            if self.shown_by.chance(self.shown_by.skill.detours):
                self._via, self._patience = self._point(hand, way, base), PATIENCE
        return target if self._via is None else self._via

    def tremble(self, share: float) -> float:
        """The factor of the noise where the hand moves at this share of its speed."""
        return 1.0 + (self.shown_by.tremble - 1.0) * share

    def _point(self, hand: Array, way: Array, base: Array) -> Array:
        """A point beside the way on this demonstrator's side, or beyond its end; above both ends."""
        rng = self.shown_by.rng
        along = way[:2] / np.linalg.norm(way[:2])
        if self.shown_by.chance(BESIDES):
            across = self.shown_by.side * np.array([-along[1], along[0]])
            place = hand[:2] + rng.uniform(0.3, 0.7) * way[:2] + rng.uniform(*BESIDE) * across
        else:
            place = hand[:2] + way[:2] + rng.uniform(*BEYOND) * along
        # no further out than the way itself leads: a stretched elbow stays so
        reach = max(float(np.linalg.norm((end - base)[:2])) for end in (hand, hand + way))
        out = place - base[:2]
        place = base[:2] + out * min(1.0, reach / float(np.linalg.norm(out)))
        return np.array([*place, max(float(hand[2]), float(hand[2] + way[2])) + rng.uniform(*HIGHER)])


class Slips:
    """What goes wrong when one hand takes hold of a thing: it closes on nothing, or lets go and takes it again.

    `above` is how far a thing stands up above the point that is gripped; `beside` whether it may be missed sideways.
    """

    def __init__(self, shown_by: Demonstrator, above: float, beside: bool) -> None:
        self.shown_by = shown_by
        self.above = above
        self.beside = beside
        self._back = -OPENING
        self._tried = 0
        self._slip = self._draw()

    def _draw(self) -> Array:
        """In the hand's frame, how far off the fingers close the next time."""
        rng = self.shown_by.rng
        if not self.shown_by.chance(self.shown_by.skill.misses):
            return np.zeros(3)
        self._tried = 0
        if self.beside and self.shown_by.chance(0.5):
            return np.array([0.0, self.shown_by.side * rng.uniform(*MISSED_BESIDE), 0.0])
        return np.array([0.0, 0.0, -self.above - rng.uniform(*MISSED_ABOVE)])

    def off(self, rotation: Array) -> Array:
        """How far off the fingers go for the thing, for a hand of this rotation."""
        return rotation @ self._slip

    def near(self) -> None:
        """The hand is close to where it goes: it is not forever so."""
        self._tried += 1
        if self._tried > TIRED:
            self._slip = np.zeros(3)

    def missed(self) -> None:
        """The fingers met: draw back, and try again."""
        self._slip = self._draw()
        self._draw_back()

    def lets_go(self) -> bool:
        """Whether what was just taken is let go, to be taken again."""
        if not self.shown_by.chance(self.shown_by.skill.regrasps):
            return False
        self._draw_back()
        return True

    def _draw_back(self) -> None:
        if self.shown_by.skill.name != USUAL:
            self._back = self.shown_by.steps(*BACK)

    def back(self, hand: Array, rotation: Array, gap: float) -> Array | None:
        """Where the hand draws back to, while it does: fingers that are half open would seem to hold something."""
        if self._back <= -OPENING or (self._back <= 0 and gap > OPENED):
            self._back = -OPENING
            return None
        self._back -= 1
        return hand - 0.06 * rotation[:, 2]
