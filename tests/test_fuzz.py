"""Whatever comes from outside gives a right value or one line that says what is wrong, within a second."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, given, seed, settings

from tests.fuzz_targets import CORPUS, TARGETS, Case, run

CASES, SEED = 200, 0
KEPT = sorted(CORPUS.glob("*/*"))


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_gives_a_right_value_or_an_error_in_one_line(name):
    target = TARGETS[name]

    @seed(SEED)
    @settings(
        max_examples=CASES,
        deadline=None,
        database=None,
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
    @given(case=target.cases)
    def check(case: Case) -> None:
        run(target, case)

    check()


@pytest.mark.parametrize("path", KEPT, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_case_that_once_failed_does_so_no_more(path):
    run(TARGETS[path.parent.name], path.read_bytes())
