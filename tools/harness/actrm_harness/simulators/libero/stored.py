"""Observations under the names that LIBERO's own demonstrations have, and what else its files hold of a task.

LIBERO's scripts/create_dataset.py writes those files. Here too an image lies upside down, as OpenGL reads it, and the
rotation of the gripper is an axis-angle. There an observation is the one after its action. Here it is the one before,
as in robomimic's files.
"""

import importlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from actrm_harness.simulators import OF_THE_FILE, Episode
from actrm_harness.wire import Array, Tensors

CAMERAS = {"agentview_rgb": "agentview", "eye_in_hand_rgb": "robot0_eye_in_hand"}
"""What LIBERO's files call the images of cameras."""
NAMES = ("ee_", "gripper_states", "joint_states")
"""What begins the other names."""


def camera(name: str) -> str:
    """The simulator's camera of this name."""
    return CAMERAS.get(name, name)


def turned(name: str, pixels: Array) -> Array:
    """An upright image as a camera of this name gives it."""
    return np.ascontiguousarray(pixels[::-1]) if name in CAMERAS else pixels


def state(observation: Tensors) -> Tensors:
    """The robot's state under LIBERO's names: metres, radians."""
    rotation = importlib.import_module("robosuite.utils.transform_utils").quat2axisangle(observation["robot0_eef_quat"])
    ee = np.concatenate([observation["robot0_eef_pos"], rotation])
    return {
        "ee_states": ee,
        "ee_pos": ee[:3],
        "ee_ori": ee[3:],
        "gripper_states": observation["robot0_gripper_qpos"],
        "joint_states": observation["robot0_joint_pos"],
    }


def attributes(control: Any, problem: Path) -> dict[str, str]:
    """What the group `data` of a file says of its task; `control` is LIBERO's ControlEnv, `problem` a BDDL file."""
    said = {
        "problem_name": control.problem_name,
        "domain_name": control.domain_name,
        "language_instruction": control.language_instruction,
    }
    return {
        "tag": "libero-v1",
        "env_name": type(control.env).__name__,
        "problem_info": json.dumps(said),
        "bddl_file_name": "/".join(problem.parts[-2:]),
        "bddl_file_content": problem.read_text(encoding="utf-8"),
        "macros_image_convention": "opengl",
    }


def layout(episode: Episode, of_the_file: dict[str, str]) -> Episode:
    """A demonstration in the layout of LIBERO's files: with `robot_states`, and its names for images."""
    images = {f"{place}/{name}_image": f"{place}/{name}" for place in ("obs", "next_obs") for name in CAMERAS}
    tensors = {images.get(name, name): value for name, value in episode.tensors.items()}
    robot = ("robot0_gripper_qpos", "robot0_eef_pos", "robot0_eef_quat")
    tensors["robot_states"] = np.concatenate([tensors[f"obs/{name}"] for name in robot], axis=1)
    attrs = episode.attrs | {f"{OF_THE_FILE}{name}": text for name, text in of_the_file.items()}
    return replace(episode, tensors=tensors, attrs=attrs)
