"""Which cube to lift: the hand does what Lift asks of it, only the choice is hard.

Small cubes of different colours lie on the table. Lifting the right one is success; lifting another ends the episode,
and is counted apart as "wrong".

`PickChain`: twelve cubes; each points to the colour of another one, or to its own. The goal names a colour to start
from, and the cube to lift is the one at the end of the chain that begins there: the one that points to itself. The
cubes form three chains, each of two cubes or more, so that three cubes are ends, each with one cube that points to it,
and a guess among the ends is right one time in three. How many hops lead from the start to the end, 0 to 7, is drawn
evenly and is the episode's group. Demonstrations have at most 4.

`PickAny`: the goal names the colour of the cube itself, among 1 to 7 others; how many is drawn evenly and is the
group. Cubes that are not there are seen as zeros.

The hand always begins in the same pose: from another one in each episode, a policy would know its demonstrations by
heart, and with them which cube was meant, before it knew the rule.

Colours are seen one-hot, so that renaming them is a permutation of columns: of `cubeN_color`, `cubeN_points` and
`goal_color` alike.
"""

import colorsys
import importlib
import itertools
from typing import Any

import numpy as np

from actrm_harness.environments.table import Objects, OnTable, Stack, Values
from actrm_harness.simulators.robosuite.stages import Stage, fetching
from actrm_harness.wire import Array

HALF = 0.016
LIFTED = 0.04
"""How high above the table the centre of a cube is when it counts as lifted."""

# Places: far enough apart along y, where the fingers open, that no hand touches a neighbour.
ROWS, COLUMNS = 3, 4
STEP_X, STEP_Y = 0.085, 0.11
JITTER = 0.014

MOST_HOPS = 7
DEMONSTRATED_HOPS = 4
CHAINS = 3
SHORTEST = 2

_Box: Any = Objects.BoxObject
_Xml: Any = importlib.import_module("robosuite.utils.mjcf_utils")


def palette(count: int) -> list[tuple[float, float, float]]:
    """Colours that are easy to tell apart, for cameras."""
    return [colorsys.hsv_to_rgb(k / count, 1.0 if k % 2 else 0.65, 0.95 if k % 3 else 0.6) for k in range(count)]


class MarkedCube(_Box):
    """A cube with a mark on its top, in the colour that it points to."""

    def _get_object_subtree(self) -> Any:
        base: Any = super()
        tree: Any = base._get_object_subtree()
        geom: Any = {**self.get_visual_attrib_template(), "name": "mark", "type": "box", "rgba": "0.5 0.5 0.5 1"}
        geom |= {"size": f"{0.55 * HALF} {0.55 * HALF} 0.0005", "pos": f"0 0 {HALF}"}
        tree.insert(2, _Xml.new_geom(**geom))
        return tree


class Picking(OnTable):
    """Cubes in the cells of a grid, one of which is to be lifted."""

    joined = False
    count: int
    colors: list[int]
    """The colour of each cube."""
    target: int = 0
    """The cube to lift."""

    def make_things(self) -> dict[str, Any]:
        """All cubes; colours come with the episode."""
        return {f"cube{k}": MarkedCube(name=f"cube{k}", size=[HALF] * 3, rgba=[0.5, 0.5, 0.5, 1]) for k in self.cubes()}

    def cubes(self) -> range:
        """The cubes, by number."""
        return range(self.count)

    def scatter(self, present: list[int]) -> None:
        """Put these cubes in cells of the grid, drawn without order, and the others out of the way."""
        cells = self.rng.permutation(ROWS * COLUMNS)[: len(present)]
        jitter = self.rng.uniform(-JITTER, JITTER, size=(len(present), 2))
        turns = self.rng.uniform(0, 2 * np.pi, size=len(present))
        height = float(self.table_offset[2]) + HALF + 0.002
        for cube, cell, shift, turn in zip(present, cells.tolist(), jitter, turns.tolist(), strict=True):
            x = (cell // COLUMNS - (ROWS - 1) / 2) * STEP_X + shift[0]
            y = (cell % COLUMNS - (COLUMNS - 1) / 2) * STEP_Y + shift[1]
            self.put(f"cube{cube}", np.array([x, y, height]), turn)
        for cube in sorted(set(self.cubes()) - set(present)):
            self.put(f"cube{cube}", np.array([2.0 + 0.1 * cube, 2.0, HALF]), 0.0)

    def lifted(self) -> list[int]:
        """The cubes that are up."""
        limit = float(self.table_offset[2]) + LIFTED
        return [cube for cube in self.cubes() if self.sim.data.body_xpos[self.body_ids[f"cube{cube}"]][2] > limit]

    def reward(self, action: Array | None = None) -> float:
        """One where the right cube is up, and it alone."""
        del action
        return float(self._check_success()) * (1.0 if self.reward_scale is None else self.reward_scale)

    def _check_success(self) -> bool:
        return self.lifted() == [self.target]

    def stages(self) -> list[Stage]:
        """At the right cube, and holding it."""
        name = f"cube{self.target}"
        return fetching(self, self.things[name], lambda: self.position(name))[:2]

    def failure(self) -> str | None:
        """Why the episode is lost: "wrong" where another cube is up."""
        return "wrong" if set(self.lifted()) - {self.target} else None

    def one_hot(self, color: int | None) -> Array:
        """A colour as it is seen; None: nothing."""
        return np.array([float(color == each) for each in self.cubes()])


class PickChain(Picking, Stack):
    """Lift the cube at the end of the chain that begins at the colour that the goal names."""

    count = 12
    points: list[int]
    """The colour that each cube points to."""
    start: int = 0
    """The colour that the goal names."""
    hops: int = 0

    def arrange(self) -> None:
        """Draw chains, colours and places, or take chains and colours from the episode's description."""
        given = self._ep_meta
        most = DEMONSTRATED_HOPS if self.demonstration else MOST_HOPS
        hops = int(self.rng.integers(most + 1))
        chains = self._chains(hops)
        colors = self.rng.permutation(self.count).tolist()
        self.scatter(list(self.cubes()))
        points = [0] * self.count
        for chain in chains:
            for here, onward in itertools.pairwise([*chain, chain[-1]]):
                points[here] = colors[onward]
        start = colors[chains[0][-1 - hops]]
        if given:
            colors, points, start = list(given["colors"]), list(given["points"]), int(given["start"])
        self.colors, self.points, self.start = colors, points, start
        self.target, self.hops = self.follow()
        for cube in self.cubes():
            shades = palette(self.count)
            thing = self.things[f"cube{cube}"]
            for geom in thing.visual_geoms:
                self.paint(geom, shades[(points if geom.endswith("mark") else colors)[cube]])
        self._ep_meta = {
            "colors": colors,
            "points": points,
            "start": start,
            "hops": self.hops,
            "group": f"{self.hops} hops",
        }

    def _chains(self, hops: int) -> list[list[int]]:
        """Cubes in three chains; the first is long enough for a start that is so many hops from its end.

        Its length is drawn evenly among those that leave the others two cubes each, and so is how the rest is divided.
        """
        least, most = max(hops + 1, SHORTEST), self.count - (CHAINS - 1) * SHORTEST
        first = int(self.rng.integers(least, most + 1))
        second = int(self.rng.integers(SHORTEST, self.count - first - SHORTEST + 1))
        order = self.rng.permutation(self.count).tolist()
        return [order[:first], order[first : first + second], order[first + second :]]

    def follow(self) -> tuple[int, int]:
        """The cube at the end of the chain from the start, and how many hops away it is."""
        cube = self.colors.index(self.start)
        for hops in range(self.count):
            if self.points[cube] == self.colors[cube]:
                return cube, hops
            cube = self.colors.index(self.points[cube])
        raise ValueError(f"no end is reached from colour {self.start}: {self.colors}, {self.points}")

    def values(self) -> Values:
        """Of each cube where it is, its colour, the colour it points to and where it is from the hand; the start."""
        values: Values = {}
        for k in self.cubes():
            values[f"cube{k}_pos"] = lambda k=k: self.position(f"cube{k}")
            values[f"cube{k}_color"] = lambda k=k: self.one_hot(self.colors[k])
            values[f"cube{k}_points"] = lambda k=k: self.one_hot(self.points[k])
            values[f"gripper_to_cube{k}"] = lambda k=k: self.position(f"cube{k}") - self.hand()
        values["goal_color"] = lambda: self.one_hot(self.start)
        return values


class PickAny(Picking, Stack):
    """Lift the cube of the colour that the goal names."""

    count = 8
    present: list[int]

    def arrange(self) -> None:
        """Draw how many cubes there are, which, their colours and places."""
        given = self._ep_meta
        others = 1 + int(self.rng.integers(self.count - 1))
        present = sorted(self.rng.permutation(self.count)[: others + 1].tolist())
        target = int(self.rng.permutation(present)[0])
        colors = self.rng.permutation(self.count).tolist()
        if given:
            present, target, colors = list(given["present"]), int(given["target"]), list(given["colors"])
        self.present, self.target, self.colors = present, target, colors
        self.scatter(present)
        for cube in self.cubes():
            for geom in self.things[f"cube{cube}"].visual_geoms:
                self.paint(geom, palette(self.count)[colors[cube]])
        others = len(present) - 1
        group = f"{others} other{'s' * (others > 1)}"
        self._ep_meta = {"present": present, "target": target, "colors": colors, "group": group}

    def values(self) -> Values:
        """Of each cube where it is, its colour and where it is from the hand, zeros if it is not there; the goal."""
        values: Values = {}

        def seen(k: int, value: Array) -> Array:
            return value if k in self.present else np.zeros_like(value)

        for k in self.cubes():
            values[f"cube{k}_pos"] = lambda k=k: seen(k, self.position(f"cube{k}"))
            values[f"cube{k}_color"] = lambda k=k: seen(k, self.one_hot(self.colors[k]))
            values[f"gripper_to_cube{k}"] = lambda k=k: seen(k, self.position(f"cube{k}") - self.hand())
        values["goal_color"] = lambda: self.one_hot(self.colors[self.target])
        return values
