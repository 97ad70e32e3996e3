"""The sample store: nothing is lost, no answer is asked for twice, and a replay equals the recording."""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import signal
import sqlite3
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from robust_instant_policy.cli import main
from robust_instant_policy.errors import ModelError, UsageError
from robust_instant_policy.llm import Listener, RecordedModel, ReplayedModel, SampleStore, Sampling, connect
from robust_instant_policy.llm.model import NOBODY, Tally
from robust_instant_policy.query import Answer, Query
from tests.stand_in_server import NOT_FOUND, Request, Response, StandInServer, chat

QUERIES = [Query(f"{number} 1\n", max_tokens=8, grammar="root ::= [0-9]", stop=("\n",)) for number in range(3)]


class CountingModel:
    """Answers each sample with its number; every third answer is no number."""

    name = "counting"
    context_length = None

    def __init__(self) -> None:
        self.asked = 0

    def count_tokens(self, text: str) -> int:
        return len(text)

    def sample(self, queries: Sequence[Query], sampling: Sampling, listener: Listener = NOBODY):
        tally = Tally(len(queries), sampling, listener)
        for index in range(len(queries)):
            while missing := tally.missing(index):
                self.asked += 1
                text = "what?" if self.asked % 3 == 0 else f"{missing[0]}"
                tally.add(index, missing[0], Answer(text, 10, 4, 2, 0.125))
        return tally.answers()

    def close(self) -> None: ...


def is_number(_: int, text: str) -> bool:
    return text.isdigit()


def test_what_is_replayed_equals_what_was_recorded(tmp_path):
    store = SampleStore(tmp_path / "samples.sqlite")
    asked = QUERIES, Sampling(4, temperature=0.5, seed=3), Listener(is_number)
    recorded = RecordedModel(CountingModel(), store).sample(*asked)
    store.close()
    replayed = ReplayedModel(SampleStore(tmp_path / "samples.sqlite"), "counting").sample(*asked)
    assert [[(a.text, a.prompt_tokens, a.seconds) for a in own] for own in replayed] == [
        [(a.text, a.prompt_tokens, a.seconds) for a in own] for own in recorded
    ]
    assert all(answer.replayed for own in replayed for answer in own)


def test_the_model_is_not_asked_twice_for_the_same_sample(tmp_path):
    model = CountingModel()
    recorded = RecordedModel(model, SampleStore(tmp_path / "s.sqlite"))
    recorded.sample(QUERIES, Sampling(3, temperature=0.5), Listener(accept=is_number))
    asked = model.asked
    recorded.sample(QUERIES, Sampling(3, temperature=0.5), Listener(accept=is_number))
    assert model.asked == asked
    more = recorded.sample(QUERIES, Sampling(2, temperature=0.5, first_index=3), Listener(accept=is_number))
    assert [[answer.text for answer in own] for own in more] == [["3", "4"]] * 3
    recorded.sample(QUERIES, Sampling(3, temperature=0.6), Listener(accept=is_number))
    recorded.sample(QUERIES, Sampling(3, temperature=0.5, seed=1), Listener(accept=is_number))
    assert model.asked > asked


def test_answers_that_were_refused_are_kept_too(tmp_path):
    store = SampleStore(tmp_path / "s.sqlite")
    RecordedModel(CountingModel(), store).sample(QUERIES, Sampling(4, temperature=0.5), Listener(accept=is_number))
    (count,) = store.models()
    assert (count.model, count.queries) == ("counting", 3)
    assert count.answers > 12
    assert count.prompt_tokens == 10 * count.answers
    text = io.StringIO()
    assert store.export(text) == count.answers
    rows = [json.loads(line) for line in text.getvalue().splitlines()]
    assert {"what?", "0"} <= {row["answer"] for row in rows}
    assert rows[0]["prompt"] in {query.text for query in QUERIES}
    table = io.StringIO()
    store.export(table, "csv")
    assert table.getvalue().count("what?") == sum(row["answer"] == "what?" for row in rows)


def test_a_replay_of_what_was_never_asked_says_so(tmp_path):
    store = SampleStore(tmp_path / "s.sqlite")
    RecordedModel(CountingModel(), store).sample(QUERIES[:1], Sampling(3, temperature=0.5))
    with pytest.raises(ModelError, match="lacks the answers to 2 of 3 prompts"):
        ReplayedModel(store, "counting").sample(QUERIES, Sampling(3, temperature=0.5))
    with pytest.raises(ModelError, match="it has: counting"):
        ReplayedModel(store, "gpt-4o")


def test_a_model_file_that_is_gone_is_replayed_by_its_name(tmp_path):
    class File(CountingModel):
        name = "qwen@0123abcd"

    store = SampleStore(tmp_path / "s.sqlite")
    RecordedModel(File(), store).sample(QUERIES, Sampling(3, temperature=0.5))
    assert ReplayedModel(store, "qwen").name == "qwen@0123abcd"


def test_samples_that_never_came_are_missing_again_in_the_replay(tmp_path):
    store = SampleStore(tmp_path / "s.sqlite")
    asked = QUERIES, Sampling(4, temperature=0.5), Listener(lambda query, text: text in ("1", "2"))
    recorded = RecordedModel(CountingModel(), store).sample(*asked)
    assert [len(own) for own in recorded] == [2, 2, 2]
    replayed = ReplayedModel(store, "counting").sample(*asked)
    assert [[a.text for a in own] for own in replayed] == [[a.text for a in own] for own in recorded]


def test_a_sample_that_was_kept_before_stays_what_it_was(tmp_path):
    class Fickle(CountingModel):
        def sample(self, queries, sampling, listener=NOBODY):
            self.asked += 1
            answers = [Answer(f"{self.asked}") for _ in sampling.indices]
            for number, answer in zip(sampling.indices, answers, strict=True):
                listener.on_answer(0, number, 0, answer, True)
            return [answers]

    store = SampleStore(tmp_path / "s.sqlite")
    recorded = RecordedModel(Fickle(), store)
    recorded.sample(QUERIES[:1], Sampling(3, temperature=0.5))
    five = recorded.sample(QUERIES[:1], Sampling(5, temperature=0.5))
    assert [answer.text for answer in five[0]] == ["1", "1", "1", "2", "2"]
    replayed = ReplayedModel(store, "counting").sample(QUERIES[:1], Sampling(5, temperature=0.5))
    assert [answer.text for answer in replayed[0]] == ["1", "1", "1", "2", "2"]


def test_a_plan_that_failed_fails_in_the_same_words_when_replayed(tmp_path):
    class Silent(CountingModel):
        def sample(self, queries, sampling, listener=NOBODY):
            raise ModelError("silent at http://there gave no answer within 3 s")

    store = SampleStore(tmp_path / "s.sqlite")
    asked = QUERIES, Sampling(3, temperature=0.5, deadline_s=3.0)
    words = set()
    for make in (lambda: RecordedModel(Silent(), store), lambda: ReplayedModel(store, "counting")):
        with pytest.raises(ModelError) as caught:
            make().sample(*asked)
        words.add(str(caught.value))
    assert words == {"silent at http://there gave no answer within 3 s"}
    # What failed is asked again where there is a model, and its answers then are what counts.
    RecordedModel(CountingModel(), store).sample(*asked)
    assert len(ReplayedModel(store, "counting").sample(*asked)[0]) == 3


def test_a_sample_that_missed_the_deadline_is_asked_for_again(tmp_path):
    """The server is slow with one of two prompts; what it answers later is kept, and a replay has it."""
    pause_s = 30.0

    def answer(request: Request) -> Response:
        if not request.path.endswith("/completions"):
            return NOT_FOUND
        is_slow = request.body["messages"][-1]["content"] == QUERIES[1].text
        return chat("4", "4", after_s=pause_s if is_slow else 0.0)

    server = StandInServer(answer)
    store = SampleStore(tmp_path / "s.sqlite")

    def ask(deadline_s: float) -> list[int]:
        model = RecordedModel(connect(f"{server.url}#m"), store)
        answers = model.sample(QUERIES[:2], Sampling(2, 0.5, deadline_s=deadline_s), Listener(is_number))
        return [len(own) for own in answers]

    try:
        assert ask(1.5) == [2, 0]
        assert [len(own) for own in ReplayedModel(store, "m").sample(QUERIES[:2], Sampling(2, 0.5))] == [2, 0]
        pause_s = 0.0
        assert ask(20) == [2, 2]
        asked = len(server.asked)
        assert ask(20) == [2, 2]
        assert len(server.asked) == asked
    finally:
        server.close()
    replayed = ReplayedModel(store, "m").sample(QUERIES[:2], Sampling(2, 0.5), Listener(is_number))
    assert [[answer.text for answer in own] for own in replayed] == [["4", "4"]] * 2


class Sometimes(CountingModel):
    """Answers nothing in time but the texts in ``ready``, as the first attempt at sample 0."""

    def __init__(self, *ready: str) -> None:
        super().__init__()
        self.ready = ready

    def sample(self, queries, sampling, listener=NOBODY):
        self.asked += 1
        tally = Tally(len(queries), sampling, listener)
        for text in self.ready:
            tally.add(0, 0, Answer(text))
        return tally.answers()


def test_what_came_before_the_deadline_is_kept_and_the_rest_is_asked_for_again(tmp_path):
    store = SampleStore(tmp_path / "s.sqlite")
    asked = QUERIES[:1], Sampling(2, temperature=0.5), Listener(is_number)
    assert RecordedModel(Sometimes("what?"), store).sample(*asked) == [[]]
    assert ReplayedModel(store, "counting").sample(*asked) == [[]]
    # Asked again, a server that does not honour seeds says something else; no answer hides another.
    answers = RecordedModel(Sometimes("7"), store).sample(*asked)
    assert [answer.text for answer in answers[0]] == ["7"]
    assert [answer.text for answer in ReplayedModel(store, "counting").sample(*asked)[0]] == ["7"]
    assert [None if a is None else a.text for a in store.read("counting", QUERIES[0], _settings_of(store), 0)] == [
        "what?", "7", None,
    ]  # fmt: skip


def _settings_of(store: SampleStore) -> str:
    text = io.StringIO()
    store.export(text)
    return json.loads(text.getvalue().splitlines()[0])["settings"]


def test_a_sample_that_was_refused_to_the_end_is_not_asked_for_again(tmp_path):
    store, model = SampleStore(tmp_path / "s.sqlite"), CountingModel()
    asked = QUERIES[:1], Sampling(1, temperature=0.5), Listener(lambda query, text: None)
    recorded = RecordedModel(model, store)
    assert recorded.sample(*asked) == [[]]
    count = model.asked
    assert recorded.sample(*asked) == [[]]
    assert model.asked == count


def test_each_answer_is_read_once_and_carries_what_it_says(tmp_path):
    store, model = SampleStore(tmp_path / "s.sqlite"), CountingModel()
    read: list[str] = []

    def number(_: int, text: str) -> int | None:
        read.append(text)
        return int(text) if text.isdigit() else None

    asked = QUERIES, Sampling(4, temperature=0.5), Listener(number)
    recorded = RecordedModel(model, store).sample(*asked)
    assert [[answer.value for answer in own] for own in recorded] == [[0, 1, 2, 3]] * 3
    assert len(read) <= model.asked
    assert [[answer.value for answer in own] for own in ReplayedModel(store, "counting").sample(*asked)] == [
        [0, 1, 2, 3]
    ] * 3


def test_a_file_that_is_no_store_is_refused_in_one_line(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("these are my notes, not a database " * 100)
    with pytest.raises(UsageError, match="is not a sample store"):
        SampleStore(path)
    assert path.read_text().startswith("these are my notes")


def test_a_store_with_tables_of_another_kind_or_damaged_pages_is_told_in_one_line(tmp_path, capsys):
    with sqlite3.connect(tmp_path / "other.sqlite") as other:
        other.execute("CREATE TABLE answers (x)")
    assert main(["samples", str(tmp_path / "other.sqlite")]) == 1
    store = SampleStore(tmp_path / "damaged.sqlite")
    store.write("a model", QUERIES[0], "{}", 0, 0, Answer("1 2 3"))
    store.close()
    content = (tmp_path / "damaged.sqlite").read_bytes()
    (tmp_path / "damaged.sqlite").write_bytes(content[:4096] + b"\xff" * (len(content) - 4096))
    assert main(["samples", str(tmp_path / "damaged.sqlite")]) in (1, 2)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert not any("unexpected" in line for line in lines)


def _write_for_ever(path: Path, name: str) -> None:
    store = SampleStore(path)
    number = 0
    while True:
        query = Query(f"{name} {number}", max_tokens=4)
        store.write(name, query, "{}", 0, 0, Answer(f"{number}"))
        number += 1


def test_two_processes_write_at_once_and_a_kill_leaves_the_file_whole(tmp_path):
    path = tmp_path / "s.sqlite"
    SampleStore(path).close()
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=_write_for_ever, args=(path, name)) for name in ("a", "b")]
    for writer in writers:
        writer.start()
    store = SampleStore(path)
    limit = time.monotonic() + 60
    while time.monotonic() < limit:
        counts = {count.model: count.answers for count in store.models()}
        if min(counts.get("a", 0), counts.get("b", 0)) > 20:
            break
        time.sleep(0.05)
    for writer in writers:
        os.kill(writer.pid, signal.SIGKILL)
        writer.join()
    assert sqlite3.connect(path).execute("PRAGMA integrity_check").fetchone() == ("ok",)
    for count in SampleStore(path).models():
        assert count.answers > 20
        for number in range(count.answers):  # each that was written, whole, and none skipped
            (answer,) = SampleStore.read(store, count.model, Query(f"{count.model} {number}", max_tokens=4), "{}", 0)
            assert answer is not None
            assert answer.text == f"{number}"
