"""Images: as robosuite draws them, whatever other contexts do, and without a trace in the episode."""

import dataclasses
import gc
import importlib
import platform
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Client, WorkerError, walk

from actrm_harness import wire
from actrm_harness.simulators.robosuite import envs, episodes, render, suite

suite.prepare()


def do_nothing(*_: object) -> None:
    """Stand in for something that is switched off."""


def play(session: envs.Session, steps: int = 3) -> None:
    envs.reset(session, 5)
    for action in walk(1, steps):
        envs.step_session(session, action)


@pytest.fixture(scope="module")
def session() -> envs.Session:
    return envs.make("Lift")


def test_an_image_is_what_robosuite_draws(session: envs.Session) -> None:
    play(session)
    ours = envs.image(session, "agentview", 84, 96)
    binding: Any = importlib.import_module("robosuite.utils.binding_utils")
    sim: Any = session.env.sim
    context = binding.MjRenderContextOffscreen(sim, device_id=-1)
    context.vopt.geomgroup[0], context.vopt.geomgroup[1] = 0, 1
    # robosuite's constructor ran mj_forward: draw both from the state that it left.
    ours_after = envs.image(session, "agentview", 84, 96)
    context.gl_ctx.make_current()
    theirs = sim.render(96, 84, camera_name="agentview")[::-1]
    assert ours.shape == (84, 96, 3) and ours.std() > 10
    assert np.array_equal(ours_after, theirs)
    sim._render_context_offscreen = None


def test_a_collected_context_does_not_corrupt_a_live_one(
    session: envs.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The corruption is provoked first, with the cure switched off, and then does not happen with it."""
    play(session)
    before = envs.image(session, "agentview", 84, 84)

    def disturb() -> None:
        other = render.Renderer()
        other.image(session.env.sim, "frontview", 84, 84)
        del other
        gc.collect()

    with monkeypatch.context() as patch:
        disturb()
        patch.setattr(render.Renderer, "make_current", do_nothing)
        corrupted = envs.image(session, "agentview", 84, 84)
    assert not np.array_equal(corrupted, before)
    disturb()
    assert np.array_equal(envs.image(session, "agentview", 84, 84), before)


def test_a_recorded_episode_is_not_corrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    """What goes into a data set, while contexts come and go around it."""
    session = envs.make("Lift", ("agentview",), 48)
    session.task = dataclasses.replace(session.task, max_steps=3)
    expected = episodes.expert_episode(session, 4).tensors["obs/agentview_image"]
    look = envs.images

    def disturbed(*arguments: Any) -> wire.Tensors:
        other = render.Renderer()
        other.image(session.env.sim, "frontview", 48, 48)
        del other
        gc.collect()
        return look(*arguments)

    monkeypatch.setattr(envs, "images", disturbed)
    assert np.array_equal(episodes.expert_episode(session, 4).tensors["obs/agentview_image"], expected)
    # without the cure it would be
    monkeypatch.setattr(session.renderer, "make_current", do_nothing)
    assert not np.array_equal(episodes.expert_episode(session, 4).tensors["obs/agentview_image"], expected)
    session.env.close()


def test_images_follow_the_model_after_a_hard_reset(session: envs.Session) -> None:
    envs.reset(session, 1)
    first = envs.image(session, "agentview", 64, 64)
    envs.reset(session, 2)
    second = envs.image(session, "agentview", 64, 64)
    envs.reset(session, 1)
    assert not np.array_equal(first, second)
    assert np.array_equal(envs.image(session, "agentview", 64, 64), first)


def test_a_larger_image_than_before_is_drawn(session: envs.Session) -> None:
    envs.reset(session, 1)
    small = envs.image(session, "agentview", 64, 64)
    large = envs.image(session, "agentview", 720, 960)
    assert large.shape == (720, 960, 3) and large.std() > 10
    assert np.array_equal(envs.image(session, "agentview", 64, 64), small)


def test_drawing_leaves_the_episode_as_it_was(session: envs.Session) -> None:
    def outcome(draw: bool) -> list[bytes]:
        envs.reset(session, 9)
        seen: list[bytes] = []
        for action in walk(2, 25):
            if draw:
                envs.image(session, "agentview", 32, 32)
            result = envs.step_session(session, action)
            seen += [result.observation["object"].tobytes(), envs.state(session.env).tobytes()]
        return seen

    assert outcome(draw=False) == outcome(draw=True)


def test_the_worker_renders_and_observes_cameras() -> None:
    client = Client("--task", "Lift", "--cameras", "agentview,robot0_eye_in_hand", "--size", "32")
    assert client.ready["observations"]["agentview_image"] == [32, 32, 3]
    assert client.ready["env_args"]["env_kwargs"]["camera_names"] == ["agentview", "robot0_eye_in_hand"]
    assert "OpenGL" in client.ready["renderer"] and " bits" not in client.ready["renderer"]
    _, seen = client.ask("reset", seed=3)
    _, drawn = client.ask("render", camera="agentview", size=[32, 32])
    assert drawn["image"].dtype == np.uint8
    assert np.array_equal(seen["obs/agentview_image"], drawn["image"])
    assert not np.array_equal(seen["obs/agentview_image"], seen["obs/robot0_eye_in_hand_image"])
    with pytest.raises(WorkerError, match="agentview") as caught:
        client.ask("render", camera="nowhere", size=[32, 32])
    assert caught.value.message["kind"] == "unknown_camera"
    with pytest.raises(WorkerError, match="size"):
        client.ask("render", camera="agentview", size=[32, 0])
    client.close()


def test_where_nothing_can_draw_the_error_names_a_package(
    session: envs.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(render, "_egl_works", do_nothing)
    monkeypatch.setattr(render.ctypes.util, "find_library", do_nothing)
    monkeypatch.setattr(session, "renderer", None)
    with pytest.raises(envs.RequestError, match="libosmesa6") as caught:
        envs.image(session, "agentview", 32, 32)
    assert caught.value.kind == "no_renderer"


def test_a_software_renderer_names_the_processor(session: envs.Session) -> None:
    name = envs.renderer(session).name()
    if "llvmpipe" not in name:
        pytest.skip(f"a device draws here: {name}")
    assert " bits" not in name
    cpuinfo = Path("/proc/cpuinfo").read_text(errors="replace")
    vendor = next((line.split(":")[1].strip() for line in cpuinfo.splitlines() if line.startswith("vendor_id")), None)
    assert f", {vendor or platform.machine()})" in name


@pytest.mark.parametrize("devices", ["", "-1", "GPU-1a2b", "77,0"])
def test_a_gpu_that_is_hidden_from_others_does_not_stop_drawing(
    session: envs.Session, monkeypatch: pytest.MonkeyPatch, devices: str
) -> None:
    """Where CUDA may compute is nothing to EGL, unless one of its devices can be meant."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", devices)
    monkeypatch.delenv("MUJOCO_EGL_DEVICE_ID", raising=False)
    module: Any = importlib.import_module("robosuite.renderers.context.egl_context")
    monkeypatch.setattr(module, "EGL_DISPLAY", None)
    assert render.Renderer().name()
    assert render.os.environ["CUDA_VISIBLE_DEVICES"] == devices


def test_a_device_that_is_not_there_is_named(session: envs.Session, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "77")
    module: Any = importlib.import_module("robosuite.renderers.context.egl_context")
    monkeypatch.setattr(module, "EGL_DISPLAY", None)
    with pytest.raises(envs.RequestError, match="MUJOCO_EGL_DEVICE_ID") as caught:
        render.Renderer()
    assert caught.value.kind == "no_renderer"


def test_fast_rendering_changes_pixels_and_nothing_else() -> None:
    """Fewer reflections, the same episode; the environment's arguments say how its pictures were drawn."""
    drawn: dict[bool, wire.Tensors] = {}
    for fast in (False, True):
        session = envs.make("Lift", ("agentview", "robot0_eye_in_hand"), 48, fast_render=fast)
        envs.reset(session, 5)
        assert session.env_args.get("fast_render", False) is fast
        *_, result = [envs.step_session(session, action) for action in walk(1, 2)]
        drawn[fast] = result.observation
    for name, full in drawn[False].items():
        if name.endswith("_image"):
            off = np.abs(full.astype(int) - drawn[True][name].astype(int))
            assert 0 < off.mean() < 3, name
        else:
            assert np.array_equal(full, drawn[True][name]), name


@pytest.mark.parametrize("task", ["Lift", "PickPlaceCan", "Door"])
def test_what_is_left_out_cannot_be_seen(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fast pictures are those of all shapes, pixel by pixel, while something is left out."""
    session = envs.make(task)
    envs.reset(session, 3)
    cameras = ("agentview", "robot0_eye_in_hand", "frontview")
    fast, whole = render.Renderer(fast=True), render.Renderer(fast=True)
    monkeypatch.setattr(whole, "_leave_out", do_nothing)
    left_out = 0
    for action in walk(2, 10):
        session.env.step(action)
        for height, width in ((84, 84), (48, 96)):
            drawn = fast.images(session.env.sim, cameras, height, width)
            none = suite.mujoco().mjtGeom.mjGEOM_NONE
            scene: Any = vars(fast)["_scene"]
            left_out += sum(scene.geoms[index].type == none for index in range(scene.ngeom))
            expected = whole.images(session.env.sim, cameras, height, width)
            for camera, ours, all_shapes in zip(cameras, drawn, expected, strict=True):
                assert np.array_equal(ours, all_shapes), camera
    assert left_out > 0
    session.env.close()
