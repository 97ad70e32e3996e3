"""Selection of MuJoCo's OpenGL library: EGL or OSMesa, neither of which needs a screen or a graphics card.

MuJoCo selects one library at import, and PyOpenGL cannot change the first one it loaded. So each is tested in a
separate process. ``python -m`` this module prints the selection.
"""

import importlib
import os
import subprocess
import sys
from functools import cache

from robust_instant_policy.errors import RendererError

VARIABLE = "MUJOCO_GL"  # MuJoCo's variable; a value set by the user is kept
BACKENDS = ("egl", "osmesa")
TIMEOUT_S = 60


@cache
def require_renderer() -> str:
    """Make MuJoCo render off screen and name the library; raises `RendererError` where none can."""
    backends = (os.environ[VARIABLE],) if os.environ.get(VARIABLE) else BACKENDS
    said = []
    for backend in backends:
        success, answer = _try(backend)
        if success:
            os.environ[VARIABLE] = backend
            if "mujoco" in sys.modules:  # imported before the library was selected
                importlib.reload(importlib.import_module("mujoco.rendering.classic.gl_context"))
            return answer
        said.append(f"{backend}: {answer}")
    raise RendererError(
        f"MuJoCo has no renderer ({'; '.join(said)}); run: make setup (or install libegl1 and libgl1-mesa-dri, or "
        "libosmesa6)"
    )


def _try(backend: str) -> tuple[bool, str]:
    """Whether ``backend`` renders, with its name or the reason of the failure."""
    environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    command = [sys.executable, "-P", __file__, "once"]  # by its path, which does not import the package of tasks
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
    """Render a ball and return the name of the renderer."""
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
