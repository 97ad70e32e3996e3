"""A bounded queue in front of a policy: one plan at a time, with progress and cancelling; unsafe plans are refused."""

import logging
import secrets
import threading
import time
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Literal

from robust_instant_policy.checks import is_trusted
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import PlanningError, RipError
from robust_instant_policy.policies import KeypointPolicy, Plan

logger = logging.getLogger(__name__)
MAX_WAITING = 64  # plans in the queue, the one under way included
MAX_FINISHED = 64  # plans kept for clients that ask later

State = Literal["queued", "planning", "done", "refused", "failed", "cancelled"]


class QueueError(RipError):
    """The server takes no plan at present: its queue is full, or the robot has a plan in it."""


class RefusedPlanError(PlanningError):
    """A plan that must not be executed."""


class CancelledPlanError(RipError):
    """The client cancelled the plan, or has hung up."""


@dataclass(eq=False)
class Job:
    """A plan for ``robot``. ``future`` gives it, or raises what was wrong; ``stage`` and ``done`` of ``total`` are its
    progress (total 0: unknown). Times are those of `time.monotonic`, 0 before they are known."""

    robot: str
    id: str = field(default_factory=lambda: secrets.token_hex(8))
    future: Future[Plan] = field(default_factory=Future)
    stage: str = ""
    done: int = 0
    total: int = 0
    queued_at: float = field(default_factory=time.monotonic)
    started_at: float = 0.0
    ended_at: float = 0.0
    is_cancelled: bool = False

    @property
    def state(self) -> State:
        if self.future.done() and not self.future.cancelled():
            error = self.future.exception()
            if error is None:
                return "done"
            if isinstance(error, CancelledPlanError):
                return "cancelled"
            return "refused" if isinstance(error, RipError) else "failed"
        if self.is_cancelled:
            return "cancelled"
        return "planning" if self.started_at else "queued"


class Planner:
    """Plans with the fitted ``policy`` in one thread.

    A plan whose confidence is below ``min_confidence``, is 0 or is missing is refused: its future raises
    `RefusedPlanError`. Each robot has at most one plan in the queue or under way.
    """

    def __init__(self, policy: KeypointPolicy, min_confidence: float):
        self.policy, self.min_confidence = policy, min_confidence
        policy.progress = self._on_progress
        self._thread = ThreadPoolExecutor(1, "planner")
        self._lock = threading.Lock()
        self._open: dict[str, Job] = {}  # by id, in the order of the queue
        self._finished: OrderedDict[str, Job] = OrderedDict()
        self._current: Job | None = None

    def submit(self, robot: str, observation: Observation) -> Job:
        """Queue a plan for ``robot``. Raises `QueueError`."""
        with self._lock:
            if any(job.robot == robot for job in self._open.values()):
                raise QueueError(f"the robot {robot!r} already has a plan under way; wait for it or cancel it")
            if len(self._open) >= MAX_WAITING:
                raise QueueError(f"the queue is full with {MAX_WAITING} plans; try again later")
            job = Job(robot)
            self._open[job.id] = job
        job.future = self._thread.submit(self._carry_out, job, observation)
        job.future.add_done_callback(lambda _: self._finish(job))
        return job

    def cancel(self, job: Job) -> None:
        """Remove a queued plan, or stop the one under way at the next of its progress reports."""
        job.is_cancelled = True
        job.future.cancel()

    def find(self, job_id: str) -> Job | None:
        """The plan of that id, if it is in the queue, under way, or among the last finished ones."""
        with self._lock:
            return self._open.get(job_id) or self._finished.get(job_id)

    @property
    def demonstrations(self) -> tuple[Demonstration, ...]:
        return self.policy.context_.demonstrations

    @property
    def queue(self) -> list[Job]:
        """The plan under way and those that wait, in order."""
        with self._lock:
            return list(self._open.values())

    def close(self) -> None:
        """Cancel everything and end the thread."""
        for job in self.queue:
            self.cancel(job)
        if self._current is not None:
            logger.warning("a plan is under way; the server ends when its next sample has arrived")
        self._thread.shutdown(wait=True, cancel_futures=True)

    def _carry_out(self, job: Job, observation: Observation) -> Plan:
        self._current, job.started_at = job, time.monotonic()
        try:
            plan = self.policy.plan(observation)
        except RipError:
            raise
        except Exception:
            logger.exception("unexpected error in a plan for %r", job.robot)
            raise
        finally:
            self._current, job.ended_at = None, time.monotonic()
        if job.is_cancelled:
            raise CancelledPlanError("the plan was cancelled")
        require_confidence(plan, self.min_confidence)
        return plan

    def _on_progress(self, stage: str, done: int, total: int) -> None:
        job = self._current
        if job is not None:
            job.stage, job.done, job.total = stage, done, total
            if job.is_cancelled:
                raise CancelledPlanError("the plan was cancelled")

    def _finish(self, job: Job) -> None:
        with self._lock:
            self._open.pop(job.id, None)
            self._finished[job.id] = job
            while len(self._finished) > MAX_FINISHED:
                self._finished.popitem(last=False)


def require_confidence(plan: Plan, least: float) -> None:
    """Raises `RefusedPlanError` unless the plan has a confidence above 0 of at least ``least``."""
    if plan.confidence is None:
        raise RefusedPlanError("the plan is refused: its method gives no confidence")
    if not is_trusted(plan.confidence, least):
        why = "; ".join(("", *plan.notes))
        raise RefusedPlanError(f"the plan is refused: confidence {plan.confidence:.2f}, needed {least:.2f}{why}")
