"""Workers on a Ray cluster: any number of machines, of which any may go away while they work.

Nothing needs a shared disk. Demonstrations travel to the workers once; samples are read and written through one actor
beside the rows, on the machine where the command runs; outcomes come back one by one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import MissingExtraError, UsageError
from robust_instant_policy.evaluation.processes import ONE_THREAD
from robust_instant_policy.evaluation.work import Agenda, Outcome, SceneWork, Setup, Trouble
from robust_instant_policy.evaluation.workbench import Workbench
from robust_instant_policy.llm import SampleStore

CORES_A_WORKER = 1
LOOK_SECONDS = 2.0  # between two looks at whether a worker can be had by now


@dataclass(frozen=True)
class Cluster:
    """Up to ``count`` workers (None: one a core) on the Ray cluster at ``address`` ("auto": this machine's)."""

    address: str
    count: int | None = None

    def __call__(self, setup: Setup, works: list[SceneWork]) -> Iterator[Outcome]:
        """Do ``works``. What a lost worker, alone or with its machine, had not finished is done elsewhere.

        Raises `MissingExtraError` without Ray, `UsageError` where there is no cluster at the address, and `RipError`
        with the words of an error that a worker met.
        """
        try:
            import ray
            from ray.exceptions import RayActorError
        except ModuleNotFoundError as error:
            raise MissingExtraError("ray", "distributed") from error
        try:
            ray.init(address=self.address, log_to_driver=False, logging_level="warning")
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UsageError(
                f"no Ray cluster at {self.address!r} ({error}); start one with: ray start --head"
            ) from None
        try:
            agenda = Agenda(works)
            team = _Team(setup, _most_demonstrations(setup, works))
            at_work: dict[Any, _Member] = {}
            while agenda or at_work:
                wanted = len(agenda) + len(at_work)
                team.grow(wanted if self.count is None else min(wanted, self.count))
                for member in team.free(at_work.values()):
                    work = agenda.next(member.task, [other.task for other in at_work.values()])
                    if work is not None:
                        at_work[member.give(work)] = member
                ready, _ = ray.wait(list(at_work), timeout=LOOK_SECONDS) if at_work else ([], [])
                for reference in ready:
                    member = at_work[reference]
                    try:
                        said = ray.get(next(reference))
                    except StopIteration:
                        del at_work[reference]
                    except RayActorError as error:
                        del at_work[reference]
                        agenda.put_back(member.left(), str(error).splitlines()[0])
                        team.bury(member)
                    else:
                        if isinstance(said, Trouble):
                            raise said.as_error()
                        member.outcomes.append(said)
                        yield said
        finally:
            ray.shutdown()


@dataclass(eq=False)
class _Member:
    """A worker actor, the scene it was given and what it has said of it."""

    actor: Any
    task: str = ""
    work: SceneWork | None = None
    outcomes: list[Outcome] = field(default_factory=list)

    def give(self, work: SceneWork) -> Any:
        """Has the actor begin; returns the stream of what comes of it."""
        self.work, self.task, self.outcomes = work, work.scene.task, []
        return self.actor.run.options(num_returns="streaming").remote(work)

    def left(self) -> SceneWork:
        assert self.work is not None
        return self.work.without(self.outcomes)


@dataclass
class _Team:
    """Actors, as many as the cluster has room for."""

    setup: Setup
    demonstrations: dict[str, list[Demonstration]]
    members: list[_Member] = field(default_factory=list)

    def __post_init__(self) -> None:
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        keeper = ray.remote(num_cpus=0, scheduling_strategy=here)(_Keeper)
        self._keeper = keeper.remote(self.setup.store.absolute())
        self._shown = {task: ray.put(shown) for task, shown in self.demonstrations.items()}
        self._kind = ray.remote(
            num_cpus=CORES_A_WORKER, max_restarts=0, runtime_env={"env_vars": dict(ONE_THREAD)}
        )(_Actor)  # fmt: skip

    def grow(self, wanted: int) -> None:
        """Have up to ``wanted`` members, if the cluster has cores for them."""
        import ray

        room = int(ray.available_resources().get("CPU", 0) // CORES_A_WORKER)
        for _ in range(min(room, wanted - len(self.members))):
            self.members.append(_Member(self._kind.remote(self.setup, self._keeper, self._shown)))

    def free(self, busy: Any) -> list[_Member]:
        engaged = set(map(id, busy))
        return [member for member in self.members if id(member) not in engaged]

    def bury(self, member: _Member) -> None:
        self.members.remove(member)


class _Actor:
    """A worker: a workbench that lives in a Ray actor."""

    def __init__(self, setup: Setup, keeper: Any, shown: dict[str, Any]):
        self._shown = shown
        self._bench = Workbench(setup, cast(SampleStore, _DistantStore(keeper, setup.store)), self._demonstrations)

    def run(self, work: SceneWork) -> Iterator[Outcome | Trouble]:
        """Each outcome of ``work`` as it comes, and the error that ended it early, if one did."""
        try:
            yield from self._bench.run(work)
        except Exception as error:
            yield Trouble.of(error)

    def _demonstrations(self, task: str, count: int) -> list[Demonstration]:
        import ray

        return ray.get(self._shown[task])[:count]


class _Keeper:
    """The sample store of the run, in an actor of its own."""

    def __init__(self, path: Path):
        self._store = SampleStore(path)

    def call(self, name: str, arguments: tuple) -> Any:
        return getattr(self._store, name)(*arguments)


class _DistantStore:
    """A `SampleStore` on another machine: whatever is asked of it is asked there."""

    def __init__(self, keeper: Any, path: Path):
        self._keeper, self.path = keeper, path

    def __getattr__(self, name: str) -> Any:
        import ray

        return lambda *arguments: ray.get(self._keeper.call.remote(name, arguments))


def _most_demonstrations(setup: Setup, works: list[SceneWork]) -> dict[str, list[Demonstration]]:
    most: dict[str, int] = {}
    for work in works:
        most[work.scene.task] = max(most.get(work.scene.task, 0), work.demos)
    return {task: load_demonstrations(setup.data / task, task=task, limit=count) for task, count in most.items()}
