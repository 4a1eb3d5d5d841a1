"""Images of the simulation, drawn without touching it.

robosuite's own render contexts are not used, for two reasons. They return garbage, silently, once an older one has been
collected: freeing it leaves no context, or another one, current. And making one runs the solver, which changes the
episode that follows by a few bits. Here a process has one OpenGL context, made current before anything is done with
it, and drawing only reads the simulation's data: what it shows is what the last control step left.
"""

import ctypes
import ctypes.util
import importlib
import os
import platform
import re
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from actrm_harness.protocol import RequestError
from actrm_harness.simulators.robosuite import suite
from actrm_harness.simulators.robosuite.suite import Sim
from actrm_harness.wire import Array

_MAX_GEOMS = 10_000
_EGL_PLATFORM_DEVICE = 0x313F
_GL_RENDERER, _GL_VERSION = 0x1F01, 0x1F02
_NO_RENDERER = (
    "images need EGL or OSMesa, and {}; "
    "Debian and Ubuntu: apt install libegl1 libgl1-mesa-dri, or apt install libosmesa6"
)


class Renderer:
    """Draws a simulation's cameras; the model's textures and meshes are loaded again when the model changes.

    `fast` draws without reflections and multisampling, which takes a third of the time where a processor draws, and
    leaves out what lies outside of the picture: much of an arm is nothing that the camera on its hand can see.
    """

    def __init__(self, fast: bool = False) -> None:
        self._fast = fast
        self._gl: Any = _gl_context()
        self._model: Any = None
        self._context: Any = None
        self._scene: Any = None
        mujoco = suite.mujoco()
        self._camera: Any = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._options: Any = mujoco.MjvOption()
        # robosuite keeps collision geometry in group 0 and what is to be seen in group 1.
        self._options.geomgroup[0] = 0
        self._options.geomgroup[1] = 1

    def make_current(self) -> None:
        """Make this the OpenGL context that mujoco draws with."""
        self._gl.make_current()

    def name(self) -> str:
        """What draws, as OpenGL names it: device or software, and driver. Another one draws other pictures.

        llvmpipe compiles for the processor, so its name holds the processor's vendor.
        """
        self.make_current()
        lookup = importlib.import_module("OpenGL.platform").PLATFORM.getExtensionProcedure
        get_string = ctypes.CFUNCTYPE(ctypes.c_char_p, ctypes.c_uint)(lookup(b"glGetString"))
        told = (get_string(_GL_RENDERER), get_string(_GL_VERSION))
        text = ", OpenGL ".join(text.decode("ascii", "replace") for text in told if text)
        # llvmpipe says how wide a processor's vectors are, and draws the same pixels with all of them
        return re.sub(r"(llvmpipe \(LLVM [\d.]+), \d+ bits", rf"\1, {_processor()}", text)

    def image(self, sim: Sim, camera: str, height: int, width: int) -> Array:
        """Draw what `camera` sees: uint8 of (height, width, 3), upright."""
        return self.images(sim, (camera,), height, width)[0]

    def images(self, sim: Sim, cameras: Sequence[str], height: int, width: int) -> list[Array]:
        """Draw what each of `cameras` sees, of one scene: uint8 of (height, width, 3) each, upright."""
        mujoco = suite.mujoco()
        known: tuple[str, ...] = sim.model.camera_names
        for camera in cameras:
            if camera not in known:
                raise RequestError("unknown_camera", f"unknown camera {camera!r}; known: {', '.join(sorted(known))}")
        self.make_current()
        self._load(sim.model._model, height, width)
        data, everything = sim.data._data, mujoco.mjtCatBit.mjCAT_ALL
        # what cannot be seen itself may be mirrored or throw a shadow
        alone = self._fast and not np.any(self._model.light_castshadow)
        viewport = mujoco.MjrRect(0, 0, width, height)
        pixels = np.empty((height, width, 3), dtype=np.uint8)
        drawn: list[Array] = []
        for camera in cameras:
            self._camera.fixedcamid = sim.model.camera_name2id(camera)
            mujoco.mjv_updateScene(
                self._model, data, self._options, mujoco.MjvPerturb(), self._camera, everything, self._scene
            )
            if alone:
                self._leave_out(data, self._camera.fixedcamid, width / height)
            mujoco.mjr_render(viewport, self._scene, self._context)
            mujoco.mjr_readPixels(pixels, None, viewport, self._context)
            drawn.append(np.ascontiguousarray(pixels[::-1]))
        return drawn

    def _leave_out(self, data: Any, camera: int, aspect: float) -> None:
        """Take the shape of everything in the scene whose bounding sphere is outside of what `camera` sees."""
        mujoco, model = suite.mujoco(), self._model
        if model.cam_orthographic[camera] or model.cam_sensorsize[camera].any():
            return
        drawn = self._scene.geoms[: self._scene.ngeom]
        of_model = [geom for geom in drawn if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM]
        ids = np.fromiter((geom.objid for geom in of_model), dtype=np.intp, count=len(of_model))
        radius = model.geom_rbound[ids]
        right, up, backward = data.cam_xmat[camera].reshape(3, 3).T
        from_camera = data.geom_xpos[ids] - data.cam_xpos[camera]
        depth = -(from_camera @ backward)
        tall = np.tan(np.deg2rad(model.cam_fovy[camera]) / 2)
        beyond = depth < model.vis.map.znear * model.stat.extent - radius
        for aside, tangent in ((from_camera @ right, tall * aspect), (from_camera @ up, tall)):
            beyond |= np.abs(aside) - tangent * depth > radius * np.sqrt(1.0 + tangent * tangent)
        # planes have no bounds
        for index in np.flatnonzero(beyond & (radius > 0.0)):
            of_model[index].type = mujoco.mjtGeom.mjGEOM_NONE

    def _load(self, model: Any, height: int, width: int) -> None:
        fits = self._context is not None and width <= self._context.offWidth and height <= self._context.offHeight
        if model is self._model and fits:
            return
        mujoco = suite.mujoco()
        if self._context is not None:
            self._context.free()
        view = model.vis.global_
        if self._fast:
            model.vis.quality.offsamples = 0
        view.offwidth, view.offheight = max(width, view.offwidth), max(height, view.offheight)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        if model is not self._model:
            self._scene = mujoco.MjvScene(model, maxgeom=_MAX_GEOMS)
            if self._fast:
                self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._model = model


def _processor() -> str:
    """The processor's vendor, such as GenuineIntel, or its architecture where none is told."""
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as told:
            vendors = (line.partition(":")[2].strip() for line in told if line.startswith("vendor_id"))
            return next(vendors, "") or platform.machine()
    except OSError:
        return platform.machine()


def _gl_context() -> Any:
    """An OpenGL context of the first of EGL and OSMesa that works here, or of the one MUJOCO_GL names."""
    wanted = suite.WANTED_GL
    if wanted not in ("", "egl", "osmesa"):
        raise RequestError("no_renderer", f"MUJOCO_GL is {wanted!r}; images are drawn with egl or osmesa")
    works = {"egl": _egl_works, "osmesa": lambda: ctypes.util.find_library("OSMesa") is not None}
    chosen = next((name for name in works if wanted in ("", name) and works[name]()), None)
    if chosen is None:
        found = f"MUJOCO_GL is {wanted!r}, which does not work here" if wanted else "neither works here"
        raise RequestError("no_renderer", _NO_RENDERER.format(found))
    os.environ["PYOPENGL_PLATFORM"] = chosen
    if chosen == "osmesa":
        return importlib.import_module("robosuite.renderers.context.osmesa_context").OSMesaGLContext(640, 480)
    context = importlib.import_module("robosuite.renderers.context.egl_context").EGLGLContext
    with _egl_device():
        try:
            return context(0, 0, device_id=-1)
        except (ImportError, RuntimeError, ValueError) as error:
            named = {name: os.environ[name] for name in _DEVICES if name in os.environ}
            found = f"EGL gives no context ({error}; {named or 'no device was named'})"
            raise RequestError("no_renderer", _NO_RENDERER.format(found)) from error


_DEVICES = ("MUJOCO_EGL_DEVICE_ID", "CUDA_VISIBLE_DEVICES")


@contextmanager
def _egl_device() -> Generator[None]:
    """While EGL's device is chosen: CUDA's devices are taken for EGL's only where one of them can be meant.

    robosuite reads the first of CUDA_VISIBLE_DEVICES as a number of EGL's devices. It may be empty or -1, which keeps
    other programs off a GPU, a name, or a GPU where EGL has none; MUJOCO_EGL_DEVICE_ID is for drawing, and is left as
    it is.
    """
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    meant = visible is not None and visible.split(",")[0].strip().isdecimal()
    if visible is None or (meant and int(visible.split(",")[0]) < _egl_devices()):
        yield
        return
    del os.environ["CUDA_VISIBLE_DEVICES"]
    try:
        yield
    finally:
        os.environ["CUDA_VISIBLE_DEVICES"] = visible


def _egl_works() -> bool:
    """Whether the first EGL device can be initialised; asked before OpenGL is imported, which binds to one platform."""
    egl = _egl()
    if egl is None or _egl_devices() < 1:
        return False
    device, count = ctypes.c_void_p(), ctypes.c_int()
    display_of = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not display_of or not _query_devices(egl)(1, ctypes.byref(device), ctypes.byref(count)):
        return False
    platform_display = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(display_of)
    display = platform_display(_EGL_PLATFORM_DEVICE, device, None)
    egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    return bool(display) and bool(egl.eglInitialize(display, None, None))


def _egl_devices() -> int:
    """How many devices EGL has."""
    egl, count = _egl(), ctypes.c_int()
    if egl is None or not egl.eglGetProcAddress(b"eglQueryDevicesEXT"):
        return 0
    return count.value if _query_devices(egl)(0, None, ctypes.byref(count)) else 0


def _query_devices(egl: ctypes.CDLL) -> Any:
    address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    return ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(address)


def _egl() -> ctypes.CDLL | None:
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return None
    egl.eglGetProcAddress.restype, egl.eglGetProcAddress.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    return egl
