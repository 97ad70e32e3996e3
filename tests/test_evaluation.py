"""Results, statistics and tables; what workers do is in test_evaluation_workers.py."""

import json
import math
import os
import re
import resource
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import asdict, replace
from fractions import Fraction

import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from robust_instant_policy.cli import main
from robust_instant_policy.errors import DatasetError, InvalidValueError, RipError, UnknownNameError
from robust_instant_policy.evaluation import (
    STORE_FILE,
    Analysis,
    Choice,
    Episode,
    Failure,
    ResultsStore,
    Scene,
    Suite,
    Variant,
    make_suites,
    merge,
    paper,
    read_results,
    scene_seed,
)
from robust_instant_policy.evaluation.experiment import by_trial, missing_work, plan_file, wanted_trials
from robust_instant_policy.evaluation.failures import video_file
from robust_instant_policy.evaluation.manifest import PACKAGE, code_digest
from robust_instant_policy.evaluation.scenes import SEEDS_A_SET, first_demonstration_seed
from robust_instant_policy.evaluation.statistics import (
    Summary,
    difference_interval,
    holm,
    mark,
    paired_test,
    t_test,
    wilson_interval,
)
from robust_instant_policy.evaluation.variant import labels
from robust_instant_policy.evaluation.work import SceneWork
from robust_instant_policy.evaluation.workers import MAX_DEATHS, Agenda
from robust_instant_policy.llm import SampleStore
from robust_instant_policy.query import Answer, Query
from robust_instant_policy.reporting.figures import draw, encode
from robust_instant_policy.reporting.publication import publish
from robust_instant_policy.reporting.tables import tables

RIP = Variant("rip", model="a model")
KAT = Variant("kat", model="a model")
SCENE = Scene("push-cube", "seen", 0)


def episode(variant: Variant, seed: int, success: bool, candidate: int = 0, of: int = 1) -> Episode:
    return Episode(
        scene=Scene("push-cube", "seen", seed),
        variant=variant,
        candidate=candidate,
        candidates=of,
        success=success,
        seconds=1.5,
        physics_seconds=0.5,
        executed_seconds=5.0,
        tokens=1000,
        confidence=None,
        failure="" if success else "missed",
    )


def test_the_wilson_interval_agrees_with_the_published_example():
    # Newcombe 1998, Statistics in Medicine 17, Table I: 81 of 263 gives 0.2553 to 0.3662.
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson_interval(0, 10)[0] == pytest.approx(0)
    assert wilson_interval(10, 10)[1] == pytest.approx(1)


def test_more_successes_than_trials_are_refused():
    with pytest.raises(InvalidValueError, match="3 of 2"):
        wilson_interval(3, 2)


def test_the_t_test_gives_the_marks_that_the_paper_prints_for_its_own_table():
    printed = {"dp": "**", "kat-dp": "*", "kat": "*", "rip-gauss": "", "rip": ""}
    for method, marks in printed.items():
        assert mark(t_test(paper.TABLE1["rip"], paper.TABLE1[method])) == marks, method


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=30))
def test_with_one_execution_a_scene_the_paired_test_is_mcnemars(outcomes):
    scenes = [Scene("push-cube", "seen", seed) for seed in range(len(outcomes))]
    ours = {scene: Fraction(int(first)) for scene, (first, _) in zip(scenes, outcomes, strict=True)}
    theirs = {scene: Fraction(int(second)) for scene, (_, second) in zip(scenes, outcomes, strict=True)}
    found = paired_test(ours, theirs)
    discordant = found.better + found.worse
    expected = binomtest(found.better, discordant, 0.5).pvalue if discordant else 1.0
    assert found.p == pytest.approx(expected)


def test_the_paired_test_looks_only_at_scenes_that_both_methods_were_tried_in():
    ours = {Scene("push-cube", "seen", seed): Fraction(1) for seed in range(8)}
    theirs = {Scene("push-cube", "seen", seed): Fraction(2, 5) for seed in range(2, 20)}
    found = paired_test(ours, theirs)
    assert (found.scenes, found.better, found.worse) == (6, 6, 0)
    assert found.p == pytest.approx(2 / 2**6)  # all six the same way round, or all the other


def test_what_a_method_does_not_use_does_not_tell_its_variants_apart():
    assert Variant("kat", dof=3.0) == Variant("kat", dof=1.25)
    assert Variant("neighbours", frames="world", model="a") == Variant("neighbours", frames="adaptive", model="b")
    assert Variant("rip", dof=math.inf) == Variant("rip-gauss")
    assert Variant("rip", dof=3.0) != Variant("rip", dof=1.5)


def keep(folder, *rows: Episode | Failure) -> None:
    with closing(ResultsStore(folder)) as store:
        store.add(*rows)


def test_rows_survive_on_disk_and_go_on(tmp_path):
    rows = (episode(KAT, 1, True, of=2), episode(KAT, 1, False, candidate=1, of=2))
    keep(tmp_path / "out", *rows)
    assert read_results(tmp_path / "out").episodes == rows
    keep(tmp_path / "out", episode(Variant("rip-gauss"), 1, True))
    assert read_results(tmp_path / "out").episodes[-1].variant.dof == math.inf
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["results.sqlite"]


def test_a_row_is_kept_once(tmp_path):
    keep(tmp_path, episode(RIP, 1, True), episode(RIP, 1, True))
    keep(tmp_path, episode(RIP, 1, False))
    assert read_results(tmp_path).episodes == (episode(RIP, 1, True),)


def test_rows_of_other_code_demonstrations_features_or_deadline_are_rows_of_their_own(tmp_path):
    settings = ({}, {"code": "a"}, {"demonstrations": "b"}, {"features": "dino"}, {"deadline_s": 60.0})
    rows = tuple(episode(replace(RIP, **setting), 1, True) for setting in settings)
    keep(tmp_path, *rows)
    assert read_results(tmp_path).episodes == rows
    assert len({video_file(*row.key) for row in rows}) == len(rows)


def test_rows_of_two_versions_of_the_code_have_a_line_each_in_the_table():
    old, new = replace(RIP, code="aaa"), replace(RIP, code="bbb")
    suite = Suite("table1", ("push-cube",), (old, new), (1, 2))
    success = tables(Summary(suite, [episode(old, 1, True), episode(old, 2, True), episode(new, 1, False)]))[0]
    cells = {row[0]: row[1].split()[0] for row in success.rows}
    assert cells == {"rip (code aaa)": "**100**", "rip (code bbb)": "0"}


def test_of_several_sets_of_demonstrations_the_last_counts():
    first, second = replace(RIP, demonstrations="one"), replace(RIP, demonstrations="two")
    suite = Suite("table1", ("push-cube",), (RIP,), (1, 2))
    rows = [episode(first, 1, True), episode(second, 1, False), episode(first, 2, True)]
    assert Summary(suite, rows).rows == [rows[0], rows[2]]
    assert Summary(suite, rows[:2]).rows == [rows[1]]


def test_a_kill_in_the_middle_of_writing_loses_no_row_and_leaves_no_half(tmp_path):
    script = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from robust_instant_policy.evaluation import Episode, ResultsStore, Scene, Variant\n"
        "store = ResultsStore(Path(sys.argv[1]))\n"
        "for seed in range(100_000):\n"
        "    scene = Scene('push-cube', 'seen', seed)\n"
        "    store.add(*(Episode(scene, Variant('rip'), n, 2, True, 1, 1, 1, 1, None, '') for n in range(2)))\n"
        "    print(seed, flush=True)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        for _ in range(20):
            writer.stdout.readline()
        writer.kill()
        said = 20 + len(writer.stdout.readlines())
    seeds = [row.scene.seed for row in read_results(tmp_path).episodes]
    assert seeds[::2] == seeds[1::2] == list(range(len(seeds) // 2))
    assert said <= len(seeds) // 2 <= said + 1


def test_reading_the_rows_of_a_run_under_way_changes_nothing_on_disk(tmp_path):
    with closing(ResultsStore(tmp_path)) as writer:
        writer.add(episode(RIP, 0, True))
        before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        assert len(read_results(tmp_path).episodes) == 1
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
        writer.add(episode(RIP, 1, True))
        assert len(read_results(tmp_path).episodes) == 2


def test_a_full_disk_doubles_no_row_once_there_is_space_again(tmp_path):
    with closing(ResultsStore(tmp_path)) as store:
        store.add(episode(RIP, 0, True))
        _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (store.path.stat().st_size, most))
        try:
            with pytest.raises(DatasetError, match="free space"):
                store.add(*(episode(RIP, seed, True) for seed in range(1, 500)))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
        assert read_results(tmp_path).episodes == (episode(RIP, 0, True),)
        store.add(*(episode(RIP, seed, True) for seed in range(1, 500)))
    assert [row.scene.seed for row in read_results(tmp_path).episodes] == list(range(500))


def test_a_damaged_file_is_refused_in_one_line(tmp_path):
    for name, content in (("results.sqlite", b"not a database, but 30 bytes"), ("episodes.parquet", b"PAR1 half")):
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).write_bytes(content)
        for use in (read_results, ResultsStore):
            with pytest.raises(DatasetError, match="move it away"):
                use(folder)


def an_export(folder, *rows: Episode | Failure) -> None:
    """A folder as an older version left it: parquet files and run.json only."""
    keep(folder, *rows)
    with closing(ResultsStore(folder)) as store:
        store.export()
    (folder / "results.sqlite").unlink()


def test_a_folder_with_parquet_files_only_is_read_and_goes_on(tmp_path):
    lost = episode(RIP, 1, False)
    an_export(tmp_path, lost, Failure(*lost.key, "samples", True, False, 0.01, False))
    parquet = (tmp_path / "episodes.parquet").read_bytes()
    (tmp_path / "results.sqlite").touch()  # as one that was killed when it had just begun
    results = read_results(tmp_path)
    assert (results.episodes, results.failures[0].key) == ((lost,), lost.key)
    assert (tmp_path / "episodes.parquet").read_bytes() == parquet
    keep(tmp_path, episode(RIP, 2, True))
    assert read_results(tmp_path).episodes == (lost, episode(RIP, 2, True))
    assert read_results(tmp_path).failures == results.failures


def test_a_setting_that_came_after_a_file_was_written_has_its_default(tmp_path):
    an_export(tmp_path, episode(RIP, 1, True))
    path = tmp_path / "episodes.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["features", "code", "assets"]), path)
    assert read_results(tmp_path).episodes == (episode(RIP, 1, True),)
    pq.write_table(pq.read_table(path).select(["task", "method"]), path)
    with pytest.raises(DatasetError, match="--replay"):
        read_results(tmp_path)


def test_a_store_of_an_older_version_gets_the_columns_that_came_later(tmp_path):
    keep(tmp_path, episode(RIP, 1, True))
    with closing(sqlite3.connect(tmp_path / "results.sqlite")) as database:
        database.executescript("DROP INDEX episodes_key; ALTER TABLE episodes DROP COLUMN code")
    assert read_results(tmp_path).episodes == (episode(RIP, 1, True),)
    keep(tmp_path, episode(RIP, 1, False), episode(replace(RIP, code="new"), 1, False))
    assert read_results(tmp_path).episodes == (episode(RIP, 1, True), episode(replace(RIP, code="new"), 1, False))


def test_code_that_decides_results_makes_other_rows_and_a_command_does_not(tmp_path):
    def digest_after(changed: str | None) -> str:
        copy = tmp_path / str(changed).replace("/", "-")
        shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
        if changed is not None:
            with (copy / changed).open("a") as file:
                file.write("\n")
        return code_digest(copy)

    same = ("commands/eval.py", "reporting/tables.py", "evaluation/store.py")
    deciding = ("policies/rip.py", "evaluation/rollout.py", "motion/urdf/ur5e_hande.urdf")
    assert {digest_after(None), *map(digest_after, same)} == {code_digest()}
    assert len({code_digest(), *map(digest_after, deciding)}) == 1 + len(deciding)


def test_any_seed_draws_a_scene_of_its_own_that_tables_can_hold(tmp_path):
    assert scene_seed(3, 4) == 103_004
    assert scene_seed(3, 4, "test") == 1_003_004
    seeds = [scene_seed(seed, index) for seed in (0, 4_294_867, 10**18, 10**40) for index in range(3)]
    assert len(set(seeds)) == len(seeds)
    keep(tmp_path, *(episode(RIP, seed, True) for seed in seeds))
    an_export(tmp_path)
    assert [row.scene.seed for row in read_results(tmp_path).episodes] == seeds


def test_work_goes_on_with_the_executions_that_are_missing(tmp_path):
    suite = Suite("chosen", ("push-cube",), (RIP, KAT), (1, 2, 3))
    rows = [episode(RIP, 1, True), episode(KAT, 1, True, of=2), episode(RIP, 2, True), episode(KAT, 2, True)]
    works = missing_work(wanted_trials([suite]), [], by_trial(rows), [], tmp_path, films=False)
    assert [(work.scene.seed, work.variants) for work in works] == [(1, (KAT,)), (3, (RIP, KAT))]
    assert (Scene("push-cube", "seen", 1), KAT, 0) in works[0].done


def test_a_failed_episode_without_an_analysis_is_work_left(tmp_path):
    suite = Suite("chosen", ("push-cube",), (RIP,), (1,))
    lost = episode(RIP, 1, False)
    (work,) = missing_work(wanted_trials([suite]), [], by_trial([lost]), [], tmp_path, films=False)
    assert work.failed == (lost,)
    assert not work.variants


def test_suites_that_ask_for_the_same_plans_ask_once():
    table1, demos = make_suites(["table1", "demos"], Choice(RIP, tasks=["push-cube"], methods=["rip"]))
    both = wanted_trials([table1, demos])
    assert len(both) == len(wanted_trials([demos])) == 50
    assert len(make_suites(["all"], Choice(RIP))) == 6


def test_the_suites_vary_what_the_paper_varies():
    queries, dof = make_suites(["queries", "dof"], Choice(RIP))
    assert [(one.queries, one.demos) for one in queries.variants] == [(2, 20), (3, 20), (5, 20), (10, 20)]
    assert [one.dof for one in dof.variants] == [1.25, 1.5, 3.0, math.inf]
    (downsampling,) = make_suites(["downsampling"], Choice(RIP))
    assert "push-cube" not in downsampling.tasks


def test_an_unknown_suite_task_or_method_is_told():
    with pytest.raises(UnknownNameError, match="table1"):
        make_suites(["table7"], Choice(RIP))
    with pytest.raises(UnknownNameError, match="push-cube"):
        make_suites(["table1"], Choice(RIP, tasks=["fly"]))
    with pytest.raises(UnknownNameError, match="rip-gauss"):
        make_suites(["table1"], Choice(RIP, methods=["magic"]))


PAPER = {"frames": "world", "layout": "sequence", "keypoints": "nearest", "column": "sim", "estimator": "network-sim"}


def test_the_table_counts_every_execution_and_marks_the_best():
    suite = Suite("table1", ("push-cube",), (RIP, KAT), tuple(range(4)))
    rows = [episode(RIP, seed, True) for seed in range(4)]
    rows += [episode(KAT, seed, candidate < 2, candidate, of=5) for seed in range(4) for candidate in range(5)]
    success, tests = (table.markdown() for table in tables(Summary(suite, rows)))
    assert "| rip | **100** (51 to 100) | 100.0 ± 0.0 |" in success
    assert "| kat | 40 (10 to 80) | 40.0 ± 0.0 |" in success
    assert "| kat | +60.0 (+60.0 to +60.0) | 4 | 4 | 0 | 0.125 | 0.125 | – |" in tests


def test_the_papers_numbers_stand_beside_rows_of_its_configuration_only(tmp_path):
    dp = Variant("dp")
    ours = (RIP, replace(RIP, **PAPER), replace(RIP, **PAPER | {"keypoints": "registration"}), dp)
    assert [one.config for one in ours] == ["adaptive", "paper", "paper, keypoints registration", ""]
    a_run(tmp_path, Suite("table1", ("push-cube",), ours, (1,)), [episode(one, 1, True) for one in ours], [])
    publish(tmp_path)
    heads = {path.name: path.read_text().splitlines() for path in tmp_path.glob("table1-*.md")}
    assert heads.keys() == {"table1-adaptive.md", "table1-paper.md", "table1-paper-keypoints-registration.md"}
    assert heads["table1-paper.md"][0] == "| method | push-cube | paper | average | paper |"
    assert [line.split(" | ")[2] for line in heads["table1-paper.md"][2:4]] == ["100", "30"]
    for name in heads.keys() - {"table1-paper.md"}:
        assert heads[name][0] == "| method | push-cube | average |"
    assert "Configuration: adaptive" in "".join(heads["table1-adaptive.md"])
    assert set(pq.read_table(tmp_path / "episodes.parquet")["config"].to_pylist()) == {one.config for one in ours}


def test_the_papers_numbers_stand_beside_its_own_settings_and_scenes_only(tmp_path):
    exact = replace(RIP, **PAPER)
    ours = (exact, replace(exact, queries=2), replace(exact, dof=3.0), replace(exact, demos=5))
    for level in ("paper", "hard"):
        rows = [replace(episode(one, 1, True), scene=Scene("push-cube", "seen", 1, level=level)) for one in ours]
        suite = Suite("table1", ("push-cube",), ours, (1,), level=level)
        (table, *_) = tables(Summary(suite, rows))
        beside = [row[2] for row in table.rows] if "paper" in table.head else []
        assert beside == (["100", "–", "–", "–"] if level == "paper" else [])


@pytest.mark.filterwarnings("error")
def test_a_figure_of_many_variants_has_room_for_its_legend_and_its_bars():
    many = tuple(replace(RIP, queries=queries, model=f"a-model-with-a-long-name-{queries}") for queries in range(2, 32))
    summary = Summary(Suite("chosen", ("push-cube",), many, (1,)), [episode(one, 1, True) for one in many])
    assert encode(draw(summary, {}), "png").startswith(b"\x89PNG")


def test_scenes_for_tuning_and_scenes_for_tests_have_tables_of_their_own(tmp_path):
    seeds = scene_seed(0, 0, "tune"), scene_seed(0, 0, "test")
    with pytest.raises(RipError, match="100 sets"):
        first_demonstration_seed(100)
    suite = Suite("chosen", ("push-cube",), (RIP,), seeds)
    a_run(tmp_path, suite, [episode(RIP, seed, seed == seeds[0]) for seed in seeds], [])
    publish(tmp_path)
    assert "| rip | **100** (21 to 100)" in (tmp_path / "chosen-adaptive-tune.md").read_text()
    test = (tmp_path / "chosen-adaptive-test.md").read_text()
    assert "| rip | **0** (0 to 79)" in test
    assert "marked" not in test  # there is no other method


def test_frames_of_gp_and_the_estimator_mean_decide_what_a_row_is():
    world = Variant("gp", frames="world")
    assert world != Variant("gp")
    assert [Variant("gp", **PAPER).config, Variant("gp", **PAPER | {"frames": "adaptive"}).config] == [
        "paper", "paper, frames adaptive",
    ]  # fmt: skip
    assert Variant("rip", estimator="mean") == Variant("rip-gauss", estimator="mean") == Variant("mean")


def test_the_papers_estimator_fitted_exactly_is_a_row_of_its_own_in_its_configuration():
    network = replace(RIP, **PAPER)
    exact = replace(network, estimator="em-number")
    assert exact != network
    assert exact.config == network.config == "paper"
    assert labels([network, exact, RIP]) == [
        "rip (config paper, estimator network-sim)", "rip (config paper, estimator em-number)",
        "rip (config adaptive, estimator em)",
    ]  # fmt: skip
    assert len({one.file_name for one in (network, exact, RIP)}) == 3


def test_candidates_of_one_scene_are_not_counted_as_trials():
    suite = Suite("table1", ("push-cube",), (KAT,), tuple(range(10)))
    rows = [episode(KAT, seed, seed < 5, candidate, of=5) for seed in range(10) for candidate in range(5)]
    rate = Summary(suite, rows).rate(KAT)
    assert (rate.value, rate.scenes, rate.trials) == (0.5, 10, 50)
    assert rate.interval == pytest.approx(wilson_interval(5, 10))  # not that of 25 of 50


@given(st.integers(1, 40).flatmap(lambda trials: st.tuples(st.integers(0, trials), st.just(trials))))
def test_the_interval_is_that_of_scipy(counts):
    expected = binomtest(*counts).proportion_ci(method="wilson")
    assert wilson_interval(*counts) == pytest.approx(tuple(expected), abs=1e-9)


def test_sets_of_demonstrations_are_averaged_and_shown_side_by_side():
    sets = tuple(replace(RIP, demo_set=number) for number in range(3))
    suite = Suite("table1", ("push-cube",), sets, tuple(range(10)))
    rows = [episode(one, seed, seed < 10 - one.demo_set) for one in sets for seed in range(10)]
    summary = Summary(suite, rows)
    assert summary.variants == [RIP]
    assert summary.rate(RIP).value == pytest.approx(0.9)
    assert summary.rate(RIP).scenes == 10  # the three sets met the same scenes
    assert summary.of_sets(RIP) == {0: 1.0, 1: 0.9, 2: 0.8}
    assert (
        dict(zip(tables(summary)[0].head, tables(summary)[0].rows[0], strict=True))["with each set"]
        == "100.0, 90.0, 80.0"
    )


def test_methods_are_compared_with_the_sets_of_demonstrations_that_both_have():
    other, gp = replace(RIP, demo_set=1), Variant("gp")
    suite = Suite("table1", ("push-cube",), (RIP, other, gp), tuple(range(4)))
    rows = [episode(variant, seed, variant != other) for variant in (RIP, other, gp) for seed in range(4)]
    (found,) = Summary(suite, rows).compare(RIP)
    assert found.difference == 0.0  # RIP failed with the second set, which gp was not shown


def test_holms_correction_agrees_with_the_published_example():
    # Holm 1979, as in the example of R's p.adjust: sorted p-values times the number that is left, never falling.
    assert holm([0.01, 0.04, 0.03, math.nan]) == pytest.approx([0.03, 0.06, 0.06, math.nan], nan_ok=True)
    assert holm([0.6, 0.9]) == [1.0, 1.0]


def test_the_interval_of_a_difference_resamples_scenes_and_weighs_tasks_alike():
    ours = {Scene(task, "seen", seed): Fraction(1) for task, count in (("a", 10), ("b", 40)) for seed in range(count)}
    theirs = {scene: Fraction(int(scene.task == "b")) for scene in ours}
    assert difference_interval(ours, theirs) == pytest.approx((0.5, 0.5))
    half = {scene: Fraction(scene.seed % 2) for scene in ours}
    low, high = difference_interval(ours, half)
    assert 0.3 < low < 0.5 < high < 0.7


def test_hard_scenes_are_rows_of_their_own_with_objects_that_no_demonstration_showed(tmp_path):
    choice = Choice(RIP, tasks=["push-cube", "turn-faucet"], methods=["rip"], num_scenes=1)
    (usual,), (hard,) = make_suites(["table1"], choice), make_suites(["table1"], replace(choice, level="hard"))
    assert [str(scene) for scene in hard.scenes] == ["push-cube-seen-1000000-hard", "turn-faucet-unseen-1000000-hard"]
    rows = tuple(replace(episode(RIP, 0, True), scene=scene) for scene in (*usual.scenes, *hard.scenes))
    keep(tmp_path, *rows)
    assert read_results(tmp_path).episodes == rows
    assert len(Summary(usual, rows).rows) == len(Summary(hard, rows).rows) == 2


def test_scenes_of_demonstrations_tuning_and_tests_never_meet():
    shown = {first_demonstration_seed(number) + index for number in range(20) for index in range(SEEDS_A_SET)}
    tuned = {scene_seed(seed, index, "tune") for seed in range(50) for index in range(200)}
    tested = {scene_seed(seed, index, "test") for seed in range(50) for index in range(200)}
    assert not (shown | tuned) & tested
    assert not shown & tuned
    (suite,) = make_suites(["table1"], Choice(RIP, num_scenes=3))
    assert set(suite.seeds) <= tested


@pytest.mark.parametrize("name", ["demos", "queries", "dof", "downsampling"])
def test_every_analysis_has_a_table_even_when_half_is_missing(name):
    (suite,) = make_suites([name], Choice(RIP, tasks=["pick-banana"], methods=["rip"], num_scenes=2))
    scene = suite.scenes[0]
    row = episode(suite.variants[0], scene.seed, True)
    row = Episode(**{**vars(row), "scene": scene})
    (table,) = tables(Summary(suite, [row]))
    assert "100" in table.markdown()
    assert table.markdown().count("\n| ") == len(table.rows) + 1  # the rule below the head, and the rows


def test_methods_stand_in_one_order_whichever_was_run_first():
    suite = Suite("table1", ("push-cube",), (Variant("gp"), KAT, RIP), (0,))
    rows = [episode(variant, 0, True) for variant in suite.variants]
    assert [variant.method for variant in Summary(suite, rows).variants] == ["rip", "kat", "gp"]


def test_rip_is_compared_over_the_tasks_that_the_other_method_was_tried_in():
    dp = Variant("dp")
    suite = Suite("table1", ("push-cube", "open-drawer"), (RIP, dp), (0, 1))
    rows = [episode(variant, seed, variant == RIP or seed == 0) for variant in (RIP, dp) for seed in (0, 1)]
    elsewhere = [replace(row, scene=replace(row.scene, task="open-drawer"), success=False) for row in rows[:2]]
    against = tables(Summary(suite, rows + elsewhere))[1]
    assert dict(zip(against.head, against.rows[0], strict=True))["difference"].startswith("+50.0 (")  # not 50 - 50


def test_methods_without_a_task_in_common_are_not_compared():
    suite = Suite("table1", ("push-cube", "open-drawer"), (RIP, KAT), (0,))
    elsewhere = replace(episode(KAT, 0, True), scene=Scene("open-drawer", "seen", 0))
    success, against = tables(Summary(suite, [episode(RIP, 0, True), elsewhere]))
    assert len(success.rows) == 2
    assert against.rows[0][1:] == ("–", "0", "0", "0", "–", "–", "–")


def test_variants_that_differ_in_the_model_only_are_told_apart_everywhere():
    two = [Variant("rip", model=model) for model in ("gpt-4o", "a/b c")]
    assert labels(two) == ["rip (model gpt-4o)", "rip (model a/b c)"]
    assert labels([two[0], KAT]) == ["rip", "kat"]
    for name in (video_file(SCENE, two[0], 0), plan_file(SCENE, two[1])):
        assert name not in (video_file(SCENE, two[1], 0), plan_file(SCENE, two[0]))
        assert re.fullmatch(r"\w+/[\w.-]+", name)
    shown = [replace(variant, demos=demos) for variant in two for demos in (1, 3)]
    suite = Suite("demos", ("push-cube",), tuple(shown), (0,))
    (table,) = tables(Summary(suite, [episode(variant, 0, variant.model == "gpt-4o") for variant in shown]))
    assert [(row[0], row[1][:3].strip()) for row in table.rows] == [(labels(two)[0], "100"), (labels(two)[1], "0.0")]


def test_a_run_remembers_its_suites_and_the_commands_that_made_it(tmp_path):
    one = Suite("table1", ("push-cube",), (RIP,), (1,))
    two = Suite("table1", ("turn-faucet",), (Variant("rip-gauss"),), (1, 2))
    for suite in (one, two):
        a_run(tmp_path, suite, [], [])
    manifest = read_results(tmp_path).manifest
    assert manifest.suites == (one.merged(two),)
    assert manifest.suites[0].tasks == ("push-cube", "turn-faucet")
    assert [one.command for one in manifest.invocations] == [f"rip eval --out {tmp_path.name}"] * 2
    assert json.loads((tmp_path / "run.json").read_text())["invocations"][0]["model"] == "a model"


def a_run(folder, suite: Suite, rows: list[Episode], answers: list[str]) -> None:
    with (
        closing(ResultsStore(folder)) as store,
        store.invocation([suite], ["rip", "eval", "--out", folder.name], "a model"),
    ):
        store.add(*rows)
        store.add(*(Failure(*row.key, "samples", True, False, 0.01, False) for row in rows if not row.success))
    with closing(SampleStore(folder / STORE_FILE)) as samples:
        for sample, text in enumerate(answers):
            samples.write("a model", Query("1 2 ", max_tokens=4), "{}", sample, 0, Answer(text))


def test_runs_are_merged_and_what_two_of_them_did_counts_once(tmp_path):
    one, two, out = (tmp_path / name for name in ("one", "two", "out"))
    ours = Suite("table1", ("push-cube",), (RIP, KAT), (1, 2))
    theirs = Suite("table1", ("push-cube",), (RIP, Variant("gp")), (1, 2))
    a_run(one, ours, [episode(RIP, 1, True), episode(RIP, 2, False)], ["3", "4"])
    a_run(two, theirs, [episode(RIP, 2, True), episode(Variant("gp"), 1, True)], ["3", "4", "5"])
    film = video_file(*episode(RIP, 2, False).key)
    (one / film).parent.mkdir()
    (one / film).write_bytes(b"a film")

    assert [(share.new, share.known) for share in merge([one, two], out)] == [(2, 0), (1, 1)]
    results = read_results(out)
    rows = results.episodes
    assert rows == (episode(RIP, 1, True), episode(RIP, 2, False), episode(Variant("gp"), 1, True))
    assert [failure.key for failure in results.failures] == [rows[1].key]
    assert pq.read_table(out / "episodes.parquet").num_rows == 3
    assert (out / film).read_bytes() == b"a film"
    with closing(SampleStore(out / STORE_FILE)) as store:
        assert store.models()[0].answers == 3
    manifest = results.manifest
    assert manifest.suites == (ours.merged(theirs),)
    assert [command.command for command in manifest.invocations] == ["rip eval --out one", "rip eval --out two"]

    everything = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert [(share.new, share.known) for share in merge([two, one], out)] == [(0, 2), (0, 2)]
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == everything


def test_the_failure_that_was_examined_is_that_of_the_row_that_counts(tmp_path):
    won, lost, out = (tmp_path / name for name in ("won", "lost", "out"))
    suite = Suite("table1", ("push-cube",), (RIP,), (1,))
    a_run(won, suite, [episode(RIP, 1, True)], [])
    a_run(lost, suite, [episode(RIP, 1, False)], [])
    merge([won, lost], out)
    assert read_results(out).episodes[0].success
    assert read_results(out).failures == ()


def test_a_run_that_cannot_be_merged_is_told_before_anything_is_written(tmp_path, capsys):
    one, out = tmp_path / "one", tmp_path / "out"
    a_run(one, Suite("table1", ("push-cube",), (RIP,), (1,)), [episode(RIP, 1, True)], [])
    for runs, words in (([one, tmp_path / "nothing"], "nothing holds no executions"), ([one, out], "itself one")):
        assert main(["merge", *map(str, runs), "--out", str(out)]) != 0
        assert words in capsys.readouterr().err
        assert not out.exists()
    assert main(["merge", str(one), "--out", str(out)]) == 0
    assert str(out / "index.html") in capsys.readouterr().out


def test_what_table1_shows_has_no_section_of_its_own_in_the_report(tmp_path):
    table1, chosen = (Suite(name, ("push-cube",), (RIP,), (1,)) for name in ("table1", "chosen"))
    a_run(tmp_path, chosen, [episode(RIP, 1, True)], [])
    publish(tmp_path)
    assert (tmp_path / "chosen-adaptive.md").exists()
    (tmp_path / "chosen-adaptive.md").unlink()
    a_run(tmp_path, table1, [], [])
    publish(tmp_path)
    assert (tmp_path / "table1-adaptive.md").exists()
    assert not (tmp_path / "chosen-adaptive.md").exists()


def test_a_terminal_that_knows_ascii_only_shows_other_signs(tmp_path):
    folder = tmp_path / "Läufe"
    a_run(folder, Suite("table1", ("push-cube",), (RIP,), (1,)), [episode(RIP, 1, True)], [])
    code = "import sys; from robust_instant_policy.cli import main; sys.exit(main())"
    ascii_only = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-c", code, "report", str(folder)]
    done = subprocess.run(command, env=ascii_only, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert re.search(r"L\?+ufe", done.stdout)


def test_a_table_of_commands_that_is_not_utf_8_is_told_in_one_line(tmp_path, capsys):
    an_export(tmp_path, episode(RIP, 1, True))
    (tmp_path / "run.json").write_bytes('{"suites": "ä"}'.encode("latin-1"))
    assert main(["report", str(tmp_path)]) == 1
    assert "run.json is damaged" in capsys.readouterr().err


def test_objects_of_code_and_downloaded_ones_have_a_table_each(tmp_path):
    for assets, won in (("code", True), ("maniskill", False)):
        scene = Scene("push-cube", "seen", 1, assets)
        suite = Suite("table1", ("push-cube",), (KAT,), (1,), assets=assets)
        a_run(tmp_path, suite, [replace(episode(KAT, 1, won), scene=scene)], [])
    publish(tmp_path)
    assert "**100**" in (tmp_path / "table1-adaptive.md").read_text()
    assert "**0**" in (tmp_path / "table1-adaptive-maniskill.md").read_text()


def test_a_worker_stays_with_its_task_and_others_take_another():
    scenes = [Scene(task, "seen", seed) for task in ("push-cube", "turn-faucet") for seed in (1, 2)]
    agenda = Agenda([SceneWork(scene, (RIP,)) for scene in scenes])
    first = agenda.next("", [])
    second = agenda.next("", [first.scene.task])
    third = agenda.next(first.scene.task, [second.scene.task])
    assert first.scene.task == third.scene.task != second.scene.task
    assert agenda.next(second.scene.task, []).scene.task == second.scene.task
    assert agenda.next("push-cube", []) is None


def test_a_scene_that_ends_every_worker_ends_the_run_in_one_line():
    work = SceneWork(Scene("push-cube", "seen", 1), (RIP,))
    agenda = Agenda([])
    for _ in range(MAX_DEATHS - 1):
        agenda.put_back(work, "signal SIGKILL")
    with pytest.raises(RipError, match=r"push-cube-seen-1 .* SIGKILL"):
        agenda.put_back(work, "signal SIGKILL")


def test_what_a_dead_worker_had_finished_is_not_handed_out_again():
    scene = Scene("push-cube", "seen", 1)
    work = SceneWork(scene, (RIP, KAT), plans=(RIP,))
    won, lost = episode(RIP, 1, True), episode(KAT, 1, False, of=5)
    left = work.without([won, lost])
    assert left.done == {won.key, lost.key}
    assert left.failed == (lost,)
    assert left.plans == (RIP,)
    examined = Analysis(Failure(scene, KAT, 0, "samples", True, False, 0.01, False))
    assert left.without([examined]).failed == ()


def test_a_training_budget_is_part_of_what_was_trained_and_of_nothing_else():
    suite = make_suites(["table1"], Choice(RIP, tasks=["push-cube"], methods=["rip", "kat-dp"], steps=70))[0]
    assert [variant.steps for variant in suite.variants] == [None, 70]


@pytest.mark.parametrize("name", ["results.sqlite", "episodes.parquet", "run.json"])
def test_a_pipe_in_the_place_of_a_result_file_is_told_and_not_waited_for(tmp_path, capsys, name):
    an_export(tmp_path, episode(RIP, 1, True))
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    assert main(["report", str(tmp_path)]) == 1
    assert "named pipe" in capsys.readouterr().err


@pytest.mark.parametrize("field", ["name", "objects", "assets"])
def test_a_run_from_elsewhere_writes_nothing_outside_of_its_folder(tmp_path, capsys, field):
    folder = tmp_path / "run"
    suite = make_suites(["table1"], Choice(RIP))[0]
    an_export(folder, episode(suite.variants[0], suite.seeds[0], True))
    content = json.loads((folder / "run.json").read_text())
    content["suites"] = [json.loads(json.dumps(asdict(suite))) | {field: "../outside"}]
    (folder / "run.json").write_text(json.dumps(content))
    assert main(["report", str(folder)]) == 1
    assert "another folder" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [folder]


def test_rows_whose_names_lead_to_other_folders_are_refused(tmp_path, capsys):
    an_export(tmp_path / "run", episode(RIP, 1, False))
    table = pq.read_table(tmp_path / "run" / "episodes.parquet")
    column = table.schema.get_field_index("task")
    table = table.set_column(column, "task", [["../../../etc/cron"]])
    pq.write_table(table, tmp_path / "run" / "episodes.parquet")
    assert main(["merge", str(tmp_path / "run"), "--out", str(tmp_path / "all")]) == 1
    assert "another folder" in capsys.readouterr().err
    assert not (tmp_path / "all").exists()


@pytest.mark.parametrize("command", ["eval", "merge"])
def test_results_are_not_written_among_demonstrations(workbench, tmp_path, capsys, command):
    demonstrations = workbench / "data" / "push-cube"
    before = sorted(demonstrations.rglob("*"))
    keep(tmp_path / "run", episode(RIP, 0, True))
    words = [str(tmp_path / "run")] if command == "merge" else []
    assert main([command, *words, "--out", str(demonstrations)]) == 1
    assert "holds demonstrations" in capsys.readouterr().err
    assert sorted(demonstrations.rglob("*")) == before


def test_a_tuning_seed_that_reaches_the_test_scenes_is_refused():
    make_suites(["chosen"], Choice(Variant("rip"), ["push-cube"], ["rip"], seed=899, split="tune"))
    with pytest.raises(RipError, match="--split tune"):
        make_suites(["chosen"], Choice(Variant("rip"), ["push-cube"], ["rip"], seed=900, split="tune"))
    make_suites(["chosen"], Choice(Variant("rip"), ["push-cube"], ["rip"], seed=10**30, split="test"))
