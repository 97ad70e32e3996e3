"""The self-contained page of an evaluation: ``index.html``."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.failures import Failure, video_file
from robust_instant_policy.evaluation.variant import PAPER_CONFIGS
from robust_instant_policy.files import read_regular
from robust_instant_policy.reporting.pages import data_uri, render
from robust_instant_policy.reporting.tables import Table
from robust_instant_policy.tasks.level import PAPER

TITLES = {
    "chosen": "Success rates",
    "table1": "Table I: all methods, all tasks",
    "demos": "How many demonstrations",
    "queries": "How many queries Q",
    "dof": "How many degrees of freedom ν",
    "downsampling": "Downsampling: normal or gripper-based",
    "trajectories": "A hallucinated candidate: KAT, Gaussian, RIP",
    "metaworld": "Meta-World: fifty tasks",
    "maniskill": "ManiSkill: tasks of the Panda",
}
WHISKERS = "Whiskers: Wilson's 95% interval; of the average, ± one standard deviation over tasks."
CAPTIONS = {
    "chosen": f"Success in each task. {WHISKERS}",
    "table1": f"Success in each task. {WHISKERS}",
    "demos": "Mean over tasks and, shaded, ± one standard deviation, by the number of demonstrations.",
    "queries": "RIP by the number Q of trajectories that the language model is asked for; symbols are single tasks.",
    "dof": "RIP by the degrees of freedom ν; ∞ is the Gaussian average. Symbols are single tasks.",
    "downsampling": "RIP on tasks with gripper actions. Whiskers: Wilson's 95% interval.",
    "metaworld": "Mean success over the tasks of each group of difficulty; grey: published policies, another protocol.",
    "maniskill": "Mean success over the tasks of each group.",
    "trajectories": "Position over time in the scene in which RIP and the Gaussian average differ most.",
}
TOLD = " Black lines: the paper's own numbers, with other scenes and GPT-4o; for ALOHA's tasks, of a physical robot."
CAUSES = {
    "execution": "execution: the demonstrator's own trajectory fails, too, when it is replayed",
    "keypoints": "keypoints: with the true keypoints the method succeeds",
    "samples": "samples: no candidate succeeds, or a single sample was executed",
    "regression": "regression: one of its candidates succeeds alone",
    "policy": "policy: the demonstrator's trajectory succeeds when it is replayed",
    "unknown": "unknown: the task has no ground truth to tell",
}


@dataclass(frozen=True)
class Section:
    """One suite in one configuration: name, level, ``config``, ``kinds`` of objects if they are not the level's usual
    ones, figure as SVG, tables, and the ``split`` of the scenes if the run has both.
    """

    name: str
    level: str
    config: str
    kinds: tuple[str, ...]
    figure: bytes
    tables: Sequence[Table]
    split: str = ""

    @property
    def title(self) -> str:
        config = f", configuration: {self.config}" if self.config else ""
        level = "" if self.level == PAPER.name else f", {self.level} scenes"
        split = f", scenes of the split {self.split}" if self.split else ""
        return (
            TITLES[self.name] + config + level + split + (f" ({', '.join(self.kinds)} objects)" if self.kinds else "")
        )

    @property
    def anchor(self) -> str:
        config = re.sub(r"[^\w.-]+", "-", self.config)
        level = "" if self.level == PAPER.name else self.level
        return "-".join(word for word in (self.name, config, level, self.split, *self.kinds) if word)

    @property
    def image(self) -> str:
        return data_uri(self.figure, "image/svg+xml")

    @property
    def caption(self) -> str:
        return CAPTIONS[self.name] + (TOLD if self.name == "table1" and self.config in PAPER_CONFIGS else "")


@dataclass(frozen=True)
class FailedEpisode:
    """A failed episode on the page; ``video`` is a data URL, empty if there is no video."""

    outcome: str
    cause: str
    where: str
    video: str


def evaluation_page(
    folder: Path,
    sections: Sequence[Section],
    trainings: Mapping[str, bytes],
    episodes: Sequence[Episode],
    failures: Iterable[Failure],
    failure_table: Table,
    invocations: Table,
) -> str:
    """The page as text; videos of failed episodes are taken from ``folder``.

    ``trainings`` are pictures, as SVG, of what trained methods learned.
    """
    causes = {failure.key: failure for failure in failures}
    groups: dict[str, list[FailedEpisode]] = {}
    failed = [row for row in episodes if not row.success]
    for row in sorted(failed, key=lambda row: (row.scene.task, row.variant.method, row.variant.config)):
        words = (row.scene.task, row.variant.method, row.variant.config)
        group = groups.setdefault(", ".join(word for word in words if word), [])
        group.append(_failed_episode(folder, row, causes.get(row.key)))
    tasks = ", ".join(dict.fromkeys(row.scene.task for row in episodes))
    return render(
        "evaluation.html",
        title=f"Evaluation: {tasks}",
        tasks=tasks,
        methods=", ".join(dict.fromkeys(row.variant.method for row in episodes)),
        facts={
            "executions": f"{len(episodes):,}",
            "scenes": f"{len({row.scene for row in episodes}):,}",
            "failed": f"{len(failed):,}",
        },
        sections=sections,
        trainings={name: data_uri(content, "image/svg+xml") for name, content in trainings.items()},
        failure_table=failure_table,
        failed=groups,
        invocations=invocations,
    )


def _failed_episode(folder: Path, row: Episode, failure: Failure | None) -> FailedEpisode:
    path = folder / video_file(*row.key)
    cause = "not examined" if failure is None else CAUSES[failure.stage]
    if failure is not None and failure.keypoint_error:
        cause += f"; largest keypoint error {1000 * failure.keypoint_error:.0f} mm"
    objects = "" if row.scene.objects == "seen" else f", {row.scene.objects} objects"
    which = f", candidate {row.candidate + 1} of {row.candidates}" if row.candidates > 1 else ""
    video = data_uri(read_regular(path), "video/mp4") if path.exists() else ""
    return FailedEpisode(row.failure, cause, f"{row.variant}, scene {row.scene.seed}{objects}{which}", video)
