"""The worker program: `python -m actrm_harness.worker --task Lift`.

It sends a handshake, then answers requests in order until its standard input ends. Standard output is kept for replies
before anything else is imported, and file descriptor 1 is pointed at standard error, so that nothing a library prints
can get into the stream.
"""

import argparse
import importlib
import os
import platform
import sys
import traceback
from functools import cache
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

from actrm_harness import PROTOCOL, protocol, wire
from actrm_harness.protocol import RequestError, error_message

if TYPE_CHECKING:
    from actrm_harness.simulators.robosuite.envs import Session
    from actrm_harness.simulators.robosuite.episodes import Episode


# What has to be set before the interpreter starts. Sets of names must not be ordered by chance (robosuite draws from
# one), and one thread a library keeps their buffers small: a worker computes on one core.
SETTINGS = {
    "PYTHONHASHSEED": "0",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",
}


def main() -> NoReturn:
    """Take the pipes, start the environment, answer requests."""
    settle()
    requests = os.fdopen(os.dup(0), "rb")
    replies = os.fdopen(os.dup(1), "wb")
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    # Leave without unwinding: graphics libraries and a half-closed simulator have nothing to save.
    code = run(requests, replies)
    sys.stderr.flush()
    os._exit(code)


def settle() -> None:
    """Start the interpreter again where `SETTINGS` were not there when it started."""
    if any(os.environ.get(name) != value for name, value in SETTINGS.items()):
        os.environ.update(SETTINGS)
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def run(requests: BinaryIO, replies: BinaryIO) -> int:
    """Start and serve; the exit code."""
    args = arguments()
    try:
        session = start(args)
        wire.write_frame(replies, protocol.ready_message(describe(session)))
    except RequestError as error:
        wire.write_frame(replies, error_message(error.kind, str(error)))
        return 1
    except ModuleNotFoundError as error:
        text = f"{error} (Python {platform.python_version()}, {sys.executable})"
        wire.write_frame(replies, error_message("missing_module", text))
        return 1
    except Exception as error:
        traceback.print_exc()
        wire.write_frame(replies, error_message("start_failed", f"{type(error).__name__}: {error}"))
        return 1
    try:
        return serve(session, requests, replies)
    except BrokenPipeError:
        return 1


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="actrm_harness.worker", description=__doc__)
    parser.add_argument("--task", required=True, help="environment name, as robosuite knows it")
    parser.add_argument(
        "--control", default="compiled", choices=["robosuite", "compiled"], help="the inner loop (default: %(default)s)"
    )
    parser.add_argument("--env-module", help="Python module to import first: it registers further environments")
    parser.add_argument("--cameras", default="", help="cameras to observe, separated by commas")
    parser.add_argument("--size", type=int, default=84, help="height and width of camera images")
    return parser.parse_args()


def start(args: argparse.Namespace) -> "Session":
    """Import the simulator and make the environment."""
    from actrm_harness.simulators.robosuite import suite

    suite.prepare()
    from actrm_harness.simulators.robosuite import envs

    suite.robosuite()
    if args.env_module:
        try:
            importlib.import_module(args.env_module)
        except ImportError as error:
            raise RequestError(
                "env_module", f"cannot import environment module {args.env_module!r}: {error}"
            ) from error
    cameras = tuple(name for name in args.cameras.split(",") if name)
    session = envs.make(args.task, cameras, args.size)
    if args.control == "compiled":
        from actrm_harness.simulators.robosuite import control

        session.control = control.attach(session.env)
    return session


def describe(session: "Session") -> protocol.Ready:
    """The handshake: versions, shapes and the environment's arguments."""
    import numpy as np

    from actrm_harness.simulators.robosuite import envs, suite

    low, high = session.env.action_spec
    shapes = {name: list(value.shape) for name, value in envs.reset(session, 0).items()}
    return protocol.Ready(
        protocol=PROTOCOL,
        robosuite=suite.robosuite().__version__,
        mujoco=suite.mujoco().__version__,
        python=platform.python_version(),
        numpy=np.__version__,
        task=session.task.name,
        env_name=session.task.name,
        control="robosuite" if session.control is None else "compiled",
        control_freq=int(session.env.control_freq),
        max_steps=session.task.max_steps,
        action_dim=int(low.shape[0]),
        action_low=low.tolist(),
        action_high=high.tolist(),
        observations=shapes,
        env_args=session.env_args,
    )


def serve(session: "Session", requests: BinaryIO, replies: BinaryIO) -> int:
    """Answer requests until the stream ends or asks to close; the exit code."""
    while True:
        try:
            frame = wire.read_frame(requests)
        except wire.WireError as error:
            wire.write_frame(replies, error_message("bad_frame", str(error)))
            return 1
        if frame is None:
            return 0
        message, tensors = frame
        identity = message.get("id")
        number = identity if isinstance(identity, int) else None
        try:
            request = protocol.parse_request(message)
            if isinstance(request, protocol.Close):
                wire.write_frame(replies, {"type": "closed", "id": request.id})
                return 0
            reply, data = answer(session, request, tensors)
        except RequestError as error:
            reply, data = error_message(error.kind, str(error), number), {}
        except Exception as error:
            traceback.print_exc()
            reply, data = error_message("failed", f"{type(error).__name__}: {error}", number), {}
        wire.write_frame(replies, reply, data)


Answer = tuple[wire.Message, wire.Tensors]


def answer(session: "Session", request: protocol.Request, tensors: wire.Tensors) -> Answer:
    """The reply to one request."""
    # first what is asked most, between two steps of physics
    if isinstance(request, protocol.Step):
        return step_reply(session, request.id, tensor(tensors, "action"))
    return answer_seldom(session, request, tensors)


def step_reply(session: "Session", number: int, actions: wire.Array) -> Answer:
    """Do one action, or one after the other until the task is solved; what the last one led to, and all rewards."""
    envs = environments()
    checked = envs.check_actions(session.env, actions)
    if not len(checked):
        raise RequestError("bad_action", f"step: no action in a tensor of shape {actions.shape}")
    envs.slim(session)
    result, rewards = envs.steps_session(session, checked)
    reply = {"type": "step", "id": number, "reward": result.reward, "success": result.success}
    return reply, {"rewards": rewards, **{f"obs/{name}": value for name, value in result.observation.items()}}


def answer_seldom(session: "Session", request: protocol.Request, tensors: wire.Tensors) -> Answer:
    """The reply to a request that is not a step."""
    from actrm_harness.simulators.robosuite import envs, episodes

    if isinstance(request, protocol.Reset):
        first = envs.reset(session, request.seed, request.split == "demonstration")
        ep_meta = session.env.get_ep_meta()
        reply = {
            "type": "reset",
            "id": request.id,
            "fingerprint": envs.fingerprint(session.env),
            "split": request.split,
            "group": ep_meta.get("group"),
            "ep_meta": ep_meta,
        }
        return reply, {f"obs/{name}": value for name, value in first.items()}
    if isinstance(request, protocol.Expert):
        episode = episodes.expert_episode(session, request.seed, request.split == "demonstration")
        return episode_reply("expert", request.id, episode), episode.tensors
    if isinstance(request, protocol.Extract):
        states, actions = tensor(tensors, "states"), tensor(tensors, "actions")
        episode = episodes.extract(session, states, actions, request.model_file, request.ep_meta)
        return episode_reply("extract", request.id, episode), episode.tensors
    if isinstance(request, protocol.Render):
        image = envs.image(session, request.camera, *request.size)
        return {"type": "render", "id": request.id}, {"image": image}
    raise RequestError("unknown_request", f"request {request!r} cannot be answered")


@cache
def environments() -> Any:
    """The module `envs`, which is imported late, as it brings the simulator."""
    return importlib.import_module("actrm_harness.simulators.robosuite.envs")


def episode_reply(kind: str, number: int, episode: "Episode") -> wire.Message:
    """The message that goes with a recorded episode's tensors."""
    return {
        "type": kind,
        "id": number,
        "success": episode.success,
        "steps": episode.steps,
        "attrs": episode.attrs,
    }


def tensor(tensors: wire.Tensors, name: str) -> wire.Array:
    """A tensor that the request must carry."""
    if name not in tensors:
        raise RequestError("bad_request", f"tensor {name!r} is missing; the request carries {sorted(tensors)}")
    return tensors[name]


if __name__ == "__main__":
    main()
