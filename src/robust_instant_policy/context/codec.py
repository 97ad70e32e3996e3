"""Numbers to text, and text back to numbers; an ambiguous text is refused."""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.geometry import FloatArray

MM = 1000.0  # per metre
MAX_ANSWER_CHARS = 200_000  # of text that is read; a trajectory of one arm has about 1500
ROW_DIGITS = 4  # of a number of a whole trajectory: up to 10 m

_MINUS = str.maketrans(dict.fromkeys("−–—‒﹣－", "-"))
_BRACKETS = str.maketrans(dict.fromkeys("[](){}|", " "))
_NUMBER = r"[+-]?[0-9]{1,6}(?:\.[0-9]{1,6})?"
_SPACED = re.compile(rf"{_NUMBER}(?:\s+{_NUMBER})*")
_COMMAS = re.compile(rf"{_NUMBER}(?:\s*,\s*{_NUMBER})*")
_LABEL = re.compile(r"^[^:=>]*[:=>]\s*(?=[-+0-9])")
_EDGES = " \t\r\n,;.`'\"*"


def millimetres(metres: ArrayLike) -> np.ndarray:
    """Whole millimetres."""
    return np.round(np.asarray(metres, dtype=np.float64) * MM).astype(int)


def write_row(numbers: Sequence[int] | np.ndarray) -> str:
    return " ".join(str(int(number)) for number in numbers)


def row_grammar(digits: Sequence[int]) -> str:
    """GBNF for one line of integers; the j-th has up to ``digits[j]`` digits."""
    return "root ::= " + ' " " '.join(f'"-"? [0-9]{{1,{count}}}' for count in digits) + ' "\\n"'


def row_pattern(digits: Sequence[int]) -> str:
    """The same as a regular expression, without the line's end."""
    return " ".join(f"-?[0-9]{{1,{count}}}" for count in digits)


def rows_grammar(least: int, most: int, columns: int, state_columns: Sequence[int]) -> str:
    """GBNF for ``least`` to ``most`` lines of ``columns`` integers, 0 or 1 in ``state_columns``, and an empty line."""
    row = ' " " '.join("state" if column in state_columns else "number" for column in range(columns))
    return (
        f'root ::= row{{{least},{most}}} "\\n"\nrow ::= {row} "\\n"\n'
        f'number ::= "-"? [0-9]{{1,{ROW_DIGITS}}}\nstate ::= [01]'
    )


def rows_pattern(least: int, most: int, columns: int, state_columns: Sequence[int]) -> str:
    """The same as a regular expression, without the empty line."""
    row = " ".join("[01]" if column in state_columns else f"-?[0-9]{{1,{ROW_DIGITS}}}" for column in range(columns))
    return rf"(?:{row}\n){{{least},{most}}}"


def read_row(text: str, columns: int) -> FloatArray | None:
    """The ``columns`` numbers of one line, or None when the line is anything but exactly these.

    Separators are either all commas or all spaces ("1,5" between spaces may be a decimal comma). Brackets, a label
    before a colon and punctuation at the ends are ignored.
    """
    line = text.translate(_MINUS).translate(_BRACKETS).strip(_EDGES)
    for candidate in (line, _LABEL.sub("", line, count=1).strip(_EDGES)):
        for form, separator in ((_SPACED, None), (_COMMAS, ",")):
            if form.fullmatch(candidate):
                values = [float(part) for part in candidate.split(separator)]
                if len(values) == columns:
                    return np.array(values)
    return None


def read_rows(text: str, columns: int) -> FloatArray | None:
    """The rows ``(N, columns)`` of numbers in an answer, or None when one of them cannot be read for certain.

    None, too, for a text of more than `MAX_ANSWER_CHARS`.

    Prose and code fences may surround the rows, and a last row that was cut off is left out. An answer is refused where
    a line before or between rows looks like a malformed row (a step would be missing), and where words stand between
    rows (those before them may be an example).
    """
    if len(text) > MAX_ANSWER_CHARS:
        return None
    rows: list[FloatArray] = []
    broken = False
    for line in _lines(text):
        row = read_row(line, columns)
        if row is None:
            broken = broken or _may_be_a_row(line, columns, follows_one=bool(rows))
            broken = broken or (bool(rows) and re.search(r"[^\W\d_]{2}", line) is not None)
        elif broken:
            return None
        else:
            rows.append(row)
    return np.stack(rows) if rows else None


def _may_be_a_row(line: str, columns: int, follows_one: bool) -> bool:
    numbers = len(re.findall(r"\d+", line))
    if follows_one or not re.search(r"[^\W\d_]", line):
        return numbers > 0
    return numbers >= max(2, columns // 2)  # "the 30 steps are:" may stand before the rows


def _lines(text: str) -> list[str]:
    # A list of lists on one line: each inner list is a row.
    flat = re.sub(r"\]\s*,?\s*\[", "]\n[", text) if re.search(r"\]\s*,?\s*\[[^\[\]]*[0-9\s]+\]", text) else text
    return [line for line in re.split(r"[\n;]", flat) if line.strip()]
