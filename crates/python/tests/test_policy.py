"""Policies: the bits that `actrm-zoo eval` computes, rows, threads, what is refused."""

from __future__ import annotations

import json
import pickle
import shutil
import threading
from pathlib import Path
from types import MappingProxyType

import actrm
import numpy as np
import pytest
from conftest import LIFT, ROOT, computed, train

ENTRIES = ("door-act", "lift-act", "nutassemblysquare-act", "pickplacecan-act", "stack-act", "stackthreecubes-act")
# small ones, of every kind that remembers, draws or copies
NETWORK = ("policy.network.down_dims=[8,8]", "policy.network.step_embed_dim=8")
KINDS = {
    "actrm": (),
    "bc": (),
    "bc_rnn": ("policy.hidden_dim=16",),
    "bc_transformer": ("policy.dim_model=16", "policy.n_heads=2", "policy.n_layers=1"),
    "diffusion": NETWORK,
    "flow": NETWORK,
    "mip": NETWORK,
    "nearest": (),
}


def observations(policy: actrm.Policy, count: int, seed: int = 0) -> list[dict[str, np.ndarray]]:
    """Numbers of about the size that data have."""
    rng = np.random.default_rng(seed)
    shapes = policy.input_features
    return [{key: rng.normal(0, 0.5, shape).astype(np.float32) for key, shape in shapes.items()} for _ in range(count)]


@pytest.mark.parametrize("name", ENTRIES)
def test_chunks_are_what_the_entry_computes(zoo: Path, name: str) -> None:
    policy = actrm.load_policy(zoo / name)
    asked = observations(policy, 5)
    wanted = computed(zoo / name, asked)
    ours = np.stack([policy.predict_action_chunk(one) for one in asked])
    assert ours.shape == (5, policy.action_horizon, 7)
    np.testing.assert_array_equal(ours.view(np.uint32), wanted.view(np.uint32))


def test_a_checkpoint_in_several_files_is_the_same_policy(tmp_path: Path) -> None:
    """LeRobot's, with Hugging Face's list of its files."""
    whole, parts = ROOT / "crates/interchange/tests/fixtures/lerobot/environment_raw", tmp_path / "parts"
    shutil.copytree(whole, parts)
    part = (parts / "model.safetensors").rename(parts / "model-00001-of-00001.safetensors")
    content = part.read_bytes()
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    files = {name: part.name for name in header if name != "__metadata__"}
    (parts / "model.safetensors.index.json").write_text(json.dumps({"weight_map": files}))
    one, two = actrm.load_policy(whole), actrm.load_policy(parts)
    for seen in observations(one, 2):
        np.testing.assert_array_equal(two.predict_action_chunk(seen), one.predict_action_chunk(seen))


@pytest.mark.parametrize("kind", KINDS)
def test_what_remembers_and_what_draws_computes_the_same(lift: Path, tmp_path: Path, kind: str) -> None:
    """Policies that look back, go on from a thought or draw: asked one after the other, and anew after a reset."""
    entry = train(f"{kind}_lift", lift, tmp_path, *KINDS[kind])
    policy = actrm.load_policy(entry)
    asked = observations(policy, 4)
    wanted = computed(entry, asked)
    for _ in range(2):
        policy.reset(seed=0)
        ours = np.stack([policy.predict_action_chunk(one, executed=0) for one in asked])
        np.testing.assert_array_equal(ours.view(np.uint32), wanted.view(np.uint32))


def test_a_robot_s_conventions_are_compared_by_name(zoo: Path) -> None:
    said = actrm.load_policy(zoo / "lift-act-s1").conventions
    assert said["control_freq"] == "20" and said["gripper"] == "-1 opens, 1 closes"
    actrm.load_policy(zoo / "lift-act-s1", conventions=said)
    for name, value in said.items():
        with pytest.raises(actrm.Error) as error:
            actrm.load_policy(zoo / "lift-act-s1", conventions={**said, name: "another"})
        assert name in str(error.value) and value in str(error.value)
    with pytest.raises(actrm.Error, match="unknown convention `rate`"):
        actrm.load_policy(zoo / "lift-act-s1", conventions={"rate": "20"})


def test_a_policy_is_found_by_path_and_by_name(zoo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [zoo / "lift-act", f"{zoo}/lift-act@1", str(zoo / "lift-act/1"), f"{zoo}/lift-act/"]
    found = [actrm.load_policy(path) for path in paths] + [actrm.load_policy("lift-act", zoo=zoo)]
    monkeypatch.setenv("ACTRM_ZOO_DIR", str(zoo))
    found.append(actrm.load_policy("lift-act@1"))
    assert {policy.id for policy in found} == {"lift-act@1"}
    assert {policy.path for policy in found} == {zoo / "lift-act/1"}
    policy = found[0]
    assert policy.input_features == {"observation.state": (9,), "observation.environment_state": (10,)}
    assert policy.output_features == {"action": (7,)}
    assert policy.observation_keys["observation.environment_state"] == ["object"]
    assert (policy.task, policy.kind, policy.n_obs_steps) == ("Lift", "act", 1)
    assert "lift-act@1" in policy.card and "lift-act@1" in repr(policy)
    assert policy.parameters > 100_000


def test_actions_are_the_heads_of_chunks(zoo: Path) -> None:
    policy = actrm.load_policy(zoo / "stack-act")
    asked = observations(policy, 2 * policy.n_action_steps)
    policy.reset(seed=3)
    actions = [policy.select_action(one) for one in asked]
    policy.reset(seed=3)
    chunks = [policy.predict_action_chunk(one) for one in asked[:: policy.n_action_steps]]
    for i, action in enumerate(actions):
        np.testing.assert_array_equal(action, chunks[i // policy.n_action_steps][i % policy.n_action_steps])


def test_a_policy_that_looks_back_is_shown_every_step(lift: Path, tmp_path: Path) -> None:
    """Asked for chunks, with the steps between shown, it plans what it executes step by step."""
    policy = actrm.load_policy(train("diffusion_lift", lift, tmp_path, *NETWORK))
    assert (policy.n_obs_steps, policy.n_action_steps) == (2, 8)
    asked = observations(policy, 2 * policy.n_action_steps)
    policy.reset(seed=5)
    actions = np.stack([policy.select_action(one) for one in asked])
    policy.reset(seed=5)
    planned = []
    for i, one in enumerate(asked):
        if i % policy.n_action_steps:
            policy.observe(one)
        else:
            planned.append(policy.predict_action_chunk(one)[: policy.n_action_steps])
    np.testing.assert_array_equal(np.concatenate(planned), actions)


def test_rows_of_a_batch_are_episodes_of_their_own(zoo: Path) -> None:
    policy, single = actrm.load_policy(zoo / "stack-act"), actrm.load_policy(zoo / "stack-act")
    rows, steps = 3, policy.n_action_steps + 2
    asked = [observations(policy, rows, seed) for seed in range(steps)]
    policy.reset(seed=[7, 8, 9])
    together = []
    for step in asked:
        together.append(policy.select_action({key: np.stack([one[key] for one in step]) for key in step[0]}))
    assert together[0].shape == (rows, 7)
    for row in range(rows):
        single.reset(seed=7 + row)
        for step in range(steps):
            np.testing.assert_array_equal(single.select_action(asked[step][row]), together[step][row])


def test_other_types_are_taken_as_numpy_takes_them(zoo: Path) -> None:
    policy = actrm.load_policy(zoo / "lift-act")
    one = observations(policy, 1)[0]
    wanted = policy.predict_action_chunk(one)
    as_lists = {key: [float(x) for x in value] for key, value in one.items()}
    as_doubles = {key: value.astype(np.float64) for key, value in one.items()}
    strided = {key: np.repeat(value, 2)[::2] for key, value in one.items()}
    for other in (as_lists, as_doubles, strided, {**one, "task": "lift", "index": 3}):
        np.testing.assert_array_equal(policy.predict_action_chunk(other), wanted)


def test_a_feature_of_one_number_needs_no_axis(tmp_path: Path) -> None:
    """Samples have none, as in LeRobot."""
    actrm.convert(LIFT, tmp_path / "data", state_keys=["robot0_gripper_qpos[0:1]"], progress=False)
    settings = ("data.state_keys=['robot0_gripper_qpos[0:1]']",)
    policy = actrm.load_policy(train("bc_lift", tmp_path / "data", tmp_path, *settings))
    assert policy.input_features["observation.state"] == (1,)
    ds = actrm.Dataset(tmp_path / "data")
    state = "observation.state"
    assert ds[0][state].shape == ()
    wanted = [policy.predict_action_chunk({**ds[i], state: ds[i][state][None]}) for i in (0, 1)]
    np.testing.assert_array_equal(policy.predict_action_chunk(ds[0]), wanted[0])
    np.testing.assert_array_equal(policy.predict_action_chunk(ds.batch([0, 1])), wanted)
    np.testing.assert_array_equal(policy.predict_action_chunk(ds.batch([0])), wanted[:1])


def test_a_refused_observation_changes_nothing(zoo: Path) -> None:
    """In the middle of a plan too, where the network is not asked."""
    policy = actrm.load_policy(zoo / "stack-act")
    asked = observations(policy, policy.n_action_steps + 2)
    policy.reset(seed=3)
    wanted = [policy.select_action(one) for one in asked]
    policy.reset(seed=3)
    for one, action in zip(asked, wanted, strict=True):
        for ask in (policy.select_action, policy.observe):
            with pytest.raises(actrm.Error, match="observation.environment_state is missing; given: observation.state"):
                ask({"observation.state": one["observation.state"]})
        np.testing.assert_array_equal(policy.select_action(MappingProxyType(one)), action)


def test_a_policy_pickles(zoo: Path) -> None:
    policy = actrm.load_policy(zoo / "lift-act")
    one = observations(policy, 1)[0]
    again = pickle.loads(pickle.dumps(policy))
    np.testing.assert_array_equal(again.predict_action_chunk(one), policy.predict_action_chunk(one))


def test_several_threads_may_ask(zoo: Path) -> None:
    policy = actrm.load_policy(zoo / "lift-act")
    asked = observations(policy, 8)
    wanted = [policy.predict_action_chunk(one) for one in asked]
    wrong: list[int] = []

    def work(worker: int) -> None:
        for turn in range(50):
            i = (worker + turn) % len(asked)
            if not np.array_equal(policy.predict_action_chunk(asked[i]), wanted[i]):
                wrong.append(i)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert wrong == []


def test_what_does_not_fit_is_named(zoo: Path) -> None:
    policy = actrm.load_policy(zoo / "lift-act")
    good = observations(policy, 1)[0]
    state, objects = good["observation.state"], good["observation.environment_state"]
    for asked, words in [
        ({}, "feature observation.state is missing"),
        ({"observation.state": state}, "observation.environment_state is missing; given: observation.state"),
        ({**good, "observation.state": state[:5]}, r"observation.state has shape \[5\], expected \[9\]"),
        ({**good, "observation.state": np.zeros((0, 9))}, r"has shape \[0, 9\], expected \[9\]"),
        ({**good, "observation.state": np.zeros((2, 3, 9))}, r"has shape \[2, 3, 9\]"),
        ({**good, "observation.state": None}, r"observation.state has shape \[\], expected \[9\]"),
        ({**good, "observation.state": 1.0}, r"observation.state has shape \[\], expected \[9\]"),
        ({**good, "observation.state": state[None]}, "observation.environment_state has no rows, expected 1"),
        (
            {"observation.state": state[None], "observation.environment_state": np.stack([objects] * 2)},
            "environment_state has 2 rows, expected 1",
        ),
    ]:
        for ask in (policy.predict_action_chunk, policy.select_action):
            with pytest.raises(actrm.Error, match=words):
                ask(asked)
    with pytest.raises(ValueError, match="observation.state: could not convert"):
        policy.select_action({**good, "observation.state": ["a"] * 9})
    for error in (KeyboardInterrupt, MemoryError):

        class Raising:
            def __array__(self, *_: object, error: type = error) -> np.ndarray:
                raise error

        with pytest.raises(error):
            policy.select_action({**good, "observation.state": Raising()})
    broken = np.stack([state, state])
    broken[1, 4] = np.nan
    with pytest.raises(ValueError, match=r"observation.state\[1, 4\] is NaN, expected a finite number"):
        policy.select_action({"observation.state": broken, "observation.environment_state": np.stack([objects] * 2)})
    with pytest.raises(ValueError, match=r"observation.state\[0\] is inf"):
        policy.predict_action_chunk({**good, "observation.state": np.full(9, np.inf)})
    with pytest.raises(TypeError):
        policy.select_action(3)  # type: ignore[arg-type]
    for seed in (-1, [3, -1]):
        with pytest.raises(ValueError, match="seed: expected a whole number from 0, below 2\\^64, found -1"):
            policy.reset(seed)
    policy.reset(seed=[1])
    with pytest.raises(ValueError, match="one for each row"):
        policy.select_action({key: np.stack([value] * 2) for key, value in good.items()})
    policy.reset()
    assert np.isfinite(policy.select_action(good)).all()


def test_the_largest_numbers_do_no_harm(zoo: Path) -> None:
    """Nothing crashes, and what comes out is no action."""
    policy = actrm.load_policy(zoo / "lift-act")
    one = observations(policy, 1)[0]
    one["observation.environment_state"][3] = -3e38
    for ask in (policy.predict_action_chunk, policy.select_action):
        with pytest.raises(actrm.Error, match="an action is NaN, .* 3e38 in observation.environment_state"):
            ask(one)


def test_every_byte_of_an_entry_is_checked(zoo: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(zoo / "lift-act", tmp_path / "lift-act")
    for name in ("model.safetensors", "config.toml", "normaliser.safetensors", "README.md", "entry.json"):
        path = tmp_path / "lift-act/1" / name
        whole = path.read_bytes()
        changed = bytearray(whole)
        changed[len(changed) // 2] ^= 1
        path.write_bytes(changed)
        with pytest.raises(actrm.Error, match=f"{name}: sha256 does not match"):
            actrm.load_policy(tmp_path / "lift-act")
        path.unlink()
        with pytest.raises(actrm.Error):
            actrm.load_policy(tmp_path / "lift-act")
        path.write_bytes(whole)
    actrm.load_policy(tmp_path / "lift-act")


def test_an_unknown_entry_lists_what_there_is(zoo: Path) -> None:
    with pytest.raises(
        actrm.Error, match=r"unknown entry `lfit-act` in zoo .*did you mean `lift-act`.*`actrm-zoo list` shows all"
    ):
        actrm.load_policy(zoo / "lfit-act")
    for path in ("", "/", "a\0b", "..", "no/such/place"):
        with pytest.raises((actrm.Error, ValueError)):
            actrm.load_policy(path, zoo=zoo)
