"""Every task: episodes that depend on their seed alone, experts that solve it, and environments of our own."""

import dataclasses
import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from conftest import Client, WorkerError, walk

from actrm_harness.experts.cubes import CLEAR, RecoveringTowerExpert
from actrm_harness.experts.objects import BIN, FINGER, HALF_HAND, MilkExpert, roomy_yaw
from actrm_harness.experts.parts import Scene
from actrm_harness.protocol import RequestError
from actrm_harness.simulators.robosuite import control, envs, episodes, suite
from actrm_harness.tasks import TASKS

suite.prepare()

HERE = Path(__file__).resolve().parent


def trace(session: envs.Session, seed: int, steps: int = 12) -> list[object]:
    """Everything that an episode shows."""
    first = envs.reset(session, seed)
    seen: list[object] = [envs.fingerprint(session.env), *(first[name].tobytes() for name in sorted(first))]
    for action in walk(seed, steps, session.env.action_dim):
        result = envs.step_session(session, action)
        seen += [envs.state(session.env).tobytes(), result.reward, result.success]
        seen += [result.observation[name].tobytes() for name in sorted(result.observation)]
    return seen


@pytest.mark.parametrize("task", [name for name, task in TASKS.items() if task.soft_reset])
def test_a_soft_reset_is_a_hard_reset_bit_for_bit(task: str) -> None:
    """Kept models show the same episodes as models loaded again, after other episodes and after an expert's."""
    soft, hard = envs.make(task), envs.make(task)
    hard.task = dataclasses.replace(hard.task, soft_reset=False)
    trace(soft, 5, 3)
    short = dataclasses.replace(soft.task, max_steps=5)
    kept, soft.task = soft.task, short
    episodes.expert_episode(soft, 1)
    soft.task = kept
    for seed in (10_000, 3):
        assert trace(soft, seed) == trace(hard, seed)
    soft.env.close()
    hard.env.close()


def numbers(env: suite.Env) -> dict[str, bytes]:
    """Every number of the model, statistics included."""
    model = env.sim.model._model
    found: dict[str, bytes] = {}
    for owner in (model, model.stat, model.opt):
        for name in dir(owner):
            value: Any = getattr(owner, name)
            if not name.startswith("_") and isinstance(value, int | float | np.ndarray):
                found[f"{type(owner).__name__}.{name}"] = np.asarray(cast(Any, value)).tobytes()
    return found


def test_lifts_cube_drawn_anew_gives_the_model_that_loading_gives() -> None:
    soft, hard = envs.make("Lift"), envs.make("Lift")
    hard.task = dataclasses.replace(hard.task, soft_reset=False)
    sizes: set[bytes] = set()
    for seed in (3, 10_000, 7):
        envs.reset(soft, seed)
        envs.reset(hard, seed)
        kept, loaded = numbers(soft.env), numbers(hard.env)
        assert len(kept) > 300 and [name for name in kept if kept[name] != loaded[name]] == []
        assert envs.model_xml(soft.env) == envs.model_xml(hard.env)
        sizes.add(kept["MjModel.geom_size"])
    assert len(sizes) == 3
    soft.env.close()
    hard.env.close()


@pytest.mark.usefixtures("library")
def test_a_thing_that_slips_out_of_the_hand_is_taken_again() -> None:
    """The milk is put back where it was while the hand carries it."""
    session = envs.make("PickPlaceMilk")
    session.control = control.attach(session.env)
    envs.reset(session, 1_000_002, True)
    scene = Scene(session.env)
    expert = MilkExpert(scene, np.random.default_rng([1_000_002, 1]))
    data: Any = session.env.sim.data
    start = np.array(data.get_joint_qpos("Milk_joint0"))
    carried = solved = False
    steps = 0
    while not solved and steps < 400:
        solved = envs.step_session(session, np.clip(expert.act(), -1.0, 1.0)).success
        steps += 1
        if not carried and float(scene.body("Milk_main")[1]) > float(start[1]) + 0.1:
            carried = True
            data.set_joint_qpos("Milk_joint0", start)
            data.set_joint_qvel("Milk_joint0", np.zeros(6))
            session.env.sim.forward()
            assert float(np.linalg.norm(scene.body("Milk_main") - scene.hand)) > 0.1
    session.env.close()
    assert carried and solved


def test_the_hand_turns_only_where_there_is_no_room() -> None:
    """Beside a wall of the bin at a low thing, and where another thing stands in a finger's way."""
    middle = np.array([0.1, -0.25, 0.84])
    at_wall = np.array([0.1, -0.42, 0.84])
    assert roomy_yaw(middle, [], low=True) == 0.0
    assert roomy_yaw(at_wall, [], low=False) == 0.0
    turn = roomy_yaw(at_wall, [], low=True)
    assert at_wall[1] - HALF_HAND * np.cos(turn) >= BIN[0, 1] and 0.0 < abs(turn) < np.pi / 2
    neighbour = middle + np.array([0.0, 0.07, 0.0])
    turn = roomy_yaw(middle, [neighbour], low=False)
    fingers = [middle + side * FINGER * np.array([-np.sin(turn), np.cos(turn), 0.0]) for side in (-1.0, 1.0)]
    assert turn != 0.0 and min(float(np.linalg.norm(finger - neighbour)) for finger in fingers) >= CLEAR


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize("task", [task.name for task in TASKS.values() if task.experts])
def test_further_experts_solve_the_task_otherwise(task: str) -> None:
    session = envs.make(task)
    session.control = control.attach(session.env)
    usual = episodes.expert_episode(session, 1_000_000)
    for name, expert in TASKS[task].experts.items():
        marks = not expert.endswith(":RecoveringTowerExpert")
        episode = episodes.expert_episode(session, 1_000_000, True, name)
        assert not np.array_equal(episode.tensors["actions"], usual.tensors["actions"]), name
        assert ("mistakes" in episode.tensors) == marks, name
        if not episode.success:
            episode = episodes.expert_episode(session, 1_000_001, True, name)
        assert episode.success, name
    session.env.close()


@pytest.mark.usefixtures("library")
def test_what_the_recovering_expert_does_wrong_it_makes_up_for() -> None:
    """Over some episodes the middle cube stands, falls, and stands again."""
    session = envs.make("StackColor")
    session.control = control.attach(session.env)
    fallen = 0
    for seed in range(6):
        envs.reset(session, 30_000 + seed, True)
        scene = Scene(session.env)
        bottom, middle, _ = (f"{name}_main" for name in scene.task.order)
        expert = RecoveringTowerExpert(scene, np.random.default_rng([seed, 1]))
        stood, fell, solved = False, False, False
        for _ in range(600):
            solved = envs.step_session(session, np.clip(expert.act(), -1.0, 1.0)).success
            away = scene.body(middle) - scene.body(bottom)
            stands = abs(float(away[2]) - 0.04) < 0.008 and float(np.linalg.norm(away[:2])) < 0.03
            fell |= stood and float(away[2]) < 0.02
            stood |= stands
            if solved:
                break
        assert solved
        fallen += fell
        if fallen:
            break
    session.env.close()
    assert fallen >= 1


@pytest.mark.usefixtures("library")
def test_a_hand_that_reached_beside_the_nut_reaches_again_and_succeeds() -> None:
    """A marked reach, and after it the nut in the hand and around its peg."""
    session = envs.make("NutAssemblySquare")
    session.control = control.attach(session.env)
    missed = 0
    for seed in range(12):
        found = episodes.expert_episode(session, 1_000_000 + seed, True, "regrasps")
        mistakes = found.tensors["mistakes"].astype(bool)
        assert 0.0 < float(mistakes.mean()) < 0.8
        # the table is 0.8 high, and the nut is let fall onto it at first
        lifted = found.tensors["obs/object"][20:, 2] > 0.9
        first = 20 + int(np.argmax(lifted)) if lifted.any() else found.steps
        # longer than any push or fumble, before the nut is lifted for the first time
        run = longest = 0
        for wrong in mistakes[:first]:
            run = (run + 1) * bool(wrong)
            longest = max(longest, run)
        missed += found.success and longest > 16
        if missed == 2:
            break
    session.env.close()
    assert missed == 2


@pytest.mark.usefixtures("library")
def test_a_hand_that_carried_nothing_comes_back_for_the_thing() -> None:
    """Its fingers met, it went on with that across the bins' wall or towards it, marked; and all four things arrive."""
    session = envs.make("PickPlace")
    session.control = control.attach(session.env)
    carried = 0
    for seed in range(4):
        found = episodes.expert_episode(session, 1_000_000 + seed, True, "recoveries")
        mistakes = found.tensors["mistakes"].astype(bool)
        fingers = found.tensors["obs/robot0_gripper_qpos"]
        hand = found.tensors["obs/robot0_eef_pos"]
        nothing = mistakes & (fingers[:, 0] - fingers[:, 1] < 0.01)
        starts = np.flatnonzero(nothing[1:] & ~nothing[:-1]) + 1
        ways = [hand[at : at + int(np.argmin(np.append(nothing[at:], False))), 1] for at in starts]
        carried += found.success and any(np.ptp(way) > 0.1 for way in ways)
        if carried:
            break
    session.env.close()
    assert carried == 1


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize(
    ("task", "name", "low"), [("NutAssemblySquare", "recoveries", 0), ("StackColor", "regrasps", 1)]
)
def test_a_hand_that_rests_where_it_should_not_goes_on_and_succeeds(task: str, name: str, low: int) -> None:
    """A nut on the top of its peg, a hand that stands beside a cube: still for a while, and solved all the same."""
    session = envs.make(task)
    session.control = control.attach(session.env)
    rested = 0
    for seed in range(12):
        found = episodes.expert_episode(session, 1_000_000 + seed, True, name)
        mistakes = found.tensors["mistakes"]
        assert mistakes.shape == (found.steps,) and set(mistakes.tolist()) == {0, 1}
        hand = found.tensors["obs/robot0_eef_pos"]
        still = np.linalg.norm(np.diff(hand, axis=0), axis=1) < 0.0008
        # beside a cube, or high above the table with the nut
        there = hand[:-1, 2] < 0.87 if low else hand[:-1, 2] > 0.9
        opened = found.tensors["actions"][:-1, 6] < 0
        waits = still & there & (opened if low else ~opened)
        run = longest = 0
        for waiting in waits:
            run = (run + 1) * bool(waiting)
            longest = max(longest, run)
        rested += found.success and longest >= 4
        if rested == 2:
            break
    session.env.close()
    assert rested == 2


@pytest.mark.usefixtures("library")
def test_a_misreach_is_marked_near_its_cube_only_and_ends() -> None:
    """A push is marked for 3 steps, a fumble for 13 at most; what lasts longer is a reach, which begins near a cube."""
    session = envs.make("StackThreeCubes")
    session.control = control.attach(session.env)
    reaches = 0
    for seed in range(4):
        found = episodes.expert_episode(session, 1_000_000 + seed, True, "misreaches")
        away = [np.linalg.norm(found.tensors[f"obs/gripper_to_{name}"], axis=1) for name in ("red", "green", "blue")]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], found.tensors["mistakes"], [0]])))
        for begin, end in edges.reshape(-1, 2):
            if end - begin > 16:
                reaches += 1
                assert end - begin < 90 and min(float(cube[begin]) for cube in away) < 0.14
    session.env.close()
    assert reaches >= 2


@pytest.mark.usefixtures("library")
def test_a_nut_taken_at_its_ring_is_let_go_and_its_handle_reached() -> None:
    """While fingers hold the ring it is marked; that they open again is not."""
    session = envs.make("NutAssemblySquare")
    session.control = control.attach(session.env)
    let_go = 0
    for seed in (3, 5, 7, 10):
        found = episodes.expert_episode(session, 1_000_000 + seed, True, "misreaches")
        assert found.success
        hand, nut = found.tensors["obs/robot0_eef_pos"], found.tensors["obs/object"]
        x, y, z, w = nut[:, 10:14].T
        handle = nut[:, 7:10] + 0.054 * np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], 1)
        beside = np.linalg.norm((hand - handle)[:, :2], axis=1) > 0.02
        gap = found.tensors["obs/robot0_gripper_qpos"] @ [1.0, -1.0]
        marked, action = found.tensors["mistakes"] == 1, found.tensors["actions"]
        low = (hand[:, 2] < 0.88) & (nut[:, 7] < 0.0)
        holds = low & beside & (gap > 0.01) & (gap < 0.07) & (action[:, 6] > 0)
        assert not holds[~marked].any()
        opens = beside & ~marked & (action[:, 6] < 0)
        if holds.any():
            last = int(np.flatnonzero(holds)[-1])
            let_go += bool(opens[last : last + 12].sum() > 5)
    session.env.close()
    assert let_go == 3


def test_an_expert_that_a_task_has_not_is_refused_by_name() -> None:
    session = envs.make("StackColor")
    with pytest.raises(RequestError, match=r"'careless'.*known: misreaches, recoveries, regrasps"):
        episodes.expert_episode(session, 1, True, "careless")
    session.env.close()


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize("task", ["Stack", "StackThreeCubes"])
def test_reward_and_success_are_what_the_state_says(task: str) -> None:
    """A step judges the state once; judged anew, it says the same at every step of a solved episode."""
    session = envs.make(task)
    session.control = control.attach(session.env)
    demo = episodes.expert_episode(session, 1_000_000)
    envs.reset(session, 1_000_000)
    verdicts: set[tuple[float, bool]] = set()
    for action in demo.tensors["actions"]:
        result = envs.step_session(session, action)
        assert result.success == envs.success(session.env)
        assert result.reward == session.env.reward(action)
        verdicts.add((result.reward, result.success))
    assert len(verdicts) >= 2
    assert "staged_rewards" not in vars(session.env)
    session.env.close()


def test_extract_works_where_the_reward_wants_an_action() -> None:
    """Robosuite's Stack.reward() cannot be called without one; robomimic 0.5 fails there."""
    session = envs.make("Stack")
    short = dataclasses.replace(session.task, max_steps=4)
    session.task = short
    demo = episodes.expert_episode(session, 1_000_000)
    again = episodes.extract(session, demo.tensors["states"], demo.tensors["actions"], demo.attrs["model_file"])
    assert np.array_equal(again.tensors["rewards"], demo.tensors["rewards"])
    assert np.array_equal(again.tensors["obs/robot0_joint_pos"], demo.tensors["obs/robot0_joint_pos"])
    session.env.close()


def test_cubes_are_apart_and_success_is_as_specified() -> None:
    session = envs.make("StackThreeCubes")
    env = session.env
    for seed in range(20):
        envs.reset(session, seed)
        red, green, blue = (np.array(env.sim.data.get_body_xpos(f"{name}_main")) for name in ("red", "green", "blue"))
        assert min(np.linalg.norm((a - b)[:2]) for a, b in ((red, green), (red, blue), (green, blue))) >= 0.06

    def put(name: str, place: tuple[float, float, float]) -> tuple[float, bool]:
        env.sim.data.set_joint_qpos(f"{name}_joint0", np.array([*place, 1.0, 0.0, 0.0, 0.0]))
        env.sim.forward()
        return env.reward(np.zeros(7)), envs.success(env)

    put("blue", (0.2, 0.2, 0.82))
    assert put("red", (0.0, 0.0, 0.82)) == (0.0, False)
    assert put("green", (0.049, 0.0, 0.86)) == (0.5, False)
    assert put("green", (0.051, 0.0, 0.86)) == (0.0, False)
    assert put("green", (0.0, 0.0, 0.8745)) == (0.5, False)
    assert put("green", (0.0, 0.0, 0.8755)) == (0.0, False)
    put("green", (0.0, 0.0, 0.86))
    assert put("blue", (0.0, 0.0, 0.90)) == (1.0, True)
    env.close()


def test_stack_color_has_to_be_read() -> None:
    """Slots and goals vary; demonstrations keep to four orders and exact colours, evaluation does not."""
    session = envs.make("StackColor")
    seen: dict[bool, set[tuple[str, ...]]] = {True: set(), False: set()}
    firsts: set[bytes] = set()
    for demonstration in (True, False):
        for seed in range(60):
            seen_now = envs.reset(session, seed, demonstration=demonstration)
            value = seen_now["object"]
            meta = session.env.get_ep_meta()
            seen[demonstration].add(tuple(meta["order"]))
            colors = np.array([value[10 * slot + 7 : 10 * slot + 10] for slot in range(3)])
            firsts.add(colors[0].round().tobytes())
            exact = bool(np.all((colors == 0) | (colors == 1)))
            assert exact == demonstration
            assert value.shape == (48,)
            places = {tuple(value[39 + 3 * place : 42 + 3 * place]): place for place in range(3)}
            for slot in range(3):
                place = places[tuple(colors[slot].round())]
                found = seen_now[f"gripper_to_place{place}"]
                np.testing.assert_allclose(found, value[30 + 3 * slot : 33 + 3 * slot], atol=1e-9)
            if demonstration:
                assert meta["group"] == "seen"
    assert len(seen[True]) == 4 and len(seen[False]) == 6 and seen[True] < seen[False]
    assert len(firsts) == 3
    session.env.close()


def test_a_worker_tells_split_and_group() -> None:
    """An evaluation need not ask for its split; both are in the reply, and demonstrations keep to the seen orders."""
    client = Client("--task", "StackColor")
    groups: dict[str, set[str]] = {"evaluation": set(), "demonstration": set()}
    for seed in range(12):
        plain, first = client.ask("reset", seed=seed)
        named, again = client.ask("reset", seed=seed, split="evaluation")
        assert {**plain, "id": 0} == {**named, "id": 0}
        assert first["obs/object"].tobytes() == again["obs/object"].tobytes()
        assert plain["split"] == "evaluation" and plain["group"] == plain["ep_meta"]["group"]
        groups["evaluation"].add(plain["group"])
        groups["demonstration"].add(client.ask("reset", seed=seed, split="demonstration")[0]["group"])
    assert groups == {"evaluation": {"seen", "unseen"}, "demonstration": {"seen"}}
    with pytest.raises(WorkerError, match="split must be one of"):
        client.ask("reset", seed=0, split="test")
    client.close()


def test_extract_reads_a_colour_episodes_goal_back() -> None:
    """States do not hold the goal and the slots; the demonstration's ep_meta does."""
    session = envs.make("StackColor")
    session.task = dataclasses.replace(session.task, max_steps=4)
    demo = episodes.expert_episode(session, 1_000_003)
    meta = json.loads(demo.attrs["ep_meta"])
    states, actions = demo.tensors["states"], demo.tensors["actions"]
    again = episodes.extract(session, states, actions, demo.attrs["model_file"], meta)
    assert again.attrs["ep_meta"] == demo.attrs["ep_meta"]
    seen, expected = again.tensors["obs/object"], demo.tensors["obs/object"]
    # poses of bodies are one substep fresher than in a live observation
    assert np.abs(seen - expected).max() < 5e-3
    assert np.array_equal(seen[:, -9:], expected[:, -9:])
    envs.reset(session, 0)
    assert session.env.get_ep_meta() != meta
    session.env.close()


def test_an_environment_of_ones_own_is_registered_by_its_module() -> None:
    paths = {"PYTHONPATH": f"{HERE}:{HERE.parent}"}
    client = Client("--task", "LiftHigh", "--env-module", "example_env", env=paths)
    assert client.ready["env_name"] == "LiftHigh"
    groups = {client.ask("reset", seed=seed)[0]["group"] for seed in range(4)}
    assert groups == {"left", "right"}
    assert client.step(np.zeros(7))[0]["success"] is False
    message, data = client.ask("expert", seed=0)
    assert message["success"] and data["obs/object"][-1][2] > 1.0
    client.close()


def test_the_documentation_shows_that_module() -> None:
    page = (HERE.parents[2] / "docs" / "howto" / "tasks.md").read_text()
    assert f"```python\n{(HERE / 'example_env.py').read_text()}```" in page


def test_a_task_without_an_expert_says_so() -> None:
    client = Client("--task", "PickPlaceSingle")
    with pytest.raises(WorkerError, match="no scripted expert"):
        client.ask("expert", seed=0)
    client.close()


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize("task", [name for name, task in TASKS.items() if task.expert])
def test_an_expert_solves_the_task_by_its_stages_and_who_does_nothing_passes_none(task: str) -> None:
    """Two seeds each; `actrm_harness.check_experts` counts over 200. Looking at stages changes nothing."""
    session = envs.make(task)
    session.control = control.attach(session.env)
    names: list[str] = []
    for seed in (1_000_000, 1_000_001):
        episode = episodes.expert_episode(session, seed)
        names = [name for name, _ in session.stages]
        assert (episode.success, episode.progress, session.reached) == (True, 1.0, len(names)), names
    assert len(set(names)) == len(names) > 0
    envs.reset(session, 10_000)
    assert session.reached == 0
    idle = np.zeros(session.env.action_dim)
    if "maze" not in task.lower():
        _, rewards = envs.steps_session(session, np.array([idle] * 5))
        assert session.progress(False) == 0.0 and not rewards.any()
    unseen = envs.make(task)
    unseen.control = control.attach(unseen.env)
    for one in (session, unseen):
        envs.reset(one, 10_001)
    unseen.stages = ()
    for action in walk(3, 12, session.env.action_dim):
        one, other = envs.step_session(session, action), envs.step_session(unseen, action)
        assert one.reward == other.reward and session.progress(False) is not None and unseen.progress(False) is None
        assert envs.state(session.env).tobytes() == envs.state(unseen.env).tobytes()
    session.env.close()
    unseen.env.close()


def test_an_expert_moves_another_robot_with_its_usual_controller() -> None:
    session = envs.make("Lift", env_args={"env_kwargs": {"robots": "UR5e"}})
    assert session.unusual is not None and episodes.expert_episode(session, 5).success
    recorded = envs.make("Lift", env_args=session.env_args)
    assert (recorded.unusual, recorded.task.expert) == (session.unusual, session.task.expert)
    other = envs.make("Lift", env_args={"env_kwargs": {"robots": "UR5e", "control_freq": 10}})
    assert other.task.expert is None
