"""Which OpenGL MuJoCo renders with here: EGL or OSMesa, neither of which needs a screen or a graphics card.

MuJoCo binds itself to one library when it is imported, and PyOpenGL never lets go of the first one it loaded. So each
is tried in a process of its own. ``python -m`` this module to see what is chosen.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from functools import cache

from robust_instant_policy.errors import RendererError

VARIABLE = "MUJOCO_GL"  # MuJoCo's own; what a user sets there stays
BACKENDS = ("egl", "osmesa")
TIMEOUT_S = 60
MODULE = "robust_instant_policy.tasks.aloha.renderer"  # not `__name__`, which is "__main__" when it is run


@cache
def require_renderer() -> str:
    """Make MuJoCo render off screen and name the library; raises `RendererError` where none can."""
    backends = (os.environ[VARIABLE],) if os.environ.get(VARIABLE) else BACKENDS
    answers = [_try(backend) for backend in backends]
    works = [backend for backend, (success, _) in zip(backends, answers, strict=True) if success]
    if not works:
        said = "; ".join(f"{backend}: {answer}" for backend, (_, answer) in zip(backends, answers, strict=True))
        raise RendererError(
            f"MuJoCo has no renderer ({said}); run: make setup (or install libegl1 and libgl1-mesa-dri, or libosmesa6)"
        )
    os.environ[VARIABLE] = works[0]
    if "mujoco" in sys.modules:  # imported before it was known what to render with
        importlib.reload(importlib.import_module("mujoco.rendering.classic.gl_context"))
    return dict(zip(backends, answers, strict=True))[works[0]][1]


def _try(backend: str) -> tuple[bool, str]:
    """Whether ``backend`` renders, and its name, or else why not."""
    environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    command = [sys.executable, "-m", MODULE, "once"]
    try:
        result = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
            env={**environment, VARIABLE: backend},
        )
    except subprocess.TimeoutExpired:
        return False, f"no image within {TIMEOUT_S} s"
    lines = (result.stdout if result.returncode == 0 else result.stderr).strip().splitlines()
    return result.returncode == 0, lines[-1] if lines else f"exit {result.returncode}"


def _render() -> str:
    """Draw a ball and name what drew it."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 32, 32) as renderer:
        from OpenGL import GL

        renderer.update_scene(data)
        if renderer.render().max() == 0:
            raise RuntimeError("the image is black")
        return f"{os.environ[VARIABLE]}, {GL.glGetString(GL.GL_RENDERER).decode()}"


if __name__ == "__main__":
    try:
        print(_render() if sys.argv[1:] else require_renderer())
    except RendererError as error:
        sys.exit(str(error))
