"""Ask the language model for trajectories: Φ([V, A], V') → ξ̂ (Oh et al. 2025, Sec. III-A; Di Palo and Johns 2024)."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

from robust_instant_policy.errors import PlanningError
from robust_instant_policy.llm import DEADLINE_S, LanguageModel, Listener, Sampling, refusal_advice
from robust_instant_policy.policies.context import Context, LocatedScene
from robust_instant_policy.policies.policy import Progress, Stage, no_progress
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.query import Answer
from robust_instant_policy.trajectory import Trajectory

MIN_CANDIDATES = 3  # with fewer, a hallucinated one cannot be told from the others


@dataclass(frozen=True, eq=False)
class Samples:
    """Answers of a language model about one scene.

    ``answers[i]`` are the accepted ones to query i, each with its numbers in `Answer.value`, ``refused`` those that
    could not be read. ``num_asked`` were asked of each query, in ``seconds`` of wall time.
    """

    answers: tuple[tuple[Answer, ...], ...] = ()
    refused: tuple[Answer, ...] = ()
    num_asked: int = 0
    seconds: float = 0.0


NO_SAMPLES = Samples()


@dataclass(frozen=True, eq=False)
class Proposal:
    """Candidate trajectories for one scene, what they cost, and notes for the user."""

    candidates: tuple[Trajectory, ...]
    stages: tuple[Stage, ...] = ()
    notes: tuple[str, ...] = ()


def sample(
    context: Context,
    scene: LocatedScene,
    llm: LanguageModel,
    settings: Settings,
    num_queries: int,
    deadline_s: float = DEADLINE_S,
    earlier: Samples = NO_SAMPLES,
    progress: Progress = no_progress,
) -> Samples:
    """``earlier`` samples of the scene, and as many more as make ``num_queries`` asked of each query.

    ``deadline_s`` bounds the wall time of all of them. Raises `ModelError` where the model cannot be used.
    """
    prompt = context.prompt.for_scene(scene.keypoints)
    queries = prompt.queries(scene.keypoints)
    if earlier.num_asked >= num_queries or earlier.seconds >= deadline_s or not queries:
        return earlier
    refused: list[Answer] = []

    def keep_refused(query_index: int, sample_index: int, attempt: int, answer: Answer, accepted: bool) -> None:
        if not accepted:
            refused.append(answer)

    start = time.perf_counter()
    answers = llm.sample(
        queries,
        Sampling(
            num_queries - earlier.num_asked,
            settings.temperature,
            settings.seed,
            earlier.num_asked,
            deadline_s - earlier.seconds,
        ),
        Listener(
            accept=prompt.read,
            on_progress=lambda done, total: progress("language model", done, total),
            on_answer=keep_refused,
        ),
    )
    return Samples(
        tuple((*before, *new) for before, new in zip(earlier.answers or [()] * len(queries), answers, strict=True)),
        (*earlier.refused, *refused),
        num_queries,
        earlier.seconds + time.perf_counter() - start,
    )


def count_candidates(samples: Samples, num_queries: int) -> int:
    """How many trajectories the first ``num_queries`` answers to each query make.

    Where the demonstrations agree on every number there is nothing to ask, and all candidates are equal.
    """
    return min((len(own[:num_queries]) for own in samples.answers), default=num_queries)


def propose(context: Context, scene: LocatedScene, samples: Samples, num_queries: int) -> Proposal:
    """The candidates that the first ``num_queries`` answers to each query make.

    Raises `PlanningError` where they are fewer than `MIN_CANDIDATES` (or ``num_queries``, if that is less).
    """
    answers = [own[:num_queries] for own in samples.answers]
    count, needed = count_candidates(samples, num_queries), min(MIN_CANDIDATES, num_queries)
    if count < needed:
        complete = sum(len(own) == num_queries for own in answers)
        advice = refusal_advice(samples.refused) or "give it more time (--deadline) or another model (--llm)"
        raise PlanningError(
            f"{count} of {num_queries} trajectories came in {samples.seconds:.0f} s, {needed} are needed "
            f"({complete} of {len(answers)} prompts were answered in full); {advice}"
        )
    prompt = context.prompt.for_scene(scene.keypoints)
    candidates = tuple(
        prompt.trajectory([own[index].value for own in answers], scene.keypoints) for index in range(count)
    )
    notes = [] if count == num_queries else [f"{count} of {num_queries} answers were usable in time"]
    if not answers:
        notes.append("the language model was not asked: the demonstrations agree on every number of the prompt")
    return Proposal(candidates, (_cost(samples.seconds, answers),), tuple(notes))


def _cost(seconds: float, answers: Sequence[Sequence[Answer]]) -> Stage:
    every = [answer for own in answers for answer in own]
    return Stage(
        "language model",
        seconds,
        sum(answer.prompt_tokens for answer in every),
        sum(answer.cached_tokens for answer in every),
        sum(answer.completion_tokens for answer in every),
    )
