"""Whole episodes of the scripted expert, in the arrays of robomimic and LIBERO."""

import json

import numpy as np

from actrm_harness.experts.skills import USUAL, Demonstrator
from actrm_harness.protocol import RequestError
from actrm_harness.simulators import Episode
from actrm_harness.simulators.libero.expert import LiberoScene, expert
from actrm_harness.simulators.libero.simulation import Libero
from actrm_harness.simulators.robosuite.envs import StepResult
from actrm_harness.simulators.robosuite.episodes import STEPS_AFTER_SUCCESS, Recorder


def expert_episode(libero: Libero, seed: int, demonstration: bool, name: str | None, skill: str | None) -> Episode:
    """One episode of the task's expert; `skill` asks for less able demonstrators."""
    files, env = libero.files, libero.env
    if name is not None:
        text = f"task {files.suite}/{files.number} has no expert {name!r} beside its usual one"
        raise RequestError("no_expert", text)
    shown_by = Demonstrator.draw(skill, seed)
    first = libero.reset(seed, demonstration)
    recorder = Recorder(first.observation, whole=False)
    attrs = {"model_file": env.sim.model.get_xml(), "ep_meta": json.dumps(first.ep_meta)}
    if skill not in (None, USUAL):
        attrs["skill"] = shown_by.skill.name
    moves = expert(LiberoScene(env, shown_by), np.random.default_rng([seed, 1]))
    held = 0
    for _ in range(libero.max_steps):
        before = env.sim.get_state().flatten()
        action = np.clip(moves.act(), -1.0, 1.0)
        stepped = libero.step(action[None])
        recorder.add(before, action, StepResult(stepped.observation, float(stepped.rewards[-1]), stepped.success))
        held = held + 1 if stepped.success else 0
        if held > STEPS_AFTER_SUCCESS:
            break
    return Episode(recorder.successes[-1], len(recorder.actions), attrs, recorder.tensors())
