"""The paper's analyses as data: which variants are tried in which scenes (Oh et al. 2025, Sec. V)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from robust_instant_policy.errors import UnknownNameError, UsageError
from robust_instant_policy.evaluation.paper import TABLE1_TASKS
from robust_instant_policy.evaluation.scenes import scene_seed, split_of
from robust_instant_policy.evaluation.variant import REPLAY, ROW_METHODS, Scene, Variant, configs, require_no_path
from robust_instant_policy.files import file_stem
from robust_instant_policy.policies import METHOD_NAMES
from robust_instant_policy.policies.training import DEFAULT_STEPS
from robust_instant_policy.tasks import UNSEEN_TASKS, require_task
from robust_instant_policy.tasks.level import make_level
from robust_instant_policy.tasks.maniskill_benchmark.benchmark import MANISKILL
from robust_instant_policy.tasks.metaworld.benchmark import METAWORLD

SIMULATION_TASKS = TABLE1_TASKS[:5]
# "tasks in which gripper actions were essential"
GRIPPER_TASKS = ("pick-banana", "aloha-pick-banana", "aloha-hang", "aloha-pick-place", "aloha-cup-upright")
DEMOS = (1, 3, 5, 10, 20)
QUERIES = (2, 3, 5, 10)
DOFS = (1.25, 1.5, 3.0, math.inf)
HYPERPARAMETER_DEMOS = 20  # shown where Q and ν are varied
CHOSEN = "chosen"  # not an analysis of the paper: the tasks and methods of the user
SAMPLING_METHODS = ("rip", "rip-gauss", "mean", "kat")  # they share their samples
BENCHMARK_METHODS = (REPLAY, "neighbours", "gp", "kat", "rip-gauss", "rip")
PAPER_METHODS = (*SAMPLING_METHODS, "dp", "kat-dp")  # default methods of the paper's configuration


@dataclass(frozen=True)
class Suite:
    """All ``variants`` in the scenes ``seeds`` of all tasks; ``objects``, ``assets`` and ``level`` as in `Scene`.

    At another level than the paper's, tasks with a single set of objects use it for "unseen", too.
    """

    name: str
    tasks: tuple[str, ...]
    variants: tuple[Variant, ...]
    seeds: tuple[int, ...]
    objects: str = "seen"
    assets: str = "code"
    level: str = "paper"

    def __post_init__(self) -> None:
        require_no_path(self.name, self.objects, self.assets, self.level)
        require_no_path(*map(file_stem, self.tasks))
        for variant in self.variants:
            if variant.method not in ROW_METHODS:
                raise UnknownNameError("method", variant.method, ROW_METHODS)

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> Suite:
        """A suite from the output of `dataclasses.asdict`; missing fields get their defaults."""
        variants = tuple(Variant(**one) for one in content["variants"])
        sequences = {name: tuple(content[name]) for name in ("tasks", "seeds")}
        return cls(**{**content, **sequences, "variants": variants})

    @property
    def scenes(self) -> list[Scene]:
        found = []
        for task in self.tasks:
            objects = self.objects if self.level == "paper" or task in UNSEEN_TASKS else "seen"
            found += [Scene(task, objects, seed, self.assets, self.level) for seed in self.seeds]
        return found

    @property
    def identity(self) -> tuple[str, str, str, str]:
        """Suites with equal identity are merged."""
        return self.name, self.objects, self.assets, self.level

    def with_demonstrations(self, demo_set: int) -> Suite:
        """The same with another set of demonstrations."""
        return replace(self, variants=tuple(replace(variant, demo_set=demo_set) for variant in self.variants))

    @property
    def keeps_plans(self) -> bool:
        """Whether plans are kept, to be drawn."""
        return self.name == "trajectories"

    def by_config(self) -> dict[str, Suite]:
        """One suite for each configuration; methods without a configuration are in each."""
        return {
            config: replace(self, variants=tuple(one for one in self.variants if one.config in (config, "")))
            for config in configs(self.variants)
        }

    def by_split(self) -> dict[str, Suite]:
        """One suite for the scenes for tuning and one for those for tests; if there is only one kind, all under ""."""
        parts: dict[str, list[int]] = {}
        for seed in self.seeds:
            parts.setdefault(split_of(seed), []).append(seed)
        if len(parts) < 2:
            return {"": self}
        return {split: replace(self, seeds=tuple(parts[split])) for split in sorted(parts)}

    def merged(self, other: Suite) -> Suite:
        """This and another suite of the same name, objects, assets and level as one."""
        return replace(
            self,
            tasks=tuple(dict.fromkeys((*self.tasks, *other.tasks))),
            variants=tuple(dict.fromkeys((*self.variants, *other.variants))),
            seeds=tuple(dict.fromkeys((*self.seeds, *other.seeds))),
        )


@dataclass(frozen=True)
class Choice:
    """The user's options; None: as the suite of the paper, ``objects`` as the ``level``.

    ``seed`` is that of the run in ``split``, see `scene_seed`; ``steps`` the training steps of trained methods.
    """

    base: Variant
    tasks: Sequence[str] | None = None
    methods: Sequence[str] | None = None
    num_scenes: int = 10
    seed: int = 0
    objects: str | None = None
    assets: str = "code"
    level: str = "paper"
    split: str = "test"
    steps: int = DEFAULT_STEPS


def make_suites(names: Iterable[str], choice: Choice) -> list[Suite]:
    """The analyses called ``names``, of which "all" stands for every one of the paper.

    Raises `UnknownNameError` for others, and `UsageError` for scenes of a seed that do not lie in the chosen split.
    """
    for task in choice.tasks or ():
        require_task(task)
    wanted = [one for name in names for one in (SUITE_NAMES if name == "all" else (name,))]
    seeds = tuple(scene_seed(choice.seed, index, choice.split) for index in range(choice.num_scenes))
    if any(split_of(seed) != choice.split for seed in seeds):
        raise UsageError(f"--seed {choice.seed} is too large for --split {choice.split}: its scenes are those of tests")
    objects = choice.objects or make_level(choice.level).objects
    suites = []
    for name in dict.fromkeys(wanted):
        if name not in _SUITES:
            raise UnknownNameError("suite", name, (*SUITE_NAMES, "all", *BENCHMARK_SUITES))
        tasks, variants = _SUITES[name](choice)
        if not tasks:
            raise UsageError(f"none of the chosen tasks is one that suite {name} is about")
        unique = tuple(dict.fromkeys(variants))
        suites.append(Suite(name, tuple(tasks), unique, seeds, objects, choice.assets, choice.level))
    return suites


def _methods(choice: Choice, default: Sequence[str] = METHOD_NAMES) -> list[Variant]:
    if choice.base.config != "adaptive":
        default = [method for method in default if method in (*PAPER_METHODS, REPLAY)]
    return [replace(choice.base, method=method, steps=choice.steps) for method in choice.methods or default]


_SUITES: dict[str, Callable[[Choice], tuple[Sequence[str], list[Variant]]]] = {
    CHOSEN: lambda choice: (choice.tasks or ("push-cube",), _methods(choice, SAMPLING_METHODS)),
    "table1": lambda choice: (choice.tasks or TABLE1_TASKS, _methods(choice)),
    "demos": lambda choice: (
        choice.tasks or SIMULATION_TASKS,
        [replace(variant, demos=demos) for variant in _methods(choice) for demos in DEMOS],
    ),
    "queries": lambda choice: (
        choice.tasks or SIMULATION_TASKS,
        [replace(choice.base, demos=HYPERPARAMETER_DEMOS, queries=queries) for queries in QUERIES],
    ),
    "dof": lambda choice: (
        choice.tasks or SIMULATION_TASKS,
        [replace(choice.base, demos=HYPERPARAMETER_DEMOS, dof=dof) for dof in DOFS],
    ),
    "downsampling": lambda choice: (
        [task for task in choice.tasks or GRIPPER_TASKS if task in GRIPPER_TASKS],
        [replace(choice.base, downsampling=way) for way in ("uniform", "masked")],
    ),
    "trajectories": lambda choice: (choice.tasks or ("push-cube",), _methods(choice, SAMPLING_METHODS)),
    METAWORLD.name: lambda choice: (choice.tasks or METAWORLD.tasks, _methods(choice, BENCHMARK_METHODS)),
    MANISKILL.name: lambda choice: (choice.tasks or MANISKILL.tasks, _methods(choice, BENCHMARK_METHODS)),
}
BENCHMARK_SUITES = (METAWORLD.name, MANISKILL.name)
SUITE_NAMES = tuple(name for name in _SUITES if name not in (CHOSEN, *BENCHMARK_SUITES))  # analyses of the paper
