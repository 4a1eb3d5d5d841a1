"""Environments: what tasks there are, and how one is made, seeded, stepped and observed.

An episode depends on (task, seed, actions) only, whatever ran before in the process: `reset` writes the seed's bit
generator state into the environment's own generator (a new generator would not reach robosuite's placement samplers)
and then resets. Where `Task.soft_reset` is set, the model is kept between episodes, which is bit-identical to loading
it again; where robosuite draws while it loads the model (Lift's cube, Wipe's dirt), because `Task.redraw` draws it
(`lift_cube`, `wipe_dirt`).
"""

import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from actrm_harness.protocol import RequestError
from actrm_harness.simulators import verdict
from actrm_harness.simulators.robosuite import lean, suite
from actrm_harness.simulators.robosuite.stages import Stage, stages
from actrm_harness.simulators.robosuite.suite import Env
from actrm_harness.tasks import TASKS, Task, find, row
from actrm_harness.wire import Array, Tensors

if TYPE_CHECKING:
    from actrm_harness.simulators.robosuite.render import Renderer

CONTROL_FREQ = 20


class Control(Protocol):
    """The inner loop of a control step, in place of robosuite's."""

    def step(self, action: Array, look: bool = True) -> tuple[dict[str, Array], float, bool, dict[str, Any]]:
        """Do and return what `Env.step` does and returns; without `look` nothing is observed."""
        ...

    def look(self) -> dict[str, Array]:
        """The observations of a step that was done without looking."""
        ...

    def release(self) -> None:
        """Let go of the simulation, because the environment is about to be reset."""
        ...


@dataclass(slots=True)
class Session:
    """One environment, its task and its control loop (None: robosuite's own)."""

    env: Env
    task: Task
    env_args: dict[str, Any]
    cameras: tuple[str, ...] = ()
    image_size: int = 84
    fast_render: bool = False
    control: Control | None = None
    renderer: "Renderer | None" = None
    foreign_model: bool = False
    xml_forgotten: bool = False
    unusual: str | None = None
    """SHA-256 of the arguments, where they are not the task's usual ones."""
    drawing_ms: float = 0.0
    """How long the last observation's pictures took; nothing depends on it."""
    stages: tuple[Stage, ...] = ()
    """What an episode passes on its way to success, in order; none where nobody has named any."""
    reached: int = 0
    """How many of them the episode under way has passed."""

    def progress(self, solved: bool) -> float | None:
        """Which share of its way the episode has come: stages passed of all and success; None without stages."""
        if not self.stages:
            return None
        return 1.0 if solved else self.reached / (len(self.stages) + 1)

    def look_ahead(self) -> None:
        """Pass the stages that the present state reaches."""
        while self.reached < len(self.stages) and self.stages[self.reached][1]():
            self.reached += 1


@dataclass(frozen=True, slots=True)
class StepResult:
    """What one control step led to."""

    observation: Tensors
    reward: float
    success: bool
    failure: str | None = None
    """In a word why the task can no longer be solved, where the environment says so: the episode ends."""


# What this package decides whatever recorded arguments say: what is drawn, and when an episode ends.
_DECIDED = ("camera_", "render", "has_", "hard_reset", "horizon", "seed", "env_lang")


def make(
    task_name: str,
    cameras: tuple[str, ...] = (),
    size: int = 84,
    env_args: dict[str, Any] | None = None,
    *,
    fast_render: bool = False,
) -> Session:
    """Make the environment of a task; RequestError("unknown_task") where there is none of that name.

    `env_args` are robomimic's: robots, controllers and whatever else they say take the place of the task's usual ones.
    """
    for defined_in in sorted(
        {task.defined_in for task in TASKS.values() if task.defined_in and task.simulator == "robosuite"}
    ):
        find(defined_in)
    known = suite.known_environments()
    if task_name not in known:
        raise RequestError("unknown_task", f"unknown task {task_name!r}; known: {', '.join(known)}")
    task = row(task_name)
    usual = arguments(task, {})
    kwargs = usual if env_args is None else arguments(task, recorded(env_args))
    unusual = None
    if kwargs != usual:
        unusual = hashlib.sha256(json.dumps(kwargs, sort_keys=True).encode()).hexdigest()
        # what keeping the model leaves in place is known of the usual robot only; an expert moves the hand of any robot
        # with its usual controller
        other_robot = kwargs == arguments(task, {"robots": kwargs["robots"]})
        task = replace(task, soft_reset=False, expert=task.expert if other_robot else None)
    # in robomimic's order
    kwargs |= {
        "has_renderer": False,
        "has_offscreen_renderer": bool(cameras),
        "ignore_done": True,
        "use_object_obs": True,
        "use_camera_obs": bool(cameras),
        "camera_depths": False,
    }
    if cameras:
        kwargs |= {"camera_names": list(cameras), "camera_heights": size, "camera_widths": size}
    described: dict[str, Any] = {
        "env_name": task_name,
        "env_version": suite.robosuite().__version__,
        "type": 1,
        "env_kwargs": json.loads(json.dumps(kwargs)),
    }
    if cameras and fast_render:
        described["fast_render"] = True
    lean.prepare()
    # Images are drawn by `render`, so that an episode is the same with cameras and without.
    kwargs |= {"has_offscreen_renderer": False, "use_camera_obs": False}
    kwargs.setdefault("control_freq", CONTROL_FREQ)
    try:
        env = suite.robosuite().make(task_name, **kwargs, hard_reset=not task.soft_reset, renderer="mujoco", seed=0)
    except (TypeError, KeyError, AssertionError, ValueError) as error:
        if env_args is None:
            raise
        raise RequestError("env_args", f"{task_name} cannot be made of these env_args: {error!r}") from error
    return Session(
        env=cast(Env, env),
        task=task,
        env_args=described,
        cameras=cameras,
        image_size=size,
        unusual=unusual,
        fast_render=fast_render,
    )


def arguments(task: Task, given: dict[str, Any]) -> dict[str, Any]:
    """What the environment's class is given: the task's own arguments, overlaid by the given ones."""
    wanted: dict[str, Any] = {"robots": "Panda", **task.arguments, **given}
    robots = wanted["robots"]
    single = robots if isinstance(robots, str) else robots[0]
    if isinstance(robots, list) and len(cast("list[str]", robots)) == 1:
        robots = single
    controllers = suite.controllers(wanted.get("controller_configs"), single)
    others = {name: value for name, value in wanted.items() if name not in ("robots", "controller_configs")}
    return {"robots": robots, "controller_configs": controllers, "reward_shaping": False, **others}


def recorded(env_args: dict[str, Any]) -> dict[str, Any]:
    """The arguments in robomimic's `env_args` that decide what happens; RequestError where they are none."""
    kwargs = env_args.get("env_kwargs")
    if not isinstance(kwargs, dict):
        raise RequestError("env_args", f"env_args have no env_kwargs; they have {sorted(env_args)}")
    found = {
        name: value
        for name, value in cast("dict[str, Any]", kwargs).items()
        if not name.startswith(_DECIDED) and name not in ("env_name", "ignore_done", "use_object_obs", "use_camera_obs")
    }
    if found.get("control_freq") == CONTROL_FREQ:
        # said by some files and not by others
        del found["control_freq"]
    return found


def reset(session: Session, seed: int, demonstration: bool = False) -> Tensors:
    """Begin the episode of `seed` and give its first observation.

    `demonstration` tells an environment that splits its episodes (StackColor) that this one is to be learned from.
    """
    env = session.env
    env.demonstration = demonstration
    env.unset_ep_meta()
    env.hard_reset = not session.task.soft_reset or session.foreign_model
    session.foreign_model = False
    env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state
    if session.control is not None:
        session.control.release()
    if env.hard_reset:
        lean.forget_xml(give_back=False)
        session.xml_forgotten = False
    elif session.task.redraw is not None:
        find(session.task.redraw)(env)
    raw = env.reset()
    env.hard_reset = not session.task.soft_reset
    session.stages, session.reached = stages(env, session.task.name), 0
    return {**observation(env, raw), **images(session)}


def compile_control(env: Env) -> None:
    """Let numba compile what robosuite's own loop calls, which takes longer than a step may; a reset undoes it."""
    for robot in env.robots:
        for policy_step in (True, False):
            robot.control(np.zeros(robot.action_dim), policy_step=policy_step)


def slim(session: Session) -> None:
    """Give back what only writing the model as MJCF needs, where the model is kept; loading it again restores it."""
    if session.task.soft_reset and not session.xml_forgotten:
        lean.forget_xml(give_back=True)
        session.xml_forgotten = True


def step_session(session: Session, action: Array) -> StepResult:
    """One control step with the session's control loop, images included."""
    result = step(session.env, action, session.control)
    session.look_ahead()
    if not session.cameras:
        return result
    return replace(result, observation={**result.observation, **images(session)})


def steps_session(session: Session, actions: Array) -> tuple[StepResult, Array]:
    """Control steps, one after the other until the task is solved or lost: what the last one led to, and all rewards.

    What is seen between them is not looked at, nor observed where that is known to change nothing.
    """
    env, control = session.env, session.control
    raw: dict[str, Array] = {}
    rewards: list[float] = []
    solved, lost = False, None
    blind = len(actions) - 1 if _ours(env) else 0
    with judged_once(env) as begin_step:
        for index, asked in enumerate(actions):
            look = index >= blind
            begin_step()
            action = carried_out(env, asked)
            raw, reward, _, _ = env.step(action) if control is None else control.step(action, look)
            rewards.append(float(reward))
            solved = success(env)
            lost = None if solved else failure(env)
            session.look_ahead()
            if solved or lost is not None:
                raw = raw if look or control is None else control.look()
                break
    return StepResult({**observation(env, raw), **images(session)}, rewards[-1], solved, lost), np.array(rewards)


def image(session: Session, camera: str, height: int, width: int) -> Array:
    """What a camera sees now; the OpenGL context is made when the first image is asked for."""
    return renderer(session).images(session.env.sim, (camera,), height, width)[0]


def images(session: Session) -> Tensors:
    """What the session's cameras see now, under robomimic's names."""
    if not session.cameras:
        return {}
    size, begun = session.image_size, time.perf_counter()
    seen = renderer(session).images(session.env.sim, session.cameras, size, size)
    session.drawing_ms = 1e3 * (time.perf_counter() - begun)
    return {f"{camera}_image": pixels for camera, pixels in zip(session.cameras, seen, strict=True)}


def renderer(session: Session) -> "Renderer":
    """What draws the session, made when it is asked for."""
    if session.renderer is None:
        from actrm_harness.simulators.robosuite.render import Renderer

        session.renderer = Renderer(fast=session.fast_render)
    return session.renderer


def carried_out(env: Env, action: Array) -> Array:
    """What is done of an action: nothing while the environment holds the arm (`RecallHeld`)."""
    holds = getattr(env, "holds_arm", None)
    return np.zeros_like(action) if holds is not None and holds() else action


def step(env: Env, action: Array, control: Control | None) -> StepResult:
    """One control step, through robosuite's loop or through `control`."""
    action = carried_out(env, action)
    with judged_once(env):
        raw, reward, _, _ = env.step(action) if control is None else control.step(action)
        solved = success(env)
        return StepResult(observation(env, raw), float(reward), solved, None if solved else failure(env))


_JUDGES = ("_check_success", "staged_rewards")
_OURS = ("robosuite.environments.", "actrm_harness.")


def _ours(env: Env) -> bool:
    """Whether reward and success are known to follow from the simulation's state alone."""
    return type(env).__module__.startswith(_OURS)


@contextmanager
def judged_once(env: Env) -> Generator[Callable[[], None]]:
    """Within a control step, the reward and the question of success share one look at the state.

    In robosuite's tasks and ours both follow from the same state by the same functions, which take a third of the time
    around a step; an environment of somebody else's may count how often it is asked, and is left alone. What this gives
    is to be called before every step but the first.
    """
    if not _ours(env):
        yield lambda: None
        return
    verdicts: dict[str, Any] = {}
    names = [name for name in _JUDGES if hasattr(env, name)]
    for name in names:
        setattr(env, name, _once(getattr(env, name), name, verdicts))
    try:
        yield verdicts.clear
    finally:
        for name in names:
            delattr(env, name)


def _once(judge: Callable[[], Any], name: str, verdicts: dict[str, Any]) -> Callable[[], Any]:
    def remembered() -> Any:
        if name not in verdicts:
            verdicts[name] = judge()
        return verdicts[name]

    return remembered


def success(env: Env) -> bool:
    """Whether the task is solved in the current state."""
    return verdict(env._check_success())  # pyright: ignore[reportPrivateUsage]


def failure(env: Env) -> str | None:
    """In a word why the task can no longer be solved; most environments never give up."""
    judge = getattr(env, "failure", None)
    return None if judge is None else judge()


def check_actions(env: Env, actions: Array) -> Array:
    """The actions, one or a row each, as rows of float64; RequestError where they are none."""
    width = env.action_dim
    rows = actions[None] if actions.ndim == 1 else actions
    if rows.dtype != np.float64 or rows.ndim != 2 or rows.shape[1] != width:
        raise RequestError("bad_action", f"action must be F64 of shape ({width},), got {actions.dtype} {actions.shape}")
    if not np.isfinite(rows).all():
        raise RequestError("bad_action", f"action has values that are not finite: {actions.tolist()}")
    if not len(rows):
        raise RequestError("bad_action", f"no action in a tensor of shape {actions.shape}")
    return rows.copy()


def observation(env: Env, raw: dict[str, Array]) -> Tensors:
    """Robosuite's observations under robomimic's names.

    "object-state" becomes "object"; the robot's own values keep their names; the separate values that "object-state"
    joins and the joined robot state are left out. An environment of ours may give its separate values too
    (`parts`), so that a policy can tell its things apart, and leave out what joins them (`joined`).
    """
    kept: Tensors = {}
    parts: frozenset[str] = getattr(env, "parts", frozenset())
    joined: bool = getattr(env, "joined", True)
    for name, value in raw.items():
        if name == "object-state":
            if joined:
                kept["object"] = np.asarray(value, dtype=np.float64)
        elif name in parts or _of_robot(name):
            kept[name] = np.asarray(value, dtype=np.float64)
    return kept


@cache
def _of_robot(name: str) -> bool:
    return re.match(r"robot\d+_", name) is not None and not name.endswith("-state")


def state(env: Env) -> Array:
    """The simulator's flattened state, as robomimic stores it."""
    return np.asarray(env.sim.get_state().flatten(), dtype=np.float64)


def fingerprint(env: Env) -> str:
    """SHA-256 of the simulation's state with the parts of the model that a reset may change."""
    digest = hashlib.sha256()
    model, data = env.sim.model, env.sim.data
    for owner, names in (
        (data, ("time", "qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat")),
        (model, ("body_pos", "body_quat", "body_mass", "body_inertia", "geom_size", "geom_pos", "geom_rgba")),
    ):
        for name in names:
            value = np.ascontiguousarray(getattr(owner, name))
            digest.update(f"{name} {value.dtype.str} {value.shape}\n".encode())
            digest.update(value.tobytes())
    return digest.hexdigest()


def model_xml(env: Env) -> str:
    """The model as MJCF, without indentation and with asset paths that begin at "robosuite/".

    robosuite finds the last "robosuite" in a path and puts its own folder there when it loads the text again.
    """
    if lean.overwrites_the_scene():
        raise RequestError("mujoco", "MuJoCo before 3.2 cannot write the model of a scene that is kept")
    text = cast(str, env.sim.model.get_xml())
    text = text.replace(os.path.dirname(suite.package_dir()) + "/", "")
    if env.model.root.find("statistic") is None:
        # follows from the rest, and is written for some histories of a kept model only
        text = re.sub(r"\n\s*<statistic [^>]*/>", "", text)
    return re.sub(r"\n\s*", "\n", text)
