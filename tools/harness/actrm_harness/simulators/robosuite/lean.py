"""Cheaper resets and a smaller process, without changing a bit of an episode.

Where a worker's time and memory went (Lift): at every loading of the model robosuite compiles the robot alone as well,
for inverse-kinematics controllers only (51 MB and a third of the time); freeing the old simulation collects garbage
among all objects of numba, scipy and robosuite (another third); MuJoCo keeps the last text it compiled, with its
textures and meshes, for whoever wants to write it out (134 MB, and twice that while the next one is compiled); and it
keeps the files it read, decoded, for the next compilation (105 MB).
"""

import ctypes
import gc
import importlib
from functools import cache
from typing import Any

from actrm_harness.simulators.robosuite.control_abi import ControlError, mujoco_library

_MODEL = "_compiled_when_asked"


@cache
def prepare() -> None:
    """Once in a process, after robosuite is imported and before an environment is made."""
    kind: Any = importlib.import_module("robosuite.models.robots.robot_model").RobotModel
    kind.set_mujoco_model = _set_mujoco_model
    kind.mujoco_model = property(_mujoco_model, _set_mujoco_model)
    # modules stay anyway: a later collection need not look at them
    gc.collect()
    gc.freeze()


def forget_xml(give_back: bool) -> None:
    """Let MuJoCo forget the text it compiled last; with `give_back` the files it read too, and the memory is returned.

    The model can then no longer be written as MJCF, and loading it again reads all files again (about a second).
    """
    free = _function("mj_freeLastXML")
    if free is None:
        return
    free()
    if give_back:
        _forget_files()
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def compiled(xml: str) -> Any:
    """The model of this MJCF, through `MjSpec`, which leaves the text that the scene is written from as it is."""
    mujoco: Any = importlib.import_module("mujoco")
    if overwrites_the_scene():
        return mujoco.MjModel.from_xml_string(xml)
    return mujoco.MjSpec.from_string(xml).compile()


def overwrites_the_scene() -> bool:
    """Whether compiling another model takes the place of the scene's text: MuJoCo has `MjSpec` from 3.2 on."""
    return not hasattr(importlib.import_module("mujoco"), "MjSpec")


def _forget_files() -> None:
    cache_of, clear = _function("mj_getCache"), _function("mj_clearCache")
    if cache_of is not None and clear is not None:
        cache_of.restype, clear.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
        clear(cache_of())


@cache
def _function(name: str) -> Any:
    try:
        return getattr(mujoco_library(), name, None)
    except ControlError:
        return None


def _set_mujoco_model(robot_model: Any, model: Any = None) -> None:
    robot_model.__dict__[_MODEL] = model


def _mujoco_model(robot_model: Any) -> Any:
    """Compile the robot alone, when somebody looks at it; the scene's text stays the last one."""
    if robot_model.__dict__.get(_MODEL) is None:
        tree: Any = importlib.import_module("xml.etree.ElementTree")
        robot_model.__dict__[_MODEL] = compiled(tree.tostring(robot_model.root, encoding="unicode"))
    return robot_model.__dict__[_MODEL]
