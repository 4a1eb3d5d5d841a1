"""Offline robot learning: data sets, policies without torch, evaluations, leaderboards.

    actrm.convert("demos.hdf5", "lift")
    ds = actrm.Dataset("lift", delta_timestamps={"action": range(16)}, split="train")
    for batch in ds.batches(64, seed=1): ...
    policy = actrm.load_policy("zoo/stack-act")
    policy.reset(seed=1); policy.select_action(observation)
    episodes = actrm.evaluate("zoo/stack-act", episodes=50, workers=2)
    episodes = actrm.evaluate(my_policy, name="mine", protocol="lift-v1")
    rows = actrm.leaderboard("zoo")

Keys, shapes and names are LeRobot's. What is refused is an `actrm.Error` with the words of the programs.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from . import _actrm
from ._actrm import (
    Batches,
    Dataset,
    Error,
    Policy,
    ResultsTakenOver,
    Simulator,
    __version__,
    leaderboard,
    load_policy,
)
from ._policies import Called, code, source
from ._programs import CONTROL, folder
from ._progress import Progress, teller

if TYPE_CHECKING:
    from os import PathLike

    Path = str | PathLike[str]

__all__ = [
    "Batches",
    "Dataset",
    "Error",
    "Policy",
    "ResultsTakenOver",
    "Simulator",
    "__version__",
    "convert",
    "evaluate",
    "leaderboard",
    "load_policy",
]

# every time, where Python says a text once a line; filters that are there, such as those of `python -W`, come first
warnings.simplefilter("always", ResultsTakenOver, append=True)

_actrm.set_places(str(folder() / "actrm-data"), str(folder() / CONTROL))


def convert(
    src: Path,
    dst: Path,
    progress: Progress = None,
    *,
    state_keys: Sequence[str] | None = None,
    env_keys: Sequence[str] | None = None,
    entities: Mapping[str, Sequence[str]] | None = None,
    fps: float | None = None,
    images: Literal["png", "ppm", "video"] = "png",
    depth: bool = True,
    actions: Literal["delta", "absolute"] = "delta",
    rotation: Literal["axis-angle", "6d"] = "axis-angle",
    nonfinite: Literal["refuse", "keep"] = "refuse",
    skip_bad: bool = False,
    lossless: bool = True,
    jobs: int = 0,
) -> dict[str, Any]:
    """Convert demonstrations (HDF5, zarr, RLDS or LeRobot v2) into a LeRobotDataset v3.0 folder.

    `dst` appears whole or not at all; Ctrl-C leaves nothing behind. Other Python threads keep running.

    Parameters
    ----------
    src: what `actrm-data convert` takes: an HDF5 file or a folder of them, a zarr store, an RLDS or a LeRobot v2.x
        folder.
    dst: folder to create.
    progress: True shows a bar, False does not. A function is called with frames done and frames in all. Unless given,
        there is a bar in terminals and notebooks.
    state_keys, env_keys: observation keys of `observation.state` and `observation.environment_state`; those of the
        file's layout unless given.
    entities: for each name the observation keys of `observation.entity.<name>`. The lists may have slices (`key[0:3]`),
        differences (`a - b`), the value at the first step (`first(key)`) or 8 control steps earlier (`before(key:8)`),
        and the axes of a quaternion (`axes(key)`).
    fps: frames a second; the control frequency that the file states unless given.
    images: how images are stored.
    depth: make columns of depth, as LeRobot records it; the side folder alone keeps it otherwise.
    actions: as the controller received them (`delta`), or absolute poses.
    rotation: how rotations in actions are written.
    nonfinite: refuse a source with values that are NaN or infinite, naming demo, key and step, or keep them; statistics
        are those of the finite values.
    skip_bad: leave out demos that cannot be converted, instead of refusing the source.
    lossless: keep what the format has no place for in the side folder, from which `actrm-data export` rebuilds the
        source.
    jobs: threads; 0 means one per core.

    Returns what was written: `episodes`, `frames`, `tasks`, `files`, `bytes`, `fingerprint`, `layout`, `notes`, and
    `skipped`, the demos left out, each with the reason.
    """
    with teller("convert", progress) as tell:
        return _actrm.convert(
            src,
            dst,
            tell,
            state_keys=None if state_keys is None else _names("state_keys", state_keys),
            env_keys=None if env_keys is None else _names("env_keys", env_keys),
            entities={name: _names(f"entities[{name!r}]", keys) for name, keys in (entities or {}).items()},
            fps=fps,
            images=images,
            depth=depth,
            actions=actions,
            rotation=rotation,
            nonfinite=nonfinite,
            skip_bad=skip_bad,
            lossless=lossless,
            jobs=jobs,
        )


def evaluate(
    policy: Path | object,
    episodes: int | None = None,
    workers: int | None = None,
    progress: Progress = None,
    *,
    name: str | None = None,
    task: str | None = None,
    protocol: str | None = None,
    inputs: Mapping[str, Sequence[str]] | None = None,
    image_size: int = 84,
    declared: str | None = None,
    conventions: Mapping[str, str] | None = None,
    seed: int | None = None,
    max_steps: int | None = None,
    n_action_steps: int | None = None,
    temporal_ensemble: float | None = None,
    control: Literal["compiled", "robosuite"] | None = None,
    python: Path | None = None,
    env_module: str | None = None,
    zoo: Path | None = None,
    results: Path | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Evaluate a policy in simulation, one episode per seed, as `actrm-zoo eval` does: an entry, or a policy of yours.

    The results are stored where the leaderboard finds them. Finished episodes are not run again: an
    interrupted evaluation resumes, a finished one is returned at once, for a policy of yours with the warning
    `ResultsTakenOver`.
    The outcome of an episode does not depend on the number of workers.

    A policy of yours is a function, or an object with `select_action` or `predict_action_chunk`, and `reset` if it
    remembers anything. It gets a dict of NumPy arrays without a batch axis: float32 numbers, uint8 images (height,
    width, 3). If the environment says what is to be done, that text is under `task`. It returns one action (D,) or a
    chunk (T, D). It is evaluated under `name`, as a new entry of the zoo that says where it comes from and holds no
    weights. Other settings and other code of its class are another version of the entry. So is the same code in another
    version of Python, which compiles it in another way.

    Parameters
    ----------
    policy: an entry's folder (`zoo/stack-act`), its name in `zoo`, or a policy of yours.
    episodes: how many; their seeds count up from `seed`. 20 unless given.
    workers: number of simulators at once; one per core that this process may use unless given. Where there are
        several, each gets a copy (`copy.deepcopy`) of a policy of yours that has `reset`; others are shared by threads.
    progress: as in `convert`, in episodes.
    name: name of your policy's entry.
    task: another task than the entry's; the task that your policy is evaluated on.
    protocol: a named protocol, such as `lift-v1`, which says task, seeds, step limit and control loop.
    inputs: observation keys of each feature that your policy reads: `{"observation.state": ["robot0_eef_pos"]}`. An
        image is `"observation.images.agentview": ["agentview_image"]`. `observation.state` and
        `observation.environment_state` of the task unless given.
    image_size: side of your policy's images in pixels.
    declared: what you declare of your policy's weights, such as a hash; another one is another version of the entry.
    conventions: what your policy expects, such as `{"control_freq": "20", "gripper": "-1 opens, 1 closes"}`.
        A simulator that differs is refused. Names and values: `actrm-zoo show ENTRY --conventions`.
    seed: seed of the first episode; 10000 unless given.
    max_steps: control steps after which an episode has failed; the entry's or the task's own limit unless given.
    n_action_steps: actions that are executed before the next query of the policy; the entry's unless given. With it,
        your policy is asked by `predict_action_chunk`; without, by `select_action` at every step.
    temporal_ensemble: query at every step and average all predictions, with this coefficient.
    control: control loop inside the simulator; `compiled` unless given.
    python: an interpreter with robosuite; this one where it has robosuite, else `$ACTRM_PYTHON`, `.venv` here or above,
        `python3`.
    env_module: Python module that registers environments. An entry that was recorded with one needs it named.
    zoo: folder of the zoo that names are looked up in.
    results: folder of results; `results` in the entry's zoo unless given.
    force: evaluate even if the demonstrations were recorded in another simulator version or with these seeds.

    Returns columns with one row per episode, ascending by seed: `seed`, `success`, `steps`, `return`, `wall_ms` and
    `inference_ms` (mean of its queries) as arrays, `fingerprint` (of the initial state), `group` and `failure` as
    lists.
    """
    workers = workers if workers is not None else len(os.sched_getaffinity(0))
    entry, external = None, None
    if isinstance(policy, (str, os.PathLike)):
        given = {"name": name, "inputs": inputs, "declared": declared, "conventions": conventions}
        entry = str(policy)  # pyright: ignore[reportUnknownArgumentType]
        if meant := [word for word, value in given.items() if value is not None]:
            raise ValueError(f"{meant[0]}: expected with a policy of yours, found the entry {entry!r}")
    else:
        if name is None:
            raise ValueError("name: expected a name for your policy's entry, such as name='mine', found none")
        chunks = n_action_steps is not None or temporal_ensemble is not None
        called = Called.of(policy, workers=workers, chunks=chunks)
        keys = None
        if inputs is not None:
            keys = {feature: _names(f"inputs[{feature!r}]", of) for feature, of in inputs.items()}
        external = (called, name, source(policy), code(policy), declared, keys, image_size, dict(conventions or {}))
    with teller("eval", progress) as tell:
        return _actrm.evaluate(
            entry,
            external,
            tell,
            protocol=protocol,
            episodes=episodes,
            workers=workers,
            seed=seed,
            task=task,
            max_steps=max_steps,
            n_action_steps=n_action_steps,
            temporal_ensemble=temporal_ensemble,
            control=control,
            python=python or simulator_python(),
            env_module=env_module,
            zoo=zoo,
            results=results,
            force=force,
        )


def _names(argument: str, given: Sequence[str]) -> list[str]:
    """A list of names, and not the letters of one."""
    if isinstance(given, str):
        raise TypeError(f"{argument}: expected a list of names, such as [{given!r}], found the text {given!r}")
    return list(given)


def simulator_python() -> str | None:
    """This interpreter, if workers can run in it and no other is named by the environment."""
    needed = ("robosuite", "mujoco", "numba")
    if os.environ.get("ACTRM_PYTHON") or not all(importlib.util.find_spec(name) for name in needed):
        return None
    return sys.executable
