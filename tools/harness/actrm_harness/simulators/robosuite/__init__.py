"""robosuite 1.5.

`suite` is robosuite behind types; `envs` makes, seeds, steps and observes an environment; `episodes` records what an
expert does and looks at stored states; `control*` is the compiled control loop's Python side; `render` draws images;
`lean` and `lift_cube` make resets cheap; `simulation` is what the worker speaks to.
"""

from actrm_harness.simulators import Options, Requirements, Simulation

REQUIREMENTS = Requirements(("mujoco", "robosuite", "numba"), install="make venv")


def prepare() -> None:
    """What has to be set before anybody imports the simulator."""
    from actrm_harness.simulators.robosuite import suite

    suite.prepare()


def start(options: Options) -> Simulation:
    """Import robosuite and make the environment."""
    prepare()
    from actrm_harness.simulators.robosuite.simulation import Robosuite

    return Robosuite.start(options)
