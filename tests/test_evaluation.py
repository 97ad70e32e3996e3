import pytest

from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.evaluation import Episode, EpisodeTable, success_table, wilson_interval


def episode(method: str, seed: int, success: bool, candidate: int = 0, task: str = "push-cube") -> Episode:
    return Episode(
        task, "seen", method, 10, seed, candidate, success, 1.5, 5.0, 1000, None, "" if success else "missed"
    )


def test_the_wilson_interval_agrees_with_the_published_example():
    # Newcombe 1998, Statistics in Medicine 17, Table I: 81 of 263 gives 0.2553 to 0.3662.
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson_interval(0, 10)[0] == 0
    assert wilson_interval(10, 10)[1] == pytest.approx(1)


def test_more_successes_than_trials_are_refused():
    with pytest.raises(InvalidValueError, match="3 of 2"):
        wilson_interval(3, 2)


def test_rows_survive_on_disk_and_go_on(tmp_path):
    table = EpisodeTable(tmp_path / "out" / "episodes.parquet")
    table.add([episode("kat", 1, True), episode("kat", 1, False, candidate=1)])
    again = EpisodeTable(tmp_path / "out" / "episodes.parquet")
    assert again.rows == table.rows
    again.add([episode("rip", 1, True)])
    assert EpisodeTable(again.path).scenes == {("push-cube", "seen", "kat", 10, 1), ("push-cube", "seen", "rip", 10, 1)}
    assert [path.name for path in again.path.parent.iterdir()] == ["episodes.parquet"]


def test_a_leftover_of_a_killed_write_does_not_matter(tmp_path):
    table = EpisodeTable(tmp_path / "episodes.parquet")
    table.add([episode("rip", 1, True)])
    (tmp_path / "episodes.partial").write_bytes(b"PAR1 half a file")
    again = EpisodeTable(tmp_path / "episodes.parquet")
    again.add([episode("rip", 2, False)])
    assert len(EpisodeTable(again.path).rows) == 2


def test_a_damaged_table_is_refused_in_one_line(tmp_path):
    (tmp_path / "episodes.parquet").write_bytes(b"PAR1 half a file")
    with pytest.raises(DatasetError, match="move it away"):
        EpisodeTable(tmp_path / "episodes.parquet")


def test_the_table_counts_every_execution_and_marks_the_best():
    rows = [episode("rip", seed, True) for seed in range(4)]
    rows += [episode("kat", seed, candidate < 2, candidate) for seed in range(4) for candidate in range(5)]
    text = success_table(rows)
    assert "| rip | 10 | **100%** (51% to 100%, n=4) | 100% |" in text
    assert "| kat | 10 | 40% (22% to 61%, n=20) | 40% |" in text
