"""Towers of three coloured cubes.

`StackThreeCubes`: three cubes of 4 cm, red, green and blue; green has to stand on red and blue on green.

`StackColor`: the same cubes, but the observation lists them in a random order of slots with their colours, and which
has to stand on which is the episode's goal, given as an observation: three colours from bottom to top. Demonstrations
show four of the six orders in exact colours; evaluation asks for all six, with hues slightly shifted. An episode's
`ep_meta` says its order, its slots, and whether demonstrations show the order (its group: "seen" or "unseen"); set
before a reset, it decides them.

`Recall`: StackColor whose goal is shown in the first second only, and is zeros from then on: it has to be remembered.
`RecallHeld`: the same, and while the goal is shown the arm is held, so that where the hand is does not remember it.
"""

import colorsys
import itertools
from typing import Any

import numpy as np

from actrm_harness.environments.table import Objects, OnTable, Stack, Values
from actrm_harness.simulators.robosuite.stages import Stage, fetching
from actrm_harness.wire import Array

COLORS = {"red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0), "blue": (0.0, 0.0, 1.0)}
ORDERS = tuple(itertools.permutations(COLORS))
# Every colour is seen at every height.
UNSEEN = (("red", "blue", "green"), ("green", "red", "blue"))
SEEN = tuple(order for order in ORDERS if order not in UNSEEN)

HALF = 0.02
REACH = 0.1
APART = 0.06
HUE_SHIFT = 0.05
SHOWN = 1.0
"""For how many seconds Recall shows its goal."""
HELD = 1.2
"""And RecallHeld, which holds the arm meanwhile: 24 control steps, so that who plans 2, 3, 4, 6, 8 or 12 steps ahead
has carried out what was planned in sight of the goal when the arm is free."""


def stands_on(upper: Array, lower: Array) -> bool:
    """Whether a cube stands on another: centres within 5 cm sideways and 1.5 cm of touching."""
    away = upper - lower
    return bool(np.linalg.norm(away[:2]) < 0.05 and abs(float(away[2]) - 2 * HALF) < 0.015)


class StackThreeCubes(OnTable, Stack):
    """Green on red, blue on green; reward 0.5 for the first and 1.0 for both."""

    order: tuple[str, ...] = ("red", "green", "blue")

    def make_things(self) -> dict[str, Any]:
        """The cubes, by colour."""
        return {
            name: Objects.BoxObject(name=name, size=[HALF] * 3, rgba=[*color, 1.0]) for name, color in COLORS.items()
        }

    def arrange(self) -> None:
        """Put the cubes on the table, drawn until they are far enough from one another."""
        while True:
            flat = self.rng.uniform(-REACH, REACH, size=(len(COLORS), 2))
            if min(np.linalg.norm(a - b) for a, b in itertools.combinations(flat, 2)) >= APART:
                break
        turns = self.rng.uniform(0, 2 * np.pi, size=len(COLORS))
        height = self.table_offset[2] + HALF + 0.01
        for name, (x, y), turn in zip(COLORS, flat, turns, strict=True):
            self.put(name, np.array([x, y, height]), turn)

    def values(self) -> Values:
        """Where each cube is, how it lies, and where it is from the hand."""
        values: Values = {}
        for name in COLORS:
            values[f"{name}_pos"] = lambda name=name: self.position(name)
            values[f"{name}_quat"] = lambda name=name: self.orientation(name)
        for name in COLORS:
            values[f"gripper_to_{name}"] = lambda name=name: self.position(name) - self.hand()
        return values

    def reward(self, action: Array | None = None) -> float:
        """Half for the middle cube on the lowest, one for all three."""
        del action
        first, both = self.staged_rewards()
        return max(first, both) * (1.0 if self.reward_scale is None else self.reward_scale)

    def staged_rewards(self) -> tuple[float, float]:
        """Half where the middle cube stands on the lowest, one where all three stand."""
        bottom, middle, top = (self.position(name) for name in self.order)
        first = stands_on(middle, bottom)
        return 0.5 * first, 1.0 * (first and stands_on(top, middle))

    def _check_success(self) -> bool:
        return self.staged_rewards()[1] > 0.0

    def stages(self) -> list[Stage]:
        """The middle cube fetched and put on the lowest, then the top one fetched."""
        _, middle, top = self.order
        first, second = (
            [(f"{word} {which}", judge) for word, judge in fetching(self, self.things[name], place)]
            for which, name, place in (
                ("the middle cube", middle, lambda: self.position(middle)),
                ("the top cube", top, lambda: self.position(top)),
            )
        )
        return [*first[1:], ("placed the middle cube", lambda: self.staged_rewards()[0] > 0.0), *second[1:]]


class StackColor(StackThreeCubes):
    """Stack in the order of colours that the goal names; which slot holds which cube has to be read."""

    slots: tuple[str, ...] = tuple(COLORS)

    def arrange(self) -> None:
        """Draw places, order, slots and hues, or take order and slots from the episode's description."""
        super().arrange()
        orders = SEEN if self.demonstration else ORDERS
        self.order = orders[int(self.rng.integers(len(orders)))]
        self.slots = tuple(self.rng.permutation(list(COLORS)).tolist())
        given = self._ep_meta
        if given:
            self.order, self.slots = tuple(given["order"]), tuple(given["slots"])
        shifts = self.rng.uniform(-HUE_SHIFT, HUE_SHIFT, size=len(COLORS)) * (not self.demonstration)
        for name, shift in zip(COLORS, shifts, strict=True):
            hue, saturation, value = colorsys.rgb_to_hsv(*COLORS[name])
            color = colorsys.hsv_to_rgb((hue + shift) % 1.0, saturation, value)
            for geom in self.things[name].visual_geoms:
                self.paint(geom, color)
        group = "unseen" if self.order in UNSEEN else "seen"
        self._ep_meta = {"order": list(self.order), "slots": list(self.slots), "group": group}

    def color(self, name: str) -> Array:
        """The colour that a cube shows."""
        geom = self.sim.model.geom_name2id(self.things[name].visual_geoms[0])
        return np.array(self.sim.model.geom_rgba[geom][:3], dtype=np.float64)

    def values(self) -> Values:
        """Of each slot where its cube is, how it lies, its colour and where it is from the hand; the goal."""
        values: Values = {}
        for index in range(len(COLORS)):
            values[f"slot{index}_pos"] = lambda index=index: self.position(self.slots[index])
            values[f"slot{index}_quat"] = lambda index=index: self.orientation(self.slots[index])
            values[f"slot{index}_rgb"] = lambda index=index: self.color(self.slots[index])
        for index in range(len(COLORS)):
            values[f"gripper_to_slot{index}"] = lambda index=index: self.position(self.slots[index]) - self.hand()
        values["goal_rgb"] = lambda: np.array([COLORS[name] for name in self.order]).ravel()
        return values

    def told(self) -> Values:
        """Where the cube of each place of the goal is from the hand: the answer to what has to be read."""
        return {
            f"gripper_to_place{place}": lambda place=place: self.position(self.order[place]) - self.hand()
            for place in range(len(COLORS))
        }


class Recall(StackColor):
    """StackColor whose goal is to be seen in the first second only."""

    shown = SHOWN

    def values(self) -> Values:
        """As StackColor; the goal is zeros after the first second."""
        values = super().values()
        goal = values["goal_rgb"]
        # the clock is part of a stored state, so that stored episodes look as they did
        values["goal_rgb"] = lambda: goal() * float(self.sim.data.time < self.shown - 1e-6)
        return values

    def told(self) -> Values:
        """Nothing: it would remember the goal."""
        return {}


class RecallHeld(Recall):
    """Recall whose arm does not move while the goal is shown.

    Demonstrations say what is asked of it meanwhile, as if it moved: who waited for the arm would have to see that it
    is free, and nothing that is seen says so but a goal that is gone.
    """

    shown = HELD

    def holds_arm(self) -> bool:
        """Whether the next action moves nothing, whatever it is."""
        return bool(self.sim.data.time < self.shown - 1e-6)
