"""Whatever comes from outside gives a right value or one line that says what is wrong, within a second."""

from __future__ import annotations

import pytest

from tests.fuzz_targets import CORPUS, TARGETS, fuzz, run

CASES, SEED = 200, 0
KEPT = sorted(CORPUS.glob("*/*"))


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_gives_a_right_value_or_an_error_in_one_line(name):
    fuzz(TARGETS[name], CASES, SEED, lambda case: run(TARGETS[name], case))


@pytest.mark.parametrize("path", KEPT, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_case_that_once_failed_does_so_no_more(path):
    run(TARGETS[path.parent.name], path.read_bytes())
