"""Robots that ask a running server get a chunk of actions, or are told in one line why not."""

import base64
import contextlib
import socket
import threading
import time

import httpx2 as httpx
import msgpack
import numpy as np
import psutil
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from robust_instant_policy.checks import is_trusted
from robust_instant_policy.cli import main
from robust_instant_policy.datasets.images import encode_depth, encode_image
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.network import checked_key, listen
from robust_instant_policy.policies import Neighbours
from robust_instant_policy.serving.messages import pack, unpack
from robust_instant_policy.serving.planner import Planner
from robust_instant_policy.serving.server import serve

KEY = "a-key-for-tests"


class SlowNeighbours(Neighbours):
    """Plans when ``may_go`` is set, and reports progress until then."""

    def __init__(self):
        super().__init__()
        self.may_go = threading.Event()
        self.may_go.set()

    def plan(self, observation):
        for step in range(1000):
            self.progress("language model", step, 1000)
            if self.may_go.wait(0.01):
                break
        return super().plan(observation)


class Running:
    def __init__(self, context, key=None, min_confidence=0.0):
        self.policy = SlowNeighbours().fit_context(context)
        self.planner = Planner(self.policy, min_confidence)
        listener = listen("127.0.0.1", 0)
        self.address = f"127.0.0.1:{listener.getsockname()[1]}"
        started = []
        self.thread = threading.Thread(target=serve, args=(self.planner, listener, key, False, started.append))
        self.thread.start()
        while not (started and started[0].started):
            time.sleep(0.01)
        self.server = started[0]

    def connect(self, key=None, **options):
        headers = {"Authorization": f"Api-Key {key}"} if key else None
        return connect(f"ws://{self.address}", additional_headers=headers, max_size=None, compression=None, **options)

    def http(self, method, path, **options):
        return httpx.request(method, f"http://{self.address}{path}", timeout=30, **options)

    def close(self):
        self.server.should_exit = True
        self.thread.join(20)
        assert not self.thread.is_alive()


@pytest.fixture(scope="module")
def scene(workbench):
    return Observation.load(workbench / "observation.npz")


@pytest.fixture(scope="module")
def running(context):
    server = Running(context)
    yield server
    server.close()


def as_map(observation, **others):
    return {**{name: getattr(observation, name) for name in ("rgb", "depth", "intrinsics", "camera_pose")}, **others}


def as_json(observation, **others):
    depth, unit = encode_depth(observation.depth)
    return {
        "rgb": base64.b64encode(encode_image(observation.rgb)).decode(),
        "depth": base64.b64encode(depth).decode(),
        "depth_unit_m": unit,
        "intrinsics": observation.intrinsics.tolist(),
        "camera_pose": observation.camera_pose.tolist(),
        **others,
    }


def until(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def refusal(client):
    """The text message of an error; the connection is then closed as openpi's server closes it."""
    text = client.recv(timeout=30)
    assert isinstance(text, str)
    with pytest.raises(ConnectionClosed) as closed:
        client.recv(timeout=30)
    assert closed.value.rcvd.code == 1011
    return text


# ---- openpi's protocol


def test_a_client_gets_metadata_then_one_chunk_for_each_observation(running, scene):
    with running.connect() as client:
        metadata = unpack(client.recv(timeout=30))
        assert (metadata["task"], metadata["num_demonstrations"]) == ("push-cube", 5)
        for content in (
            as_map(scene, prompt="push the cube"),
            {f"observation/{name}": value for name, value in as_map(scene).items()},
        ):
            client.send(pack(content))
            answer = unpack(client.recv(timeout=30))
            assert answer["actions"].shape == (30, len(metadata["actions"]))
            assert answer["poses"].shape == (30, 1, 4, 4)
            assert answer["server_timing"]["infer_ms"] > 0
        expected = running.policy.plan(scene)
        np.testing.assert_allclose(answer["actions"], expected.trajectory.actions)
        assert answer["confidence"] == expected.confidence
        np.testing.assert_allclose(
            answer["poses"][:, 0, :3, 3], answer["actions"][:, 3:9].reshape(-1, 2, 3).mean(axis=1), atol=1e-3
        )


def test_depth_in_whole_numbers_needs_its_unit(running, scene):
    millimetres = np.nan_to_num(scene.depth * 1000).round().astype(np.uint16)
    with running.connect() as client:
        client.recv(timeout=30)
        client.send(pack(as_map(scene) | {"depth": millimetres, "depth_unit_m": 0.001}))
        assert "actions" in unpack(client.recv(timeout=30))
        client.send(pack(as_map(scene) | {"depth": millimetres}))
        assert "depth_unit_m" in refusal(client)


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (b"\xc1 not msgpack", "not msgpack"),
        (b"", "not msgpack"),
        (b"\x91" * 100_000, "not msgpack"),
        (msgpack.packb([1, 2]), "must be a map"),
        (msgpack.packb({"prompt": "push"}), "lacks rgb, depth"),
        (msgpack.packb({"rgb": {b"__ndarray__": True, b"data": b"xx", b"dtype": "|O", b"shape": [1]}}), "real numbers"),
        (
            msgpack.packb({"rgb": {b"__ndarray__": True, b"data": b"x", b"dtype": "<f8", b"shape": [1 << 40]}}),
            "do not fill",
        ),
        (msgpack.packb({"depth": {b"__npgeneric__": True, b"data": 300, b"dtype": "|i1"}}), "not msgpack"),
        ("text", "binary"),
    ],
    ids=["noise", "nothing", "nesting", "list", "no image", "objects", "too short", "too large a number", "text"],
)
def test_garbage_gets_one_line_and_the_next_client_its_plan(running, scene, message, said):
    with running.connect() as client:
        client.recv(timeout=30)
        client.send(message)
        text = refusal(client)
    assert said in text
    assert len(text.splitlines()) == 1
    with running.connect() as client:
        client.recv(timeout=30)
        client.send(pack(as_map(scene)))
        assert "actions" in unpack(client.recv(timeout=30))


def test_an_oversized_message_is_refused_and_a_huge_one_is_not_even_read(running):
    with running.connect() as client:
        client.recv(timeout=30)
        client.send(bytes(65 << 20))
        assert "larger than 64 MiB" in refusal(client)
    with running.connect() as client:
        client.recv(timeout=30)
        with contextlib.suppress(ConnectionClosed):  # the server does not wait for the end of it
            client.send(bytes(81 << 20))
        with pytest.raises(ConnectionClosed):
            client.recv(timeout=30)
    assert running.http("GET", "/healthz").status_code == 200


def test_a_plan_that_is_not_to_be_trusted_is_an_error_with_its_reason(context, scene):
    server = Running(context, min_confidence=1.0)
    try:
        for seen, reason in (
            (scene, "confidence"),
            (Observation(scene.rgb, scene.depth * 5, scene.intrinsics, scene.camera_pose), ""),  # another unit
        ):
            with server.connect() as client:
                client.recv(timeout=30)
                client.send(pack(as_map(seen)))
                text = refusal(client)
            assert reason in text
            assert "Traceback" not in text
            answer = server.http("POST", "/plans?wait=30", json=as_json(seen)).json()
            assert answer["state"] == "refused"
            assert reason in answer["error"]
            assert "actions" not in answer
    finally:
        server.close()


def test_a_client_that_hangs_up_cancels_its_plan_and_keep_alive_goes_on_during_one(running, scene):
    running.policy.may_go.clear()
    try:
        with running.connect() as client, running.connect() as other:
            for one in (client, other):
                one.recv(timeout=30)
                one.send(pack(as_map(scene)))
            until(lambda: len(running.planner.queue) == 2 and running.planner.queue[0].state == "planning")
            assert client.ping().wait(10)  # the server answers while it plans
            told = running.http("GET", "/plans").json()
            assert [job["state"] for job in told] == ["planning", "queued"]
            assert told[0]["stage"] == "language model"
            client.close()
            until(lambda: len(running.planner.queue) == 1)
            running.policy.may_go.set()
            assert "actions" in unpack(other.recv(timeout=30))
    finally:
        running.policy.may_go.set()


def test_a_robot_has_one_plan_at_a_time(running, scene):
    running.policy.may_go.clear()
    try:
        job = running.http("POST", "/plans", json=as_json(scene, robot="left arm")).json()
        with running.connect() as client:
            client.recv(timeout=30)
            client.send(pack(as_map(scene, robot="left arm")))
            assert "already has a plan" in refusal(client)
        assert running.http("POST", "/plans", json=as_json(scene, robot="left arm")).status_code == 429
        with running.connect() as client:  # two observations at once
            client.recv(timeout=30)
            client.send(pack(as_map(scene)))
            client.send(pack(as_map(scene)))
            assert "under way" in refusal(client)
        assert running.http("DELETE", f"/plans/{job['id']}").json()["state"] in ("planning", "cancelled")
        until(lambda: running.http("GET", f"/plans/{job['id']}").json()["state"] == "cancelled")
        until(lambda: not running.planner.queue)
    finally:
        running.policy.may_go.set()


# ---- HTTP


def test_http_gives_the_same_plan_and_documents_itself(running, scene):
    assert running.http("GET", "/healthz").text == "OK\n"
    assert "/plans" in running.http("GET", "/openapi.json").json()["paths"]
    assert running.http("GET", "/docs").status_code == 200
    job = running.http("POST", "/plans", json=as_json(scene))
    assert job.status_code == 201
    answer = running.http("GET", f"/plans/{job.json()['id']}?wait=30").json()
    assert answer["state"] == "done"
    assert "stage" not in answer
    expected = running.policy.plan(scene)  # depth came in steps of 0.1 mm
    np.testing.assert_allclose(answer["actions"], expected.trajectory.actions, atol=2e-3)
    assert answer["server_timing"]["infer_ms"] > 0


@pytest.mark.parametrize(
    ("content", "status", "said"),
    [
        ({}, 422, "rgb"),
        ({"rgb": "%%%"}, 422, "base64"),
        ({"rgb": base64.b64encode(b"no image").decode()}, 422, "PNG"),
        ({"depth_unit_m": -1}, 422, "depth_unit_m"),
        ({"intrinsics": [[1, 2]]}, 422, "intrinsics"),
    ],
)
def test_http_says_in_one_line_what_is_wrong(running, scene, content, status, said):
    answer = running.http("POST", "/plans", json=as_json(scene) | content if content else {})
    assert answer.status_code == status
    assert said in answer.json()["error"]
    assert "\n" not in answer.json()["error"]


def test_http_bodies_and_unknown_plans_have_limits(running):
    def chunks():
        for _ in range(70):
            yield bytes(1 << 20)

    assert running.http("POST", "/plans", content=chunks()).status_code == 413
    assert running.http("POST", "/plans", content=b"{").status_code == 422
    damaged = running.http("POST", "/plans", content=b"{", headers={"Content-Type": "application/json"})
    assert "the body is not JSON" in damaged.json()["error"]
    for method, path, status in (("GET", "/plans/none", 404), ("GET", "/nowhere", 404), ("PUT", "/plans", 405)):
        answer = running.http(method, path)
        assert answer.status_code == status
        assert set(answer.json()) == {"error"}


def test_an_unexpected_error_is_logged_once_with_its_traceback_and_told_in_one_line(
    running, scene, monkeypatch, caplog
):
    monkeypatch.setattr(running.policy, "plan", lambda observation: 1 / 0)
    with running.connect() as client:
        client.recv(timeout=30)
        client.send(pack(as_map(scene)))
        assert refusal(client) == "unexpected ZeroDivisionError in the server"
    assert caplog.text.count("Traceback") == caplog.text.count("ZeroDivisionError: ") == 1
    caplog.clear()
    answer = running.http("POST", "/plans?wait=30", json=as_json(scene)).json()
    assert (answer["state"], answer["error"]) == ("failed", "unexpected ZeroDivisionError in the server")
    assert caplog.text.count("Traceback") == 1


def test_a_queued_plan_of_a_websocket_that_is_cancelled_over_http_is_told(running, scene):
    running.policy.may_go.clear()
    try:
        first = running.http("POST", "/plans", json=as_json(scene)).json()
        with running.connect() as client:
            client.recv(timeout=30)
            client.send(pack(as_map(scene)))
            until(lambda: len(running.planner.queue) == 2)
            running.http("DELETE", f"/plans/{running.planner.queue[1].id}")
            assert refusal(client) == "the plan was cancelled"
        running.http("DELETE", f"/plans/{first['id']}")
        until(lambda: not running.planner.queue)
    finally:
        running.policy.may_go.set()


# ---- who may ask


def test_a_server_that_others_reach_needs_a_key_which_is_never_shown(context, scene, monkeypatch, capfd):
    with pytest.raises(UsageError, match="RIP_SERVE_KEY"):
        checked_key("0.0.0.0", None)
    monkeypatch.delenv("RIP_SERVE_KEY", raising=False)
    assert main(["serve", "--demos", "nowhere", "--host", "0.0.0.0", "--port", "0"]) == 2
    server = Running(context, key=KEY)
    try:
        for wrong in (None, "another", "ключ"):
            header = {"Authorization": f"Api-Key {wrong}".encode()} if wrong else {}
            assert server.http("GET", "/plans", headers=header).status_code == 401
            assert server.http("POST", "/plans", headers=header, json=as_json(scene)).status_code == 401
        for wrong in (None, "another"):
            with pytest.raises(InvalidStatus) as refused:
                server.connect(wrong)
            assert refused.value.response.status_code == 401
        assert server.http("GET", "/healthz").status_code == 200
        with server.connect(KEY) as client:
            client.recv(timeout=30)
            client.send(pack(as_map(scene)))
            assert "actions" in unpack(client.recv(timeout=30))
    finally:
        server.close()
    assert KEY not in "".join(capfd.readouterr())


def test_a_key_may_hold_any_letters_and_spaces_around_it_do_not_count(context):
    server = Running(context, key=" ключ ")
    try:
        assert server.http("GET", "/plans", headers={"Authorization": "Api-Key ключ".encode()}).status_code == 200
        assert server.http("GET", "/plans", headers={"Authorization": "Api-Key ключи".encode()}).status_code == 401
    finally:
        server.close()


def test_pages_of_other_sites_may_not_use_a_server_on_this_machine(running):
    with pytest.raises(InvalidStatus) as refused:
        running.connect(origin="http://example.org")
    assert refused.value.response.status_code == 403
    assert running.http("GET", "/plans", headers={"Host": "example.org"}).status_code == 403
    for header in ({"Host": "["}, {"Origin": "http://["}):
        answer = running.http("GET", "/healthz", headers=header)
        assert answer.status_code == 400
        assert "no address" in answer.json()["error"]


def test_a_plan_with_confidence_0_is_refused_by_every_limit():
    for confidence in (None, 0.0, float("nan")):
        assert not is_trusted(confidence, 0.0)
    assert is_trusted(0.5, 0.5)
    assert not is_trusted(0.5, 0.51)


def test_a_port_in_use_is_said(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["serve", "--demos", "nowhere", "--port", port]) == 2
    assert "choose another" in capsys.readouterr().err


def test_many_clients_come_and_go_and_leave_nothing_behind(running, scene):
    message = pack(as_map(scene))
    garbage = [b"\xc1", b"", pack({"rgb": 1}), pack(as_map(scene) | {"depth": np.zeros(3)})]
    failures = []

    def client(number):
        try:
            for turn in range(3):
                with running.connect() as socket:
                    socket.recv(timeout=60)
                    socket.send(garbage[number % 4] if turn == 1 else message)
                    if turn == 2 and number % 2:
                        continue  # hangs up before the answer
                    answer = socket.recv(timeout=60)
                    assert isinstance(answer, str) == (turn == 1)
        except Exception as error:
            failures.append(error)

    def round_of_clients():
        threads = [threading.Thread(target=client, args=(number,)) for number in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(90)
        until(lambda: not running.planner.queue)

    process, pool = psutil.Process(), 8  # threads that read messages; more would be left by clients
    round_of_clients()
    before = process.num_threads(), process.num_fds()
    round_of_clients()
    until(lambda: process.num_fds() <= before[1])
    assert not failures
    assert process.num_threads() < before[0] + pool
