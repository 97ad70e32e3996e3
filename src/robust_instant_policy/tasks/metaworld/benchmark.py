"""Meta-World's fifty tasks: their names, their groups of difficulty, and what others published."""

from robust_instant_policy.tasks.benchmark import Benchmark

PREFIX = "metaworld/"


def _tasks(names: str) -> tuple[str, ...]:
    return tuple(f"{PREFIX}{name}" for name in names.split())


METAWORLD = Benchmark(
    "metaworld",
    groups={  # Seo et al. (2022, "Masked World Models for Visual Control"); SmolVLA uses the same
        "easy": _tasks(
            "button-press button-press-topdown button-press-topdown-wall button-press-wall coffee-button dial-turn "
            "door-close door-lock door-open door-unlock drawer-close drawer-open faucet-close faucet-open handle-press "
            "handle-press-side handle-pull handle-pull-side lever-pull peg-unplug-side plate-slide plate-slide-back "
            "plate-slide-back-side plate-slide-side reach reach-wall window-close window-open"
        ),
        "medium": _tasks(
            "basketball bin-picking box-close coffee-pull coffee-push hammer peg-insert-side push-wall soccer sweep "
            "sweep-into"
        ),
        "hard": _tasks("assembly hand-insert pick-out-of-hole pick-place push push-back"),
        "very hard": _tasks("disassemble pick-place-wall shelf-place stick-pull stick-push"),
    },
    tuning=_tasks(
        "reach push pick-place door-open drawer-open peg-insert-side bin-picking shelf-place stick-pull lever-pull"
    ),
    published={  # Shukor et al. (2025, "SmolVLA", Table 2)
        "Diffusion Policy": (23.1, 10.7, 1.9, 6.1),
        "TinyVLA": (77.6, 21.5, 11.4, 15.8),
        "π0 (3.5B)": (71.8, 48.2, 41.7, 30.0),
        "π0 (3.5B, PaliGemma)": (80.4, 40.9, 36.7, 44.0),
        "SmolVLA (0.45B)": (82.5, 41.8, 45.0, 60.0),
        "SmolVLA (2.25B)": (87.14, 51.82, 70.0, 64.0),
    },
    protocol=(
        "The published policies are one network for all tasks, trained on 50 demonstrations of each (2,500 in all), "
        "told the task in words, and act in closed loop on colour images in which the robot is seen (SmolVLA's table). "
        "Ours sees demonstrations of the one task only, is told no words, plans once from one RGB-D image of the "
        "start, from a calibrated camera that does not see the robot, and executes open loop; goals without a body are "
        "drawn as the benchmark draws them (that of pick-out-of-hole, which it draws at the object, where success is "
        "measured). Both use the benchmark's own scripted demonstrators, random positions, "
        "measure of success (at any step) and horizon of 500 steps."
    ),
)
