"""Skills: a good demonstrator changes nothing, others make mistakes, take longer, and solve the task all the same."""

import dataclasses
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from conftest import Client, WorkerError

from actrm_harness.check_experts import BARS, LESS_ABLE, Outcome, read, write
from actrm_harness.experts.parts import Scene
from actrm_harness.experts.skills import SHOWN_BY, SKILLS, Demonstrator
from actrm_harness.protocol import RequestError
from actrm_harness.simulators import Episode
from actrm_harness.simulators.robosuite import control, envs, episodes, suite
from actrm_harness.tasks import find
from actrm_harness.wire import Array

suite.prepare()

FIRST = 1_000_000
SHOWN = ("Lift", "Stack", "PickPlaceCan", "Door", "NutAssemblySquare")


@contextmanager
def driven(task: str) -> Generator[envs.Session]:
    """A session in the compiled loop."""
    session = envs.make(task)
    session.control = control.attach(session.env)
    yield session
    session.env.close()


def shown(session: envs.Session, seed: int, skill: str | None) -> Episode:
    """The demonstration of a seed by somebody of this skill."""
    return episodes.expert_episode(session, seed, skill=skill)


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize("task", [*SHOWN, "StackThreeCubes", "PickAny", "RoundPillar", "TwoArmLift"])
def test_a_good_demonstrator_shows_what_was_shown_before(task: str) -> None:
    """Shipped results are of these demonstrations: a change here is a change of all of them."""
    with np.load(Path(__file__).with_name("demonstrations.npz")) as before, driven(task) as session:
        for skill in (None, "good"):
            now = shown(session, FIRST, skill)
            assert "skill" not in now.attrs
            # stored as float16; other kernels of numpy move actions in the fourth decimal
            np.testing.assert_allclose(now.tensors["actions"], before[task], atol=2e-3)


def test_mixed_draws_all_kinds_from_the_episodes_seed_and_poor_is_always_poor() -> None:
    drawn = [Demonstrator.draw("mixed", seed).skill.name for seed in range(FIRST, FIRST + 300)]
    counts = Counter(drawn)
    assert counts.keys() == SKILLS.keys()
    # 100 each; 60 and 140 are five standard deviations away
    assert all(60 < count < 140 for count in counts.values()), counts
    assert drawn == [Demonstrator.draw("mixed", seed).skill.name for seed in range(FIRST, FIRST + 300)]
    for asked in (None, "good"):
        assert {Demonstrator.draw(asked, seed).skill.name for seed in range(50)} == {"good"}
    assert {Demonstrator.draw("poor", seed).skill.name for seed in range(50)} == {"poor"}
    assert {name for names in SHOWN_BY.values() for name in names} == SKILLS.keys()


@pytest.mark.usefixtures("library")
def test_an_episode_of_a_mixed_collection_is_its_demonstrators_own() -> None:
    """Its attribute says who it was; a good one's is the usual one, a poor one's that of a poor collection."""
    seen: set[str] = set()
    with driven("Lift") as session:
        for seed in range(FIRST, FIRST + 40):
            name = Demonstrator.draw("mixed", seed).skill.name
            if name in seen:
                continue
            seen.add(name)
            mixed, usual = shown(session, seed, "mixed"), shown(session, seed, None)
            assert mixed.attrs["skill"] == name
            assert mixed.attrs["model_file"] == usual.attrs["model_file"]
            assert mixed.tensors["states"][0].tobytes() == usual.tensors["states"][0].tobytes()
            same = mixed.tensors["actions"].tobytes() == usual.tensors["actions"].tobytes()
            assert same == (name == "good")
            assert shown(session, seed, "mixed").tensors["actions"].tobytes() == mixed.tensors["actions"].tobytes()
    assert seen == SKILLS.keys()


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize("task", SHOWN)
def test_poor_demonstrators_take_longer_and_solve_the_task(task: str) -> None:
    """Three seeds each; `actrm_harness.check_experts --skill poor` counts over 200."""
    seeds = range(FIRST, FIRST + 3)
    with driven(task) as session:
        good = [shown(session, seed, None) for seed in seeds]
        poor = [shown(session, seed, "poor") for seed in seeds]
    solved = [episode.steps for episode in poor if episode.success]
    assert len(solved) >= 2
    assert np.median(solved) > 1.4 * np.median([episode.steps for episode in good if episode.success])
    assert all(episode.attrs["skill"] == "poor" for episode in poor)


def times_missed(episode: Episode) -> int:
    """How often the fingers met after they had been told to close."""
    fingers = episode.tensors["obs/robot0_gripper_qpos"]
    met = fingers[:, 0] - fingers[:, 1] < 0.01
    closing = episode.tensors["actions"][:, -1] > 0
    return int(np.sum(met[1:] & ~met[:-1] & closing[:-1]))


def wandering(episode: Episode) -> float:
    """How far the hand went, sideways, for every metre from its first place to its last."""
    places = episode.tensors["obs/robot0_eef_pos"][:, :2]
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum() / np.linalg.norm(places[-1] - places[0]))


def longest_rest(episode: Episode) -> int:
    """Steps in which the hand hardly moved, the most in a row."""
    still = np.linalg.norm(np.diff(episode.tensors["obs/robot0_eef_pos"], axis=0), axis=1) < 0.003
    ends = np.flatnonzero(~still)
    return int(np.diff(np.concatenate([[-1], ends, [len(still)]])).max()) - 1


@pytest.mark.usefixtures("library")
def test_poor_demonstrators_miss_hesitate_and_go_astray() -> None:
    with driven("PickPlaceCan") as session:
        good = [shown(session, FIRST + seed, None) for seed in range(4)]
        poor = [shown(session, FIRST + seed, "poor") for seed in range(4)]
    assert sum(map(times_missed, good)) == 0
    assert sum(map(times_missed, poor)) >= 1
    assert np.median([longest_rest(each) for each in poor]) > np.median([longest_rest(each) for each in good])
    assert np.median([wandering(each) for each in poor]) > np.median([wandering(each) for each in good])


class Waiting:
    """An expert that moves in no demonstrator's manner, because nothing of `parts` moves it."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        del scene, rng

    def act(self) -> Array:
        """Nothing."""
        return np.zeros(7)


@pytest.mark.usefixtures("library")
def test_what_has_one_skill_only_is_not_called_another() -> None:
    with driven("Lift") as session:
        session.task = dataclasses.replace(session.task, expert=Waiting, max_steps=2)
        assert not shown(session, FIRST, "good").success
        for asked in ("mixed", "poor"):
            with pytest.raises(RequestError, match=r"'Lift'.*one skill only: good") as caught:
                shown(session, FIRST, asked)
            assert caught.value.kind == "no_skill"


@pytest.mark.parametrize("task", ["TwoArmLift", "TwoArmHandover", "TwoArmPegInHole", "TwoArmTransport"])
def test_both_arms_move_in_the_demonstrators_manner(task: str) -> None:
    session = envs.make(task)
    envs.reset(session, FIRST)
    shown_by = Demonstrator.draw("poor", FIRST)
    assert session.task.expert is not None
    find(session.task.expert)(Scene(session.env, shown_by=shown_by), np.random.default_rng(0))
    assert shown_by.arms == 2
    session.env.close()


def test_a_worker_takes_skills_and_refuses_unknown_ones_by_name(lift: Client) -> None:
    for unknown in ("careless", ""):
        with pytest.raises(WorkerError, match=r"no_skill: unknown skill .*known: good, mixed, poor") as caught:
            lift.ask("expert", seed=FIRST, skill=unknown)
        assert repr(unknown) in str(caught.value)
    with pytest.raises(WorkerError, match=r"bad_request: expert: skill must be text, got \[3\]"):
        lift.ask("expert", seed=FIRST, skill=[3])
    message, data = lift.ask("expert", seed=FIRST, skill="poor")
    assert message["attrs"]["skill"] == "poor"
    usual, before = lift.ask("expert", seed=FIRST)
    assert "skill" not in usual["attrs"]
    assert len(data["actions"]) > len(before["actions"])


def test_the_bar_of_less_able_demonstrators_is_not_above_any_tasks() -> None:
    assert all(bar >= LESS_ABLE for bar in BARS.values())


def test_counting_goes_on_after_a_line_that_was_cut_off(tmp_path: Path) -> None:
    out = tmp_path / "outcomes.jsonl"
    outcomes = [Outcome("Lift", "compiled", FIRST + k, True, 50, 2) for k in range(3)]
    for outcome in outcomes[:2]:
        write(out, outcome)
    out.write_bytes(out.read_bytes()[:-20])
    assert read(out) == outcomes[:1]
    for outcome in outcomes[1:]:
        write(out, outcome)
    assert read(out) == outcomes
