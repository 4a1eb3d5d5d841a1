"""A pillar between the hand and where it has to go: there are two ways around it, and none is the better one.

`RoundPillar`: the hand begins in front of a pillar and is to reach a place behind it, at its height. The line between
the two goes through the pillar, within a centimetre; demonstrations go left or right of it by a coin. What averages
them goes straight on. The episode is lost as "struck" where the hand comes within `KEEP_OUT` of the pillar's axis: the
pillar itself is thinner and does not touch anything, so that the hand's breadth does not matter.
"""

import importlib
from typing import Any

import numpy as np

from actrm_harness.environments.table import OnTable, Stack, Values
from actrm_harness.simulators.robosuite.stages import Stage
from actrm_harness.wire import Array

KEEP_OUT = 0.065
"""From the axis, in metres; most demonstrations keep 8 to 10 cm."""
NEAR = 0.02
"""How near to the goal is there."""
AHEAD = 0.115
"""From the hand to the pillar."""
BEYOND = 0.115
"""From the pillar to the goal."""
SPREAD = 0.01
"""By which pillar and goal are aside of the line."""

_Xml: Any = importlib.import_module("robosuite.utils.mjcf_utils")


class RoundPillar(OnTable, Stack):
    """Reach the place behind the pillar without coming too near to it."""

    pillar: Array
    goal: Array

    def make_things(self) -> dict[str, Any]:
        """Nothing lies about."""
        return {}

    def furnish(self, arena: Any, robot: Any) -> None:
        """The pillar and a mark at the goal; neither touches anything."""
        del robot
        for name, size, color in (
            ("pillar", "0.03 0.12", "0.5 0.5 0.55 1"),
            ("goal_mark", "0.015 0.002", "0.1 0.8 0.2 1"),
        ):
            body = _Xml.new_body(name=name, pos="0 0 1")
            look = {"type": "cylinder", "group": "1", "contype": "0", "conaffinity": "0", "rgba": color}
            body.append(_Xml.new_geom(name=f"{name}_geom", size=size, **look))
            arena.worldbody.append(body)

    def _reset_internal(self) -> None:
        super()._reset_internal()
        if self.deterministic_reset:
            # a model that was recorded: where they stand is all that is left of what was drawn
            self.sim.forward()
            self.pillar, self.goal = self._stands("pillar"), self._stands("goal_mark")

    def _stands(self, name: str) -> Array:
        """Where a body of the model is, at the height of the hand."""
        place = self.sim.model.body_pos[self.sim.model.body_name2id(name)]
        return np.array([place[0], place[1], self.hand()[2]])

    def arrange(self) -> None:
        """Put the pillar in front of the hand and the goal behind it."""
        self.sim.forward()
        hand = self.hand()
        aside = self.rng.uniform(-SPREAD, SPREAD, size=4)
        self.pillar = np.array([hand[0] + AHEAD + aside[0], hand[1] + aside[1], hand[2]])
        self.goal = np.array([self.pillar[0] + BEYOND + aside[2], self.pillar[1] + aside[3], hand[2]])
        for name, place in (("pillar", self.pillar), ("goal_mark", self.goal)):
            body = self.sim.model.body_name2id(name)
            height = float(self.table_offset[2]) + (0.12 if name == "pillar" else 0.002)
            self.sim.model.body_pos[body] = [place[0], place[1], height]

    def reward(self, action: Array | None = None) -> float:
        """One at the goal."""
        del action
        return float(self._check_success()) * (1.0 if self.reward_scale is None else self.reward_scale)

    def _check_success(self) -> bool:
        return float(np.linalg.norm(self.hand() - self.goal)) < NEAR and self.failure() is None

    def stages(self) -> list[Stage]:
        """Beside the pillar."""
        return [("beside the pillar", lambda: bool(self.hand()[0] > self.pillar[0]))]

    def failure(self) -> str | None:
        """Why it is lost: "struck" too near to the pillar."""
        return "struck" if float(np.linalg.norm((self.hand() - self.pillar)[:2])) < KEEP_OUT else None

    def values(self) -> Values:
        """Where the pillar and the goal are, and both from the hand."""
        return {
            "pillar_pos": lambda: self.pillar,
            "goal_pos": lambda: self.goal,
            "hand_to_pillar": lambda: self.pillar - self.hand(),
            "hand_to_goal": lambda: self.goal - self.hand(),
        }
