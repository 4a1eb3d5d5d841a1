"""The table of tasks: what this package knows about a task beyond its environment's name.

A row names its simulator (a module of `simulators`), where its environment and its expert are defined, and how long an
episode may be. A task that has no row is an environment of robosuite's, with a row of defaults; a module of one's own
adds a row with `register`. Nothing here imports a simulator: what a row names is imported when it is wanted.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

DEFAULT_MAX_STEPS = 400

PACKAGE = "actrm_harness"

TOWERS = {
    "recoveries": ".experts.cubes:RecoveringTowerExpert",
    "regrasps": ".experts.cubes:RegraspingTowerExpert",
    "misreaches": ".experts.cubes:MisreachingTowerExpert",
}
PANDAS = {"robots": ["Panda", "Panda"]}


@dataclass(frozen=True, slots=True)
class Task:
    """One row. Places are written `module:name`, the module beginning with a dot where it is one of this package."""

    name: str
    simulator: str = "robosuite"
    defined_in: str | None = None
    """The module that defines the environment; None where the simulator brings it."""
    expert: str | Callable[..., Any] | None = None
    """The scripted expert, or the place of it."""
    experts: dict[str, str] = field(default_factory=dict[str, str])
    """Further experts by their names, for demonstrations of another kind."""
    bar: float = 0.95
    """The share of episodes that the expert has to solve."""
    max_steps: int = DEFAULT_MAX_STEPS
    soft_reset: bool = False
    """Whether the model may be kept between episodes."""
    arguments: dict[str, Any] = field(default_factory=dict[str, Any])
    """What the environment's class is given beside the usual."""
    redraw: str | None = None
    """The place of a function that draws into a kept model what loading the model would draw."""


TASKS = {
    task.name: task
    for task in (
        Task(
            "Lift", expert=".experts.cubes:LiftExpert", soft_reset=True, redraw=".simulators.robosuite.lift_cube:redraw"
        ),
        Task("Stack", expert=".experts.cubes:StackExpert", soft_reset=True),
        Task("PickPlaceCan", expert=".experts.objects:CanExpert", soft_reset=True),
        Task("PickPlaceMilk", expert=".experts.objects:MilkExpert", soft_reset=True),
        Task("PickPlaceBread", expert=".experts.objects:BreadExpert", soft_reset=True),
        Task("PickPlaceCereal", expert=".experts.objects:CerealExpert", soft_reset=True),
        Task(
            "PickPlace",
            expert=".experts.objects:AllThingsExpert",
            experts={"recoveries": ".experts.objects:RecoveringThingsExpert"},
            soft_reset=True,
            max_steps=1200,
        ),
        Task("NutAssembly", expert=".experts.objects:AllNutsExpert", soft_reset=True, max_steps=800),
        Task("NutAssemblyRound", expert=".experts.objects:RoundExpert", soft_reset=True),
        Task(
            "NutAssemblySquare",
            expert=".experts.objects:SquareExpert",
            experts={
                "recoveries": ".experts.objects:RecoveringSquareExpert",
                "regrasps": ".experts.objects:RegraspingSquareExpert",
                "misreaches": ".experts.objects:MisreachingSquareExpert",
            },
            soft_reset=True,
            bar=0.85,
        ),
        Task("Door", expert=".experts.objects:DoorExpert", soft_reset=True, bar=0.85),
        Task(
            "Wipe", expert=".experts.wipes:WipeExpert", soft_reset=True, redraw=".simulators.robosuite.wipe_dirt:redraw"
        ),
        Task(
            "StackThreeCubes",
            defined_in=".environments.towers",
            expert=".experts.cubes:TowerExpert",
            experts=TOWERS,
            soft_reset=True,
            max_steps=600,
        ),
        Task(
            "StackColor",
            defined_in=".environments.towers",
            expert=".experts.cubes:TowerExpert",
            experts=TOWERS,
            soft_reset=True,
            max_steps=600,
        ),
        Task(
            "Recall",
            defined_in=".environments.towers",
            expert=".experts.cubes:TowerExpert",
            experts=TOWERS,
            soft_reset=True,
            max_steps=600,
        ),
        Task(
            "RecallHeld",
            defined_in=".environments.towers",
            expert=".experts.cubes:TowerExpert",
            experts=TOWERS,
            soft_reset=True,
            max_steps=600,
        ),
        Task(
            "PickChain",
            defined_in=".environments.picks",
            expert=".experts.picks:PickExpert",
            soft_reset=True,
            max_steps=200,
            arguments={"initialization_noise": None},
        ),
        Task(
            "PickAny",
            defined_in=".environments.picks",
            expert=".experts.picks:PickExpert",
            soft_reset=True,
            max_steps=200,
            arguments={"initialization_noise": None},
        ),
        Task(
            "TableMaze",
            defined_in=".environments.mazes",
            expert=".experts.mazes:MazeExpert",
            soft_reset=True,
            max_steps=300,
            arguments={"initialization_noise": None},
        ),
        Task(
            "TableMaze10",
            defined_in=".environments.mazes",
            expert=".experts.mazes:MazeExpert",
            soft_reset=True,
            max_steps=400,
            arguments={"initialization_noise": None},
        ),
        Task(
            "RoundPillar",
            defined_in=".environments.pillars",
            expert=".experts.pillars:PillarExpert",
            soft_reset=True,
            max_steps=150,
            arguments={"initialization_noise": None},
        ),
        Task(
            "ToolHang",
            expert=".experts.tools:ToolHangExpert",
            experts={"recoveries": ".experts.tools:RecoveringToolHangExpert"},
            soft_reset=True,
            max_steps=700,
        ),
        Task("TwoArmLift", expert=".experts.arms:TwoArmLiftExpert", soft_reset=True, arguments=PANDAS),
        Task("TwoArmHandover", expert=".experts.arms:TwoArmHandoverExpert", arguments=PANDAS),
        Task("TwoArmPegInHole", expert=".experts.arms:TwoArmPegInHoleExpert", arguments=PANDAS),
        Task(
            "TwoArmTransport",
            expert=".experts.arms:TwoArmTransportExpert",
            experts={"recoveries": ".experts.arms:RecoveringTransportExpert"},
            arguments=PANDAS,
            max_steps=700,
        ),
    )
}

FAMILIES = {
    task.name: task
    for task in (
        Task("libero_", simulator="libero"),
        # openpi, OpenVLA and LeRobot (docs/howto/libero.md); LIBERO-PRO's suites begin with the names of LIBERO's
        Task("libero_spatial", simulator="libero", max_steps=220),
        Task("libero_object", simulator="libero", max_steps=280),
        Task("libero_goal", simulator="libero", max_steps=300),
        Task("libero_10", simulator="libero", max_steps=520),
        Task("libero_90", simulator="libero", max_steps=400),
    )
}
"""Rows of many tasks, by what their names begin with: `SUITE/NUMBER`, or `SUITE` for all of its tasks."""


def register(task: Task) -> None:
    """Add a row, or take the place of one."""
    TASKS[task.name] = task


def row(name: str) -> Task:
    """The row of a task; a row of defaults where it has none."""
    if name in TASKS:
        return TASKS[name]
    families = (task for prefix, task in FAMILIES.items() if name.startswith(prefix))
    family = max(families, key=lambda task: len(task.name), default=Task(name))
    return replace(family, name=name)


def find(place: str | Callable[..., Any]) -> Any:
    """What stands at a place; the thing itself where it is one."""
    if not isinstance(place, str):
        return place
    module, _, name = place.partition(":")
    found = importlib.import_module(module, PACKAGE)
    return getattr(found, name) if name else found
