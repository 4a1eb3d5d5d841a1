"""The shared object of `crates/control`: its structures, its functions, and where MuJoCo's functions are."""

import ctypes
import importlib
from pathlib import Path
from typing import Any, cast

import numpy as np

from actrm_harness.protocol import RequestError
from actrm_harness.wire import Array

MUJOCO = "3.3.7"
DOF = 7
ABI = 2
DONE, DIVERGED = 0, 1

_GRIP_SITE = [("ref_pos", "f8", 3), ("ref_ori", "f8", (3, 3)), ("ref_pos_vel", "f8", 3), ("ref_ori_vel", "f8", 3)]

STATE = np.dtype(
    [
        *_GRIP_SITE,
        ("joint_pos", "f8", DOF),
        ("joint_vel", "f8", DOF),
        ("mass", "f8", (DOF, DOF)),
        ("jacobian", "f8", (6, DOF)),
        ("origin_pos", "f8", 3),
        ("origin_ori", "f8", (3, 3)),
        ("goal_pos", "f8", 3),
        ("goal_ori", "f8", (3, 3)),
        ("torques", "f8", DOF),
        ("gripper_action", "f8", 2),
        ("gripper_goal", "f8", 2),
        *((f"policy_{name}", kind, shape) for name, kind, shape in _GRIP_SITE),
        ("new_update", "u8"),
    ]
)
"""`State` of crates/control/src/abi.rs: the memory of a robot's controllers."""

_FUNCTIONS = {"step1": "mj_step1", "step2": "mj_step2", "jac_site": "mj_jacSite"}
_ARRAYS = ["ctrl", "qpos", "qvel", "qm", "qfrc_bias", "site_xpos", "site_xmat", "ctrlrange", "dof_madr", "dof_parent"]
_POINTERS = [*_FUNCTIONS, "model", "data", *_ARRAYS]
_NUMBERS = ["nq", "nv", "nu", "nm", "nsite"]
_SITES = ["grip_site", "origin_site"]
_INDICES = {"arm_qpos": DOF, "arm_dof": DOF, "arm_actuator": DOF, "gripper_actuator": 2}
_GAINS = ["kp", "kd", "input_min", "input_max", "input_offset", "scale", "output_offset"]
_GRIPPER = ["direction", "input_min", "input_max", "input_offset", "scale", "output_offset", "bias", "weight"]


class Binding(ctypes.Structure):
    """`Binding` of crates/control/src/abi.rs: one simulation."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in _POINTERS),
        *((name, ctypes.c_int32) for name in _NUMBERS),
    ]


class ArmBinding(ctypes.Structure):
    """`ArmBinding` of crates/control/src/abi.rs: a robot of one arm in it."""

    _fields_ = [
        *((name, ctypes.c_int32) for name in _SITES),
        *((name, ctypes.c_int32 * length) for name, length in _INDICES.items()),
        ("fingers", ctypes.c_int32),
        *((name, ctypes.c_double * 6) for name in _GAINS),
        ("initial_joint", ctypes.c_double * DOF),
        ("gripper_speed", ctypes.c_double),
        *((f"gripper_{name}", ctypes.c_double * 2) for name in _GRIPPER),
    ]


class ControlError(Exception):
    """The compiled loop cannot go on, or cannot begin."""


class Library:
    """The loaded shared object, its interface checked."""

    def __init__(self, path: Path) -> None:
        try:
            lib = ctypes.CDLL(str(path))
            size, pointer, count = ctypes.c_uint64, ctypes.c_void_p, ctypes.c_uint32
            self._abi = _typed(lib.control_abi, size)
            self._open = _typed(lib.control_open, pointer, pointer, pointer, count)
            self.run = _typed(lib.control_run, ctypes.c_int32, pointer, pointer, pointer, count, count)
            self.close = _typed(lib.control_close, None, pointer)
            self._delta_rotation = _typed(lib.control_delta_rotation, None, pointer, pointer)
        except (OSError, AttributeError) as error:
            raise ControlError(f"{path} is not the control library: {error}") from error
        expected = ABI
        for size in (ctypes.sizeof(Binding), ctypes.sizeof(ArmBinding), STATE.itemsize):
            expected = expected << 16 | size
        if self._abi() != expected:
            raise ControlError(f"{path} has interface {self._abi():#x}, this package {expected:#x}: build both anew")

    def open(self, binding: Binding, arms: list[ArmBinding]) -> int:
        """A loop over `binding` and the robots in it, to be given to `run` and at last to `close`."""
        each = (ArmBinding * len(arms))(*arms)
        handle = self._open(ctypes.addressof(binding), ctypes.addressof(each), len(arms))
        if handle is None:
            raise ControlError("the control library refuses the robots' indices")
        return int(handle)

    def delta_rotation(self, axis: Array) -> Array:
        """The matrix of a scaled axis, rounded as robosuite's `quat2mat` rounds it."""
        axis = np.array(axis, dtype=np.float64)
        out = np.empty((3, 3))
        self._delta_rotation(axis.ctypes.data, out.ctypes.data)
        return out


def check(status: int) -> None:
    """What a run ended with, `Status` of crates/control/src/substeps.rs; RequestError where the simulation diverged."""
    if status == DIVERGED:
        text = "the simulation has diverged: the arm's inertia matrix is not positive definite"
        raise RequestError("environment", text)
    if status != DONE:
        raise ControlError(f"the control library refuses what it was given (status {status})")


def _typed(function: Any, result: Any, *arguments: Any) -> Any:
    function.restype = result
    function.argtypes = arguments
    return function


def mujoco_functions() -> dict[str, int]:
    """Addresses of the MuJoCo functions that the loop calls."""
    lib = mujoco_library()
    return {ours: ctypes.cast(getattr(lib, theirs), ctypes.c_void_p).value or 0 for ours, theirs in _FUNCTIONS.items()}


def mujoco_library() -> ctypes.CDLL:
    """MuJoCo's library, the one that Python's mujoco has loaded."""
    folder = Path(cast(str, importlib.import_module("mujoco").__file__)).parent
    names = (f"libmujoco.so.{MUJOCO}", f"libmujoco.{MUJOCO}.dylib")
    found = [folder / name for name in names if (folder / name).is_file()]
    if not found:
        raise ControlError(f"{folder} has no libmujoco {MUJOCO}")
    return ctypes.CDLL(str(found[0]))
