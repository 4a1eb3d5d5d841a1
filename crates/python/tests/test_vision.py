"""Pictures: as training reads them, and policies that see, with the bits and outcomes that `actrm-zoo` has."""

from __future__ import annotations

from pathlib import Path

import actrm
import numpy as np
import pytest
from conftest import RELEASE, computed, output, train

CAMERAS = ("observation.images.agentview", "observation.images.robot0_eye_in_hand")
SIDE = 24
SMALL = ("policy.dim_model=16", "policy.n_heads=2", "policy.dim_feedforward=16", "policy.n_encoder_layers=1")


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two demonstrations of Lift, seen by two cameras."""
    folder = tmp_path_factory.mktemp("seen")
    cameras = ("--cameras", "agentview,robot0_eye_in_hand", "--image-size", str(SIDE), "--fast-render")
    where = ("--no-next-obs", "--out", folder / "seen.hdf5")
    output(RELEASE / "actrm-data", "collect", "--task", "Lift", "--episodes", "2", *cameras, *where)
    actrm.convert(folder / "seen.hdf5", folder / "set", progress=False, env_keys=[])
    return folder / "set"


@pytest.fixture(scope="module")
def entry(seen: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that sees, hardly trained."""
    return train("act_lift_image", seen, tmp_path_factory.mktemp("trained"), *SMALL, "policy.vision.crop=20")


def test_pictures_have_lerobot_s_shape_and_range(seen: Path) -> None:
    ds = actrm.Dataset(seen, {CAMERAS[0]: [-1, 0]})
    stored = actrm.Dataset(seen, {CAMERAS[0]: [-1, 0]}, return_uint8=True)
    for i in (0, 5, len(ds) - 1):
        scaled, raw = ds[i], stored[i]
        assert scaled[CAMERAS[0]].shape == raw[CAMERAS[0]].shape == (2, 3, SIDE, SIDE)
        assert scaled[CAMERAS[1]].shape == (3, SIDE, SIDE)
        for camera in CAMERAS:
            assert scaled[camera].dtype == np.float32 and raw[camera].dtype == np.uint8
            np.testing.assert_array_equal(raw[camera].astype(np.float32) / np.float32(255), scaled[camera])
    first = stored[0]
    assert first[f"{CAMERAS[0]}_is_pad"].tolist() == [True, False]
    np.testing.assert_array_equal(first[CAMERAS[0]][0], first[CAMERAS[0]][1])
    np.testing.assert_array_equal(stored[5][CAMERAS[0]][0], stored[4][CAMERAS[0]][1])
    assert len(np.unique(first[CAMERAS[1]])) > 20
    assert stored.stats[CAMERAS[0]]["mean"].shape == (3, 1, 1)
    assert [key for key in actrm.Dataset(seen, cameras=[CAMERAS[1]])[0] if "images" in key] == [CAMERAS[1]]


def test_pictures_are_what_training_reads(seen: Path) -> None:
    horizon, size, seed, steps = 8, 16, 3, 7
    ds = actrm.Dataset(seen, {"action": range(horizon)}, split="train", return_uint8=True)
    program = RELEASE / "examples/training_windows"
    read = np.frombuffer(output(program, seen, "train", *map(str, (horizon, size, seed, steps))), np.float32)
    ours = []
    for batch in ds.batches(size, seed=seed, steps=steps, threads=2):
        numbers = (batch[key] for key in ("observation.state", "action", "action_is_pad"))
        pictures = (np.moveaxis(batch[camera], 1, -1) for camera in CAMERAS)
        ours += [values.astype(np.float32).ravel() for values in (*numbers, *pictures)]
    np.testing.assert_array_equal(np.concatenate(ours), read)


def test_pictures_of_another_range_are_refused(seen: Path, entry: Path) -> None:
    policy = actrm.load_policy(entry)
    bright = actrm.Dataset(seen)[0]
    one = {key: bright[key] for key in policy.input_features}
    camera = CAMERAS[1]
    for wrong in (one[camera] * 255, one[camera] - 0.5, np.full_like(one[camera], np.nan)):
        with pytest.raises(ValueError, match=f"{camera} holds float32, expected values from 0 to 1, found"):
            policy.predict_action_chunk({**one, camera: wrong})


def test_pictures_are_taken_as_they_come(seen: Path, entry: Path) -> None:
    """Bytes or 0 to 1, colours first or last, one or several: the bits that the entry computes."""
    policy = actrm.load_policy(entry)
    assert {name: policy.input_features[name] for name in CAMERAS} == dict.fromkeys(CAMERAS, (3, SIDE, SIDE))
    bright, raw = actrm.Dataset(seen), actrm.Dataset(seen, return_uint8=True)
    places = (0, 9, len(raw) - 1)

    def last(i: int) -> dict[str, np.ndarray]:
        one = {key: raw[i][key] for key in policy.input_features}
        return {**one, **{camera: np.moveaxis(one[camera], 0, -1) for camera in CAMERAS}}

    wanted = computed(entry, [last(i) for i in places])
    for given in ([bright[i] for i in places], [raw[i] for i in places], [last(i) for i in places]):
        planned = np.stack([policy.predict_action_chunk(one) for one in given])
        np.testing.assert_array_equal(planned.view(np.uint32), wanted.view(np.uint32))
    for ds in (bright, raw):
        rows = policy.predict_action_chunk(ds.batch(places))
        np.testing.assert_array_equal(rows.view(np.uint32), wanted.view(np.uint32))
    one = raw[0]
    with pytest.raises(TypeError, match="holds int64, expected uint8 from 0 to 255 or float from 0 to 1"):
        policy.select_action({**one, CAMERAS[0]: one[CAMERAS[0]].astype(np.int64)})
    with pytest.raises(actrm.Error, match=rf"{CAMERAS[1]} has shape \[3, 8, {SIDE}\], expected \[{SIDE}, {SIDE}, 3\]"):
        policy.select_action({**one, CAMERAS[1]: one[CAMERAS[1]][:, :8]})
    with pytest.raises(actrm.Error, match=rf"{CAMERAS[1]} has shape \[3, 0, {SIDE}\]"):
        policy.select_action({**one, CAMERAS[1]: bright[0][CAMERAS[1]][:, :0]})
    with pytest.raises(actrm.Error, match=f"{CAMERAS[1]} is missing"):
        policy.select_action({key: value for key, value in one.items() if key != CAMERAS[1]})


def test_an_episode_that_is_seen_is_the_evaluation_s(entry: Path, tmp_path: Path) -> None:
    gymnasium = pytest.importorskip("gymnasium")
    import actrm.envs  # noqa: F401  registers the environments

    steps = 12
    stored = actrm.evaluate(entry, episodes=1, workers=1, max_steps=steps, results=tmp_path, progress=False)
    policy = actrm.load_policy(entry)
    env = gymnasium.make("actrm/Lift-v0", entry=str(entry), max_steps=steps)
    assert env.observation_space[CAMERAS[0]] == gymnasium.spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8)
    seed = int(stored["seed"][0])
    policy.reset(seed=seed)
    observation, info = env.reset(seed=seed)
    assert info["fingerprint"] == stored["fingerprint"][0]
    rewards, over = [], False
    while not over:
        assert observation in env.observation_space
        observation, reward, terminated, truncated, _ = env.step(policy.select_action(observation))
        rewards.append(reward)
        over = terminated or truncated
    assert truncated and sum(rewards) == stored["return"][0] and len(rewards) == stored["steps"][0] == steps
    env.close()
