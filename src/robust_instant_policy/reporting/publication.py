"""The tables, figures and the page of an evaluation, written from its rows."""

from collections.abc import Sequence
from pathlib import Path

from robust_instant_policy.errors import DatasetError
from robust_instant_policy.evaluation.experiment import TRAINING_FOLDER, plan_file
from robust_instant_policy.evaluation.failures import Failure
from robust_instant_policy.evaluation.statistics import Summary
from robust_instant_policy.evaluation.store import read_results
from robust_instant_policy.evaluation.suites import CHOSEN
from robust_instant_policy.files import read_regular, write_whole
from robust_instant_policy.policies import Plan
from robust_instant_policy.reporting.benchmark import benchmark_figure, benchmark_tables
from robust_instant_policy.reporting.evaluation import Section, evaluation_page
from robust_instant_policy.reporting.figures import draw, encode
from robust_instant_policy.reporting.tables import Table, failure_table, invocation_table, tables
from robust_instant_policy.tasks.level import make_level
from robust_instant_policy.tasks.maniskill_benchmark.benchmark import MANISKILL
from robust_instant_policy.tasks.metaworld.benchmark import METAWORLD

BENCHMARKS = {one.name: one for one in (METAWORLD, MANISKILL)}  # suites with tables and figure of their own
TABLE_FILE = "table.md"
FAILURE_TABLE_FILE = "failures.md"
RUN_TABLE_FILE = "run.md"
PAGE_FILE = "index.html"


def publish(out: Path) -> str:
    """Write, for each suite in ``out`` and each configuration in it, ``SUITE-CONFIG.svg``, ``.png`` and ``.md``;
    then ``failures.md``, ``run.md``, ``table.md`` with all tables, and ``index.html``. Returns the text of
    ``table.md``. Methods and tasks chosen by hand have a section of their own only as far as no analysis of the
    paper shows their rows.

    Raises `DatasetError` where nothing has been executed yet.
    """
    results = read_results(out)
    episodes, failures, manifest = results.episodes, results.failures, results.manifest
    if not episodes:
        raise DatasetError(f"{out} holds no executions yet; run rip eval --out {out} first")
    summaries = [
        (config, split, Summary(part, episodes))
        for suite in manifest.suites
        for split, scenes in suite.by_split().items()
        for config, part in scenes.by_config().items()
    ]
    of_paper = {row.key for *_, summary in summaries if summary.suite.name != CHOSEN for row in summary.rows}
    shown = [
        (config, split, summary)
        for config, split, summary in summaries
        if any(row.variant.config == config for row in summary.rows)
        and (summary.suite.name != CHOSEN or not {row.key for row in summary.rows} <= of_paper)
    ]
    sections = [_publish_suite(out, config, split, summary, failures) for config, split, summary in shown]
    rows = list({row.key: row for *_, summary in shown for row in summary.rows}.values())
    lost = failure_table(rows, failures)
    text = _text([table for section in sections for table in section.tables])
    write_whole(out / FAILURE_TABLE_FILE, lost.markdown().encode())
    write_whole(out / TABLE_FILE, text.encode())
    invocations = invocation_table(manifest.invocations, rows)
    write_whole(out / RUN_TABLE_FILE, invocations.markdown().encode())
    trainings = {path.stem: read_regular(path) for path in sorted((out / TRAINING_FOLDER).glob("*.svg"))}
    page = evaluation_page(out, sections, trainings, rows, failures, lost, invocations)
    write_whole(out / PAGE_FILE, page.encode())
    return text


def _publish_suite(out: Path, config: str, split: str, summary: Summary, failures: Sequence[Failure]) -> Section:
    suite = summary.suite
    usual = make_level(suite.level).objects
    kinds = tuple(kind for kind, expected in ((suite.objects, usual), (suite.assets, "code")) if kind != expected)
    if (benchmark := BENCHMARKS.get(suite.name)) is None:
        files = {row.trial: out / plan_file(*row.trial) for row in summary.rows if suite.keeps_plans}
        plans = {trial: Plan.load(path) for trial, path in files.items() if path.exists()}
        figure, shown = draw(summary, plans), tables(summary)
    else:
        figure, shown = benchmark_figure(benchmark, summary), benchmark_tables(benchmark, summary, failures)
    drawing = encode(figure, "svg")
    section = Section(suite.name, suite.level, config, kinds, drawing, shown, split)
    stem = section.anchor
    write_whole(out / f"{stem}.svg", drawing)
    write_whole(out / f"{stem}.png", encode(figure, "png"))
    if section.tables:
        write_whole(out / f"{stem}.md", _text(section.tables).encode())
    return section


def _text(shown: Sequence[Table]) -> str:
    return "\n".join(table.markdown() for table in shown)
