"""The benchmark's own seeded scenes, for the tests of `regression`."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from contaminated_trajectories import KINDS, Scene, draw_modes, draw_scene

__all__ = ["KINDS", "Scene", "draw_modes", "draw_scene"]
