"""The tasks of this package: families that share a simulator."""

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from robust_instant_policy.errors import MissingExtraError
from robust_instant_policy.tasks.maniskill_benchmark.benchmark import MANISKILL
from robust_instant_policy.tasks.metaworld.benchmark import METAWORLD


@dataclass(frozen=True)
class Family:
    """``names`` of tasks that ``module`` of this package makes with its ``make(name, objects, assets, level)``; its
    simulator is in ``extra``."""

    module: str
    extra: str
    names: tuple[str, ...]

    def make(self, name: str, objects: str, assets: str, level: str) -> Any:
        """The task ``name``; raises `MissingExtraError` if its simulator is not installed."""
        try:
            module = import_module(f"{__package__}.{self.module}")
            return module.make(name, objects, assets, level)
        except ModuleNotFoundError as error:
            if error.name and error.name.startswith("robust_instant_policy"):
                raise
            raise MissingExtraError(error.name or self.extra, self.extra) from error


FAMILIES = (
    Family("maniskill.task", "sim", ("pick-banana", "push-cube", "open-drawer", "close-cabinet", "turn-faucet")),
    Family("maniskill.task", "sim", ("push-cube-anywhere", "stack", "wipe", "sort")),  # relations between things
    Family(
        "aloha.task",
        "aloha",
        ("aloha-pick-banana", "aloha-hang", "aloha-cup-upright", "aloha-sweep", "aloha-pick-place"),
    ),
)
BENCHMARKS = (  # tasks of other people's packages, called BENCHMARK/NAME
    Family("metaworld.task", "metaworld", METAWORLD.tasks),
    Family("maniskill_benchmark.task", "sim", MANISKILL.tasks),
)
