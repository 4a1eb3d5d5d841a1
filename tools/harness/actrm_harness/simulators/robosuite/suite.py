"""robosuite and mujoco behind types: the few attributes that this package uses, and nothing else of them.

robosuite has no type hints, so it is imported by name here and seen through protocols everywhere else. Importing this
module imports the simulator; `prepare` must have run before (it sets what they read from the environment).
"""

import importlib
import os
import tempfile
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from actrm_harness.wire import Array

# What the user asked for; `prepare` hides it from the imports, `render` follows it.
WANTED_GL = os.environ.get("MUJOCO_GL", "").lower()


class State(Protocol):
    """A flattened simulator state: time, qpos, qvel."""

    def flatten(self) -> Array: ...


class Sim(Protocol):
    """robosuite's MjSim; `model` and `data` delegate to mujoco's structs."""

    model: Any
    data: Any

    def get_state(self) -> State: ...
    def set_state_from_flattened(self, value: Array) -> None: ...
    def forward(self) -> None: ...
    def reset(self) -> None: ...


class Env(Protocol):
    """A robosuite environment."""

    sim: Sim
    rng: np.random.Generator
    robots: list[Any]
    model: Any
    hard_reset: bool
    control_freq: float
    action_spec: tuple[Array, Array]
    action_dim: int
    timestep: int
    done: bool
    cur_time: float
    demonstration: bool

    def reset(self) -> dict[str, Array]: ...
    def step(self, action: Array) -> tuple[dict[str, Array], float, bool, dict[str, Any]]: ...
    def reward(self, action: Array) -> float: ...
    def close(self) -> None: ...
    def edit_model_xml(self, xml_str: str) -> str: ...
    def reset_from_xml_string(self, xml_string: str) -> None: ...
    def get_ep_meta(self) -> dict[str, Any]: ...
    def set_ep_meta(self, meta: dict[str, Any]) -> None: ...
    def unset_ep_meta(self) -> None: ...
    def _check_success(self) -> bool: ...
    def _get_observations(self, force_update: bool = False) -> dict[str, Array]: ...


def cache_dir() -> Path:
    """Where compiled numba functions are kept, shared by all workers of a user; a new folder where no such place is.

    Rust names a place (`NUMBA_CACHE_DIR`); this is for workers that are started by hand.
    """
    base = os.environ.get("ACTRM_CACHE")
    places = [Path(base)] if base else []
    if xdg := os.environ.get("XDG_CACHE_HOME"):
        places.append(Path(xdg) / "actrm")
    places.append(Path(os.path.expanduser("~")) / ".cache" / "actrm")
    for place in places:
        folder = place / "numba"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return Path(tempfile.mkdtemp(prefix="actrm-numba-"))


def prepare() -> None:
    """Set what mujoco and robosuite read from the environment when they are imported.

    MUJOCO_GL is "disable" for the import, because mujoco would load the OpenGL library at once and fail where there is
    none; an environment without cameras needs none. `render` picks one when an image is asked for.
    """
    os.environ["MUJOCO_GL"] = "disable"
    if "NUMBA_CACHE_DIR" not in os.environ:
        os.environ["NUMBA_CACHE_DIR"] = str(cache_dir())


def robosuite() -> Any:
    """The robosuite module."""
    return importlib.import_module("robosuite")


def mujoco() -> Any:
    """The mujoco module."""
    return importlib.import_module("mujoco")


def known_environments() -> list[str]:
    """Every environment name that robosuite would make now, our own and users' included."""
    return sorted(cast("dict[str, Any]", importlib.import_module("robosuite.environments.base").REGISTERED_ENVS))


def controllers(config: Any, robot: str) -> Any:
    """A controller configuration, or one for each robot, in the form that robosuite 1.5 wants; None: the default.

    Files of robomimic that are older than robosuite 1.5 hold the configuration of the arms alone.
    """
    if config is None:
        return _default_controller(robot)
    if isinstance(config, list):
        return [controllers(each, robot) for each in cast("list[Any]", config)]
    factory = importlib.import_module("robosuite.controllers.composite.composite_controller_factory")
    config = dict(factory.refactor_composite_controller_config(config, robot, ["right"]))
    default = _default_controller(robot)
    if robot == "Panda" and "body_parts" in config:
        # robosuite's own recordings list legs, torso and head too, and robosuite passes over what a robot lacks
        parts = cast("dict[str, Any]", config["body_parts"])
        config["body_parts"] = {name: part for name, part in parts.items() if name in default["body_parts"]}
    return config


def _default_controller(robot: str) -> dict[str, Any]:
    module = importlib.import_module("robosuite.controllers")
    return cast("dict[str, Any]", module.load_composite_controller_config(controller=None, robot=robot))


def package_dir() -> str:
    """The folder that robosuite is installed in, where its assets' paths begin."""
    return str(Path(cast(str, robosuite().__file__)).parent)
