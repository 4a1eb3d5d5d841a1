"""What Wipe draws when its model is loaded, drawn where the model is kept.

robosuite lays a line of dirt while it makes the model and another one over it when the episode begins. Only the second
is seen; the first has to be drawn from the same generator all the same, so that an episode is the one of its seed.
"""

from typing import Any

from actrm_harness.simulators.robosuite.suite import Env


def redraw(env: Env) -> None:
    """Draw a line as `WipeArena.configure_location` does, and forget it."""
    arena: Any = env.model.mujoco_arena
    place = arena.sample_start_pos()
    for index in range(arena.num_markers):
        if arena.two_clusters and index == arena.num_markers // 2:
            place = arena.sample_start_pos()
        place = arena.sample_path_pos(place)
