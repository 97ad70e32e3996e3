"""The floor plan: imports run downward only, and importing the package needs no extra."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import robust_instant_policy

ROOT = Path(robust_instant_policy.__file__).parent
PACKAGE = "robust_instant_policy"
FLOORS = {
    "errors": 1, "checks": 1, "geometry": 1, "trajectory": 1, "demonstration": 1, "query": 1, "files": 1,
    "controller": 1, "network": 1, "pointcloud": 1, "plugins": 1, "interrupts": 1, "renamed": 1,
    "perception": 2, "context": 2, "llm": 2, "regression": 2, "datasets": 2, "motion": 2, "sanity": 2,
    "policies": 3, "tasks": 3, "robots": 3,
    "evaluation": 4,
    "reporting": 5, "serving": 5, "studio": 5,
    "cli": 6, "commands": 6,
}  # fmt: skip


MODULES = sorted(path for path in ROOT.rglob("*.py") if path.parent != ROOT or path.stem != "__init__")
NAMES = {
    ".".join([PACKAGE, *path.relative_to(ROOT).with_suffix("").parts]).removesuffix(".__init__"): path
    for path in MODULES
}


def room(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imported(path: Path) -> set[str]:
    """Modules of the package that ``path`` imports anywhere, also for type checking only."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            inside = [f"{node.module}.{alias.name}" for alias in node.names]
            names += [name if name in NAMES else node.module for name in inside]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    return {name for name in names if name.startswith(PACKAGE + ".")}


def imported_rooms(path: Path) -> set[str]:
    return {name.split(".")[1] for name in imported(path)}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_run_downward_only(path):
    own = room(path)
    for other in imported_rooms(path) - {own}:
        allowed = FLOORS[other] < FLOORS[own] or FLOORS[own] == FLOORS[other] in (1, 6)
        assert allowed, f"{own} (floor {FLOORS[own]}) imports {other} (floor {FLOORS[other]})"


def test_no_modules_import_each_other_in_a_circle():
    graph = {name: (imported(path) & NAMES.keys()) - {name} for name, path in NAMES.items()}
    order = list(TopologicalSorter(graph).static_order())  # raises CycleError, with the circle
    assert len(order) == len(NAMES) > 300


def test_importing_the_package_loads_no_heavy_dependency():
    code = (
        "import sys, robust_instant_policy as rip; rip.Trajectory; rip.RobustInstantPolicy; rip.connect;"
        "heavy = {'torch', 'mani_skill', 'sapien', 'xllamacpp', 'transformers', 'mink', 'mujoco'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
