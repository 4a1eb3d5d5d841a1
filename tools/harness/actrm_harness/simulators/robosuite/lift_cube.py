"""Lift's cube, drawn anew in a model that is kept.

robosuite draws the size of Lift's cube when it loads the model, so every episode of Lift pays for loading it: 150 to
270 ms and 150 MB. Here the size is drawn in the same order from the same generator; what MuJoCo's compiler makes of it
(mass, inertia, bounds) is taken from a model of the cube alone, and `mj_setConst`, which the compiler ends with,
computes the constants of the whole. Every number of the model is then the one that loading gives; a test compares.
"""

import copy
import importlib
from typing import Any

from actrm_harness.simulators.robosuite import lean
from actrm_harness.simulators.robosuite.suite import Env

_NAME = "cube"
_SMALLEST, _LARGEST = [0.020] * 3, [0.022] * 3


def redraw(env: Env) -> None:
    """Draw the cube's size as `Lift._load_model` does, and put it into the model and the placement sampler."""
    lift: Any = env
    sizes: Any = importlib.import_module("robosuite.utils.mjcf_utils")
    size = sizes.get_size(None, _LARGEST, _SMALLEST, [0.07] * 3, [0.03] * 3, rng=env.rng)
    lift.cube.size = size
    lift.placement_initializer.reset()
    lift.placement_initializer.add_objects(lift.cube)
    _resize(env.sim.model._model, env.sim.data._data, _alone(lift, size))


def _alone(lift: Any, size: Any) -> Any:
    """The compiled model of a cube of this size and nothing else."""
    tree: Any = importlib.import_module("xml.etree.ElementTree")
    box: Any = importlib.import_module("robosuite.models.objects").BoxObject
    root = tree.Element("mujoco")
    for tag in ("compiler", "option"):
        root.append(copy.deepcopy(lift.model.root.find(tag)))
    tree.SubElement(root, "worldbody").append(box(name=_NAME, size=size, rgba=[1, 0, 0, 1]).get_obj())
    return lean.compiled(tree.tostring(root, encoding="unicode"))


def _resize(model: Any, data: Any, alone: Any) -> None:
    """Give the model's cube the numbers of the one alone, and compute the constants that follow from them."""
    names = [alone.body(body).name for body in range(1, alone.nbody)]
    for name in names:
        mine, its = model.body(name).id, alone.body(name).id
        for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
            getattr(model, field)[mine] = getattr(alone, field)[its]
        first, count = int(model.body_bvhadr[mine]), int(model.body_bvhnum[mine])
        start = int(alone.body_bvhadr[its])
        if count > 0:
            model.bvh_aabb[first : first + count] = alone.bvh_aabb[start : start + count]
    for geom in range(alone.ngeom):
        mine = model.geom(alone.geom(geom).name).id
        for field in ("geom_size", "geom_aabb", "geom_rbound"):
            getattr(model, field)[mine] = getattr(alone, field)[geom]
    importlib.import_module("mujoco").mj_setConst(model, data)
