"""Test whether SAPIEN can render. ``python -m`` this module tests it in a separate process."""

import sys

import sapien.render

from robust_instant_policy.errors import RendererError

RENDER_DEVICE = "cpu"  # the CPU Vulkan driver, so that every machine renders the same image


def require_renderer() -> str:
    """Name of the Vulkan device that renders; raises `RendererError` where SAPIEN accepts none."""
    sapien.render.set_log_level("off")
    try:
        return sapien.render.RenderSystem(sapien.Device(RENDER_DEVICE)).device.name
    except RuntimeError as error:
        raise RendererError(
            f"the simulator's camera has no renderer ({error}); run: make setup "
            "(or install mesa-vulkan-drivers 25 or newer)"
        ) from error
    finally:
        sapien.render.set_log_level("warn")


if __name__ == "__main__":
    try:
        print(require_renderer())
    except RendererError as error:
        sys.exit(str(error))
