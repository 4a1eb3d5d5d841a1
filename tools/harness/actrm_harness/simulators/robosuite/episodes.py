"""Whole episodes in robomimic's arrays: what an expert did, and what stored states look like.

States, actions (as executed), rewards r(s') and dones are those of robomimic: states[t] and obs[t] are what was there
before actions[t]; rewards[t], dones[t] and next_obs[t] are what it led to. dones follow done_mode 2: 1 where the task
is solved, and in the last step. An expert that marks its mistakes adds mistakes: 1 where actions[t] is one.
"""

import json
from typing import Any

import numpy as np

from actrm_harness.experts.parts import Expert, Marking, Scene
from actrm_harness.experts.skills import USUAL, Demonstrator
from actrm_harness.protocol import RequestError, brief
from actrm_harness.simulators import Episode
from actrm_harness.simulators.robosuite import envs
from actrm_harness.simulators.robosuite.envs import Session
from actrm_harness.tasks import find
from actrm_harness.wire import Array, Tensors

# A demonstration ends this many steps after the task is solved, so that its last actions show how to stay there.
STEPS_AFTER_SUCCESS = 10

# What an expert's demonstration leaves out of the observations, because it follows from the rest. Stored states are
# shown whole, as robomimic shows them.
LEFT_OUT = ("_joint_pos_cos", "_joint_pos_sin", "_joint_acc", "_eef_quat_site")

# What robosuite computes in single precision, and robomimic stores so.
SINGLE = ("_eef_quat_site",)


class Recorder:
    """What an episode has come by so far."""

    def __init__(self, first: Tensors, whole: bool) -> None:
        self.whole = whole
        self.observations = [self.kept(first)]
        self.states: list[Array] = []
        self.actions: list[Array] = []
        self.rewards: list[float] = []
        self.successes: list[bool] = []

    def add(self, state: Array, action: Array, result: envs.StepResult) -> None:
        """Keep a step: the state before it, the action, and what it led to."""
        self.states.append(state)
        self.actions.append(action)
        self.rewards.append(result.reward)
        self.successes.append(result.success)
        self.observations.append(self.kept(result.observation))

    def kept(self, observation: Tensors) -> Tensors:
        """The observations that are stored."""
        if not self.whole:
            return {name: value for name, value in observation.items() if not name.endswith(LEFT_OUT)}
        return {
            name: value.astype(np.float32) if name.endswith(SINGLE) else value for name, value in observation.items()
        }

    def tensors(self) -> Tensors:
        """The arrays of a demonstration."""
        dones = np.array(self.successes, dtype=np.int64)
        dones[-1] = 1
        tensors: Tensors = {
            "states": np.array(self.states),
            "actions": np.array(self.actions),
            "rewards": np.array(self.rewards, dtype=np.float64),
            "dones": dones,
        }
        for name in self.observations[0]:
            values = np.array([observation[name] for observation in self.observations])
            tensors[f"obs/{name}"] = values[:-1]
            tensors[f"next_obs/{name}"] = values[1:]
        return tensors


def expert_episode(
    session: Session, seed: int, demonstration: bool = True, name: str | None = None, skill: str | None = None
) -> Episode:
    """One episode of the task's expert; its noise has a generator of its own, drawn from the same seed.

    `demonstration` False asks for the episode that an evaluation of this seed begins with, `name` for another of the
    task's experts than the usual one, `skill` for less able demonstrators: the attribute `skill` then says who it was.
    """
    place = _expert_place(session, name)
    shown_by = Demonstrator.draw(skill, seed)
    env = session.env
    session.foreign_model |= session.xml_forgotten
    recorder = Recorder(envs.reset(session, seed, demonstration), whole=False)
    attrs = {"model_file": envs.model_xml(env), "ep_meta": json.dumps(env.get_ep_meta())}
    expert: Expert = find(place)(Scene(env, shown_by=shown_by), np.random.default_rng([seed, 1]))
    held, failure = 0, None
    mistakes: list[bool] = []
    for _ in range(session.task.max_steps):
        before = envs.state(env)
        action = np.clip(expert.act(), -1.0, 1.0)
        result = envs.step_session(session, action)
        recorder.add(before, action, result)
        if isinstance(expert, Marking):
            mistakes.append(expert.erring)
        held, failure = held + 1 if result.success else 0, result.failure
        if held > STEPS_AFTER_SUCCESS or failure is not None:
            break
    if skill not in (None, USUAL):
        if shown_by.arms == 0:
            text = f"the expert of task {session.task.name!r} moves without a Servo and has one skill only: {USUAL}"
            raise RequestError("no_skill", text)
        attrs["skill"] = shown_by.skill.name
    progress = session.progress(any(recorder.successes))
    tensors = recorder.tensors()
    if mistakes:
        tensors["mistakes"] = np.array(mistakes, dtype=np.int64)
    return Episode(recorder.successes[-1], len(recorder.actions), attrs, tensors, progress, failure)


def _expert_place(session: Session, name: str | None) -> Any:
    task = session.task
    if task.expert is None:
        raise RequestError("no_expert", f"task {task.name!r} has no scripted expert")
    if name is None:
        return task.expert
    if name not in task.experts:
        known = ", ".join(sorted(task.experts)) or "none"
        raise RequestError(
            "no_expert", f"task {task.name!r} has no expert {name!r} beside its usual one; known: {known}"
        )
    return task.experts[name]


def extract(
    session: Session, states: Array, actions: Array, model_file: str, ep_meta: dict[str, Any] | None = None
) -> Episode:
    """Observations, rewards and dones of stored states, in the way of robomimic's dataset_states_to_obs.

    Every state is put into the simulator and looked at; only what follows the last action is simulated. The model is
    the demonstration's own, so the next reset loads the task's again. `ep_meta` is what the demonstration's attribute
    of that name holds: a task that draws more than places (StackColor's goal) reads it back from there.
    """
    env = session.env
    steps, width = _matrix("states", states)
    action_steps, _ = _matrix("actions", actions)
    if steps == 0 or action_steps != steps:
        raise RequestError("bad_request", f"extract: {steps} states and {action_steps} actions")
    envs.check_actions(env, actions)
    env.hard_reset |= session.xml_forgotten
    session.foreign_model = True
    if session.control is not None:
        session.control.release()
    env.set_ep_meta(dict(ep_meta or {}))
    # what a reset draws and the demonstration does not hold must not depend on what this worker did before
    env.rng.bit_generator.state = np.random.default_rng(0).bit_generator.state
    if model_file:
        env.reset()
        try:
            env.reset_from_xml_string(env.edit_model_xml(model_file))
        except Exception as error:
            raise RequestError("model", f"its model_file does not load: {brief(error)}") from error
    else:
        env.reset()
    expected = envs.state(env).shape[0]
    if width != expected:
        raise RequestError("bad_request", f"extract: states have {width} values, the model has {expected}")
    env.sim.reset()
    recorder = Recorder(_put(session, states[0]), whole=True)
    for index in range(steps):
        if index + 1 < steps:
            seen = _put(session, states[index + 1])
            result = envs.StepResult(seen, float(env.reward(actions[index])), envs.success(env))
        else:
            result = envs.step_session(session, actions[index])
        recorder.add(states[index], actions[index], result)
    attrs = {"model_file": model_file or envs.model_xml(env), "ep_meta": json.dumps(env.get_ep_meta())}
    return Episode(any(recorder.successes), steps, attrs, recorder.tensors())


def _put(session: Session, flat: Array) -> Tensors:
    env = session.env
    env.sim.set_state_from_flattened(flat)
    env.sim.forward()
    seen = envs.observation(env, env._get_observations(force_update=True))  # pyright: ignore[reportPrivateUsage]
    return {**seen, **envs.images(session)}


def _matrix(name: str, array: Array) -> tuple[int, int]:
    if array.ndim != 2 or array.dtype != np.float64:
        raise RequestError(
            "bad_request", f"extract: {name} must be F64 of two dimensions, got {array.dtype} {array.shape}"
        )
    if not np.all(np.isfinite(array)):
        raise RequestError("bad_request", f"extract: {name} has values that are not finite")
    return array.shape[0], array.shape[1]
