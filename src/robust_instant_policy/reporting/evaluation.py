"""``index.html``: one page, without anything beside it, that tells the whole story of a run."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.failures import Failure, video_file
from robust_instant_policy.evaluation.tables import Table

TITLES = {
    "chosen": "Success rates",
    "table1": "Table I: all methods, all tasks",
    "demos": "How many demonstrations",
    "queries": "How many queries Q",
    "dof": "How many degrees of freedom ν",
    "downsampling": "Downsampling: normal or gripper-based",
    "trajectories": "A hallucinated candidate: KAT, Gaussian, RIP",
}
WHISKERS = "Whiskers: Wilson's 95% interval; of the average, ± one standard deviation over tasks."
CAPTIONS = {
    "chosen": f"Success in each task. {WHISKERS}",
    "table1": f"Success in each task. {WHISKERS} Black lines: the paper's own numbers, with other scenes and GPT-4o.",
    "demos": "Mean over tasks, shaded ± one standard deviation, over the number of demonstrations shown.",
    "queries": "RIP over the number Q of trajectories that the language model is asked for; symbols are single tasks.",
    "dof": "RIP over the degrees of freedom ν; ∞ is the Gaussian average. Symbols are single tasks.",
    "downsampling": "RIP on tasks with gripper actions. Whiskers: Wilson's 95% interval.",
    "trajectories": "The palm over time in the scene in which RIP and the Gaussian average part the most.",
}
TRAINING_CAPTION = (
    "How the loss of each trained method fell, and what it samples where demonstrations say what is right."
)
STAGE_WORDS = {
    "execution": "execution: even the demonstrator's own trajectory fails when it is played back",
    "keypoints": "keypoints: with the true ones the method succeeds",
    "samples": "samples: no candidate succeeds, or this one was taken at its word",
    "regression": "regression: one of its candidates succeeds by itself",
    "policy": "policy: played back, the demonstrator's trajectory succeeds",
}
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222}
h1{font-size:1.6em}h2{margin-top:2em;border-bottom:1px solid #ccc}
table{border-collapse:collapse;font-size:.85em;margin:1em 0;display:block;overflow-x:auto}
td,th{border-bottom:1px solid #ddd;padding:.25em .6em;text-align:right;white-space:nowrap}
td:first-child,th:first-child{text-align:left}
td:has(code){white-space:normal;min-width:24em}
figure{margin:1em 0}figure img{max-width:100%}figcaption,.note{color:#666;font-size:.85em;max-width:60em}
.films{display:grid;grid-template-columns:repeat(auto-fill,minmax(250px,1fr));gap:1em}
.films figure{margin:0;border:1px solid #ddd;padding:.5em}.films video{width:100%;background:#eee;aspect-ratio:4/3}
code{background:#f3f3f3;padding:.1em .3em;overflow-wrap:anywhere}nav a{margin-right:1em}
summary{cursor:pointer;margin:.6em 0}
"""


@dataclass(frozen=True)
class Section:
    """One suite: its name, the ``kinds`` of its objects where they are not the usual ones, its figure as SVG and its
    tables.
    """

    name: str
    kinds: tuple[str, ...]
    figure: bytes
    tables: Sequence[Table]

    @property
    def title(self) -> str:
        return TITLES[self.name] + (f" ({', '.join(self.kinds)} objects)" if self.kinds else "")

    @property
    def anchor(self) -> str:
        return "-".join((self.name, *self.kinds))


def write_page(
    folder: Path,
    sections: Sequence[Section],
    trainings: Mapping[str, bytes],
    episodes: Sequence[Episode],
    failures: Iterable[Failure],
    failure_table: Table,
    invocations: Table,
) -> str:
    """The page as text; films of failed episodes are taken from ``folder``.

    ``trainings`` are pictures, as SVG, of what trained methods learned.
    """
    lost = [row for row in episodes if not row.success]
    tasks = list(dict.fromkeys(row.scene.task for row in episodes))
    methods = list(dict.fromkeys(row.variant.method for row in episodes))
    links = "".join(f'<a href="#{section.anchor}">{html.escape(section.title)}</a>' for section in sections)
    if trainings:
        links += "<a href='#training'>What was learned</a>"
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>",
        f"<title>Evaluation: {html.escape(', '.join(tasks))}</title><style>{STYLE}</style>",
        "<h1>Robust Instant Policy: evaluation</h1>",
        f"<p>{len(episodes):,} executions of {html.escape(', '.join(methods))} in "
        f"{len({row.scene for row in episodes})} scenes of {html.escape(', '.join(tasks))}; {len(lost):,} failed.</p>",
        f"<nav>{links}<a href='#failures'>What failed, and why</a><a href='#run'>What was run</a></nav>",
        *(_section(section) for section in sections),
        _trainings(trainings),
        "<h2 id=failures>What failed, and why</h2>",
        failure_table.html(),
        _gallery(folder, lost, {failure.key: failure for failure in failures}),
        "<h2 id=run>What was run</h2>",
        invocations.html(),
        "</html>",
    ]
    return "\n".join(parts)


def _section(section: Section) -> str:
    tables = "".join(table.html() for table in section.tables)
    picture = _picture(section.title, section.figure, CAPTIONS[section.name])
    return f"<h2 id={section.anchor}>{html.escape(section.title)}</h2>{picture}{tables}"


def _trainings(pictures: Mapping[str, bytes]) -> str:
    if not pictures:
        return ""
    shown = "".join(_picture(name, picture, name) for name, picture in pictures.items())
    return f"<h2 id=training>What was learned</h2><p class=note>{TRAINING_CAPTION}</p>{shown}"


def _picture(title: str, svg: bytes, caption: str) -> str:
    image = base64.b64encode(svg).decode()
    return (
        f'<figure><img alt="{html.escape(title)}" src="data:image/svg+xml;base64,{image}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _gallery(folder: Path, lost: Sequence[Episode], failures: dict) -> str:
    """Every failed episode, in one fold for each task and method."""
    groups: dict[tuple[str, str], list[Episode]] = {}
    for row in lost:
        groups.setdefault((row.scene.task, row.variant.method), []).append(row)
    folds = []
    for (task, method), rows in sorted(groups.items()):
        cards = "".join(_card(folder, row, failures.get(row.key)) for row in rows)
        title = f"{task}, {method}: {len(rows)} failed"
        folds.append(f"<details open><summary>{html.escape(title)}</summary><div class=films>{cards}</div></details>")
    return "".join(folds) or "<p>Nothing failed.</p>"


def _card(folder: Path, row: Episode, failure: Failure | None) -> str:
    path = folder / video_file(*row.key)
    film = "<p class=note>no film</p>"
    if path.exists():
        content = base64.b64encode(path.read_bytes()).decode()
        film = f'<video controls muted preload=metadata src="data:video/mp4;base64,{content}"></video>'
    elif row.executed_seconds == 0:
        film = "<p class=note>nothing moved</p>"
    words = "not examined" if failure is None else STAGE_WORDS[failure.stage]
    if failure is not None and failure.keypoint_error:
        words += f"; keypoints off by at most {1000 * failure.keypoint_error:.0f} mm"
    which = f", candidate {row.candidate + 1} of {row.candidates}" if row.candidates > 1 else ""
    objects = "" if row.scene.objects == "seen" else f", {row.scene.objects} objects"
    return (
        f"<figure>{film}<figcaption><b>{html.escape(row.failure)}</b><br>{html.escape(words)}<br>"
        f"{html.escape(str(row.variant))}, scene {row.scene.seed}{objects}{which}</figcaption></figure>"
    )
