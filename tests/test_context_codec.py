"""Reading numbers from what a model says: tolerant of form, never of a doubtful value."""

from __future__ import annotations

import random
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robust_instant_policy.context.codec import (
    read_row,
    read_rows,
    row_pattern,
    rows_pattern,
    write_row,
)

COLUMNS = 10


@pytest.mark.parametrize(
    "text",
    [
        "1 -2 3",
        "  1   -2\t3 \n",
        "1, -2, 3",
        "[1, -2, 3],",
        "(1 −2 3)",
        "1.0 -2.00 3",
        "step 4: 1 -2 3",
        "`1 -2 3`",
        "| 1 -2 3 |",
        "x = [1, -2, +3]",
    ],
)
def test_a_row_is_read_in_any_usual_form(text):
    assert read_row(text, 3).tolist() == [1, -2, 3]


@pytest.mark.parametrize(
    "text",
    [
        "1 -2",
        "1 -2 3 4",
        "1 - 2 3",
        "1 -2 3e1",
        "1 -2 3mm",
        "1 -2 nan",
        "1 -2 inf",
        "1,-2 3",
        "1 2,5",
        "1-2 3",
        "1 2–3",
        "1 -2 3.",  # a number broken off behind its point, or the end of a sentence
        "- 1 2 3",
        "1 2 12345678",
        "1 2 ３",
        "one 1 2 3",
        "",
    ],
)
def test_a_row_in_doubt_is_not_read(text):
    values = read_row(text, 3)
    assert values is None or (text == "1 -2 3." and values.tolist() == [1, -2, 3])


@given(st.lists(st.integers(-9999, 9999), min_size=1, max_size=12))
def test_what_is_written_is_read_back(numbers):
    assert read_row(write_row(numbers), len(numbers)).tolist() == numbers
    assert re.fullmatch(row_pattern([4] * len(numbers)), write_row(numbers))


def test_prose_and_fences_around_rows_do_not_matter():
    text = "Sure! Here are the 2 steps:\n```text\n1 2 3\n4 5 6\n```\nI hope that helps."
    assert read_rows(text, 3).tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_list_of_lists_on_one_line_is_read():
    assert read_rows("[[1, 2, 3], [4, -5, 6]]", 3).tolist() == [[1, 2, 3], [4, -5, 6]]


def test_a_last_row_cut_off_is_left_out():
    assert read_rows("1 2 3\n4 5 6\n7 8", 3).tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_broken_row_in_the_middle_spoils_the_answer():
    assert read_rows("1 2 3\n4 5\n7 8 9", 3) is None
    assert read_rows("For instance:\n1 2 3\nSo here it is:\n4 5 6", 3) is None


def test_the_pattern_of_rows_holds_states_to_zero_and_one():
    pattern = rows_pattern(1, 2, 3, (2,))
    assert re.fullmatch(pattern, "1 -20 1\n300 4 0\n")
    assert not re.fullmatch(pattern, "1 2 3\n")


# Changes of form: the numbers are all there.
def _commas(rows, rng):
    return [row.replace(" ", rng.choice([", ", ","])) for row in rows]


def _brackets(rows, rng):
    left, right = rng.choice(["[]", "()", "{}"])
    return [left + row + right + rng.choice(["", ","]) for row in rows]


def _minus(rows, rng):
    return [row.replace("-", rng.choice("−–－")) for row in rows]


def _decimals(rows, rng):
    return [re.sub(r"(\d+)", r"\1.0", row) for row in rows]


def _fence(rows, rng):
    return ["```", *rows, "```"]


def _prose(rows, rng):
    return [rng.choice(["Here is the answer:", "Of course. The 30 steps are:"]), *rows, "Good luck with step 3!"]


def _labels(rows, rng):
    return [f"step {number}: {row}" for number, row in enumerate(rows)]


def _spaces(rows, rng):
    return [" " * rng.randint(0, 3) + row.replace(" ", " " * rng.randint(1, 3)) + "\t" for row in rows]


def _extra_rows(rows, rng):
    return [*rows, rows[-1]]


FORM = [_commas, _brackets, _minus, _decimals, _fence, _prose, _labels, _spaces, _extra_rows]


# Damage: something is lost or in doubt in one row.
def _lose_a_number(parts, rng):
    del parts[rng.randrange(len(parts))]


def _another_number(parts, rng):
    parts.insert(rng.randrange(len(parts)), "7")


def _no_number(parts, rng):
    parts[rng.randrange(len(parts))] = rng.choice(["nan", "inf", "?", "x", "1e3", "--4", "0x1f", "1_0", "٣", "None"])


def _stuck_together(parts, rng):
    place = rng.randrange(len(parts) - 1)
    parts[place : place + 2] = [parts[place] + parts[place + 1]]


def _decimal_comma(parts, rng):
    place = rng.randrange(len(parts))
    parts[place] += ",5"


def _loose_minus(parts, rng):
    parts.insert(rng.randrange(len(parts)), "-")


DAMAGE = [_lose_a_number, _another_number, _no_number, _stuck_together, _decimal_comma, _loose_minus]


def test_ten_thousand_mutated_answers_give_no_crash_and_no_wrong_value():
    rng = random.Random(0)
    read = 0
    for _ in range(10_000):
        truth = [[rng.randint(-999, 999) for _ in range(COLUMNS)] for _ in range(rng.randint(2, 6))]
        rows = [write_row(row) for row in truth]
        damaged = None
        if rng.random() < 0.5:
            damaged = rng.randrange(len(rows))
            parts = rows[damaged].split(" ")
            rng.choice(DAMAGE)(parts, rng)
            rows[damaged] = " ".join(parts)
        for change in rng.sample(FORM, rng.randint(0, 3)):
            rows = change(rows, rng)
        text = "\n".join(rows)
        early = damaged is None and rng.random() < 0.3  # some answers end too early
        end = rng.randrange(len(text) + 1) if early else len(text)
        values = read_rows(text[:end], COLUMNS)
        if values is None:
            continue
        read += 1
        known = [*truth, truth[-1]] if damaged is None else truth[:damaged]
        assert len(values) <= len(known)
        rows_read = values.tolist()
        if end < len(text):  # the last number may be the beginning of one, which nobody can tell
            *rows_read, last = rows_read
            assert last[:-1] == known[len(rows_read)][:-1]
        assert rows_read == known[: len(rows_read)]
    assert read > 4000


@given(st.text(max_size=300))
def test_any_text_is_read_or_refused_without_an_error(text):
    values = read_rows(text, 3)
    assert values is None or np.isfinite(values).all()
