"""Workers on a Ray cluster: any number of machines, any of which may fail.

No shared disk is needed. Each worker gets the demonstrations once. One actor, on the machine where the command runs,
reads and writes the samples. Outcomes are streamed back one by one. Importing this module raises `MissingExtraError`
without the extra `distributed`.
"""

import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import UsageError, needs_extra
from robust_instant_policy.evaluation.scenes import demonstrations_folder
from robust_instant_policy.evaluation.work import Outcome, SceneWork, Setup
from robust_instant_policy.evaluation.workbench import Workbench
from robust_instant_policy.evaluation.workers import ONE_THREAD, Died, Finished, Message, Worker, WorkError, run_pool
from robust_instant_policy.llm import SampleStore

with needs_extra("distributed"):
    import ray
    from ray.exceptions import RayActorError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

CORES_A_WORKER = 1
POLL_SECONDS = 2.0  # between two checks for free cores


@dataclass(frozen=True)
class RayWorkers:
    """Up to ``count`` workers (None: one a core) on the Ray cluster at ``address`` ("auto": this machine's)."""

    address: str
    count: int | None = None

    def __call__(self, setup: Setup, works: list[SceneWork]) -> Iterator[Outcome]:
        """Do ``works``; the loss of a machine counts as the death of its workers.

        Raises `UsageError` if there is no cluster at the address.
        """
        own = {"include_dashboard": False} if self.address == "local" else {}
        try:
            ray.init(address=self.address, log_to_driver=False, logging_level="warning", **own)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UsageError(
                f"no Ray cluster at {self.address!r} ({error}); start one with: ray start --head"
            ) from None
        try:
            yield from run_pool(_Actors(setup, _most_demonstrations(setup, works), self.count), works)
        finally:
            ray.shutdown()


@dataclass(eq=False, kw_only=True)
class _Member(Worker):
    """An actor, and the stream of outcomes of its current scene."""

    actor: Any
    stream: Any = None


class _Actors:
    """A `Pool` of actors: as many as the cluster has room for, up to ``most``."""

    def __init__(self, setup: Setup, demonstrations: dict[str, list[Demonstration]], most: int | None):
        self._setup, self._most = setup, most
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        store = ray.remote(num_cpus=0, scheduling_strategy=here)(SampleStore)
        self._store = store.remote(setup.store.absolute())
        self._shown = {task: ray.put(shown) for task, shown in demonstrations.items()}
        self._kind = ray.remote(
            num_cpus=CORES_A_WORKER, max_restarts=0, runtime_env={"env_vars": dict(ONE_THREAD)}
        )(_Actor)  # fmt: skip
        self._members: list[_Member] = []

    def workers(self, wanted: int) -> list[_Member]:
        if self._most is not None:
            wanted = min(wanted, self._most)
        room = int(ray.available_resources().get("CPU", 0) // CORES_A_WORKER)
        for _ in range(min(room, wanted - len(self._members))):
            self._members.append(_Member(actor=self._kind.remote(self._setup, self._store, self._shown)))
        return self._members

    def give(self, worker: _Member, work: SceneWork) -> None:
        worker.stream = worker.actor.run.options(num_returns="streaming").remote(work)

    def receive(self, busy: Collection[_Member]) -> Iterator[tuple[_Member, Message]]:
        by_stream = {worker.stream: worker for worker in busy}
        if not by_stream:  # no machine has a free core
            time.sleep(POLL_SECONDS)
            return
        ready, _ = ray.wait(list(by_stream), timeout=POLL_SECONDS)
        for stream in ready:
            worker = by_stream[stream]
            try:
                message = ray.get(next(stream))
            except StopIteration:
                yield worker, Finished()
            except RayActorError as error:
                self._members.remove(worker)
                yield worker, Died(str(error).splitlines()[0])
            else:
                yield worker, message

    def close(self) -> None:
        """Ray ends the actors when the driver disconnects."""


class _Actor:
    """A worker: a workbench in a Ray actor."""

    def __init__(self, setup: Setup, store: Any, shown: dict[str, Any]):
        samples = cast(SampleStore, _DistantStore(store, setup.store))
        self._bench = Workbench(setup, samples, lambda task, count: ray.get(shown[task])[:count])

    def run(self, work: SceneWork) -> Iterator[Outcome | WorkError]:
        """Yields each outcome of ``work``, and the error that ended it early, if any."""
        try:
            yield from self._bench.run(work)
        except Exception as error:
            yield WorkError.of(error)


class _DistantStore:
    """Proxy of a `SampleStore` in a Ray actor: forwards each method call to it."""

    def __init__(self, actor: Any, path: Path):
        self._actor, self.path = actor, path

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: ray.get(getattr(self._actor, name).remote(*arguments))


def _most_demonstrations(setup: Setup, works: list[SceneWork]) -> dict[str, list[Demonstration]]:
    most: dict[str, int] = {}
    for work in works:
        most[work.scene.task] = max(most.get(work.scene.task, 0), work.demos)
    folders = {task: demonstrations_folder(setup.data, task, with_images=False) for task in most}
    return {task: load_demonstrations(folders[task], task=task, limit=count) for task, count in most.items()}
