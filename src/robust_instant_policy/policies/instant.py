"""The instant policy Φ: demonstrations and a new image in, sampled trajectories out.

Φ([V, A], V') → ξ̂ (Oh et al. 2025, Sec. III-A; Di Palo and Johns 2024). Keypoints, prompt and language model
meet here; what is done with the samples is up to the policies that own one.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from robust_instant_policy.context.prompt import Frames, InContextPrompt, Layout
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import PlanningError, UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.llm import LanguageModel, Listener, Sampling
from robust_instant_policy.perception import Located
from robust_instant_policy.policies.keypoint_context import KeypointContext
from robust_instant_policy.policies.policy import Progress, Stage, Usage, no_progress
from robust_instant_policy.query import Answer, Query
from robust_instant_policy.trajectory import TARGET_STEPS, Trajectory

MIN_VALID_ANSWERS = 3  # below this nobody can say which one is hallucinated
DEADLINE_S = 300.0  # wall time of all the sampling for one plan; a busy laptop may need minutes
QUOTED_ANSWER_CHARS = 160


@dataclass(frozen=True, eq=False)
class Proposal:
    """What the instant policy saw and proposed for one observation.

    ``bends (B,)``, metres, say how sharply the demonstrations' gripper turns along the way, and ``variation (B,)``,
    metres, how far they differ in the frames that suit them, where that is known.
    """

    located: Located
    candidates: tuple[Trajectory, ...]
    usage: Usage
    notes: tuple[str, ...]
    bends: FloatArray | None = None
    variation: FloatArray | None = None


class InstantPolicy:
    """Samples trajectories for a new scene from a language model that is shown the demonstrations as text.

    ``frames`` ("adaptive" or "world") and ``layout`` ("factorised" or "sequence") choose how numbers are
    written; ``features`` names the image descriptors; ``downsampling`` is "masked" or "uniform", to
    ``num_steps`` steps; ``deadline_s`` bounds all the sampling for one plan, in wall seconds.
    """

    def __init__(
        self,
        llm: LanguageModel,
        *,
        num_keypoints: int = 10,
        features: str = "auto",
        frames: Frames = "adaptive",
        layout: Layout = "factorised",
        downsampling: str = "masked",
        num_steps: int = TARGET_STEPS,
        temperature: float = 0.7,
        deadline_s: float = DEADLINE_S,
        workspace: FloatArray | None = None,
        seed: int = 0,
        progress: Progress = no_progress,
    ):
        self.llm = llm
        self.temperature, self.deadline_s, self.seed = temperature, deadline_s, seed
        self.progress = progress
        self.context = KeypointContext(
            num_keypoints=num_keypoints,
            features=features,
            downsampling=downsampling,
            num_steps=num_steps,
            workspace=workspace,
            seed=seed,
            progress=progress,
        )
        self.prompt = InContextPrompt(frames=frames, layout=layout)
        self._written: Sequence[Trajectory] = ()
        self._heard: _Heard | None = None

    def fit(self, demonstrations: Sequence[Demonstration]) -> InstantPolicy:
        """Find the common keypoints of ``demonstrations`` and write them down as context; returns itself.

        The very same demonstrations once more cost nothing.
        """
        self.context.fit(demonstrations)
        if self._written is not self.context.trajectories_:  # another method may have fitted the context before
            self._heard = None
            self.prompt.fit(self.context.keypoints_, self.context.trajectories_)
            self._written = self.context.trajectories_
        return self

    def propose(self, observation: Observation, num_queries: int) -> Proposal:
        """Ask the model ``num_queries`` times what to do in the scene of ``observation``.

        Asking again about the same observation object reuses the answers it already has.
        Raises `KeypointError` where the scene cannot be recognised and `PlanningError` where fewer than
        three answers (or ``num_queries``, if fewer were wanted) are usable.
        """
        if num_queries < 1:
            raise UsageError(f"the number of queries must be at least 1, got {num_queries}")
        heard = self._heard if self._heard is not None and self._heard.observation is observation else None
        if heard is None:
            located, locating = self.context.locate(observation, self._written)
            queries = self.prompt.queries(located.keypoints)
            heard = self._heard = _Heard(observation, located, locating, queries, [[] for _ in queries])
        self._ask(heard, num_queries)
        answers = [of_query[:num_queries] for of_query in heard.answers]
        # Where the demonstrations agree on every number there is nothing to ask, and every candidate is the same.
        count = min((len(of_query) for of_query in answers), default=num_queries)
        if count < min(MIN_VALID_ANSWERS, num_queries):
            self._heard = None  # who asks again wants the model to be asked again
            raise PlanningError(_too_few(count, num_queries, answers, self.deadline_s))
        candidates = tuple(
            self.prompt.trajectory([of_query[index].text for of_query in answers], heard.located.keypoints)
            for index in range(count)
        )
        notes = (*self.context.extractor.notes_, *heard.located.notes)
        if count < num_queries:
            notes = (*notes, f"{count} of {num_queries} answers were usable in time")
        usage = Usage((heard.locating, _sampling(heard, answers)))
        return Proposal(heard.located, candidates, usage, notes, self.prompt.bends_, self.prompt.variation_)

    def _ask(self, heard: _Heard, num_queries: int) -> None:
        """Sample what ``heard`` lacks of ``num_queries`` answers a query."""
        if heard.num_asked >= num_queries or not heard.queries or heard.seconds >= self.deadline_s:
            return
        start = time.perf_counter()
        deadline_s = self.deadline_s - heard.seconds  # of all the sampling for one plan
        more = self.llm.sample(
            heard.queries,
            Sampling(num_queries - heard.num_asked, self.temperature, self.seed, heard.num_asked, deadline_s),
            Listener(self.prompt.accepts, lambda done, total: self.progress("language model", done, total)),
        )
        heard.seconds += time.perf_counter() - start
        heard.num_asked = num_queries
        for of_query, new in zip(heard.answers, more, strict=True):
            of_query.extend(new)


@dataclass
class _Heard:
    """The answers to one observation so far, so that more can be asked for without asking again."""

    observation: Observation
    located: Located
    locating: Stage
    queries: Sequence[Query]
    answers: list[list[Answer]]
    num_asked: int = 0
    seconds: float = 0.0


def _sampling(heard: _Heard, answers: Sequence[Sequence[Answer]]) -> Stage:
    flat = [answer for of_query in answers for answer in of_query]
    return Stage(
        "language model",
        heard.seconds,
        sum(answer.prompt_tokens for answer in flat),
        sum(answer.cached_tokens for answer in flat),
        sum(answer.completion_tokens for answer in flat),
    )


def _too_few(count: int, wanted: int, answers: Sequence[Sequence[Answer]], deadline_s: float) -> str:
    said = next((answer.text for of_query in answers for answer in of_query), None)
    heard = f"it said, for one, {said[:QUOTED_ANSWER_CHARS]!r}" if said else "it said nothing usable"
    answered = sum(len(of_query) == wanted for of_query in answers)
    return (
        f"within {deadline_s:g} s came {count} usable trajectories of {wanted}, {min(MIN_VALID_ANSWERS, wanted)} "
        f"are needed ({answered} of {len(answers)} prompts answered in full; {heard}); "
        "give it more time (--deadline) or another model (--llm)"
    )
