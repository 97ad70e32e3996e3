"""A real HTTP server on the loopback address that answers as a script says; it keeps the requests it got."""

from __future__ import annotations

import json
import ssl
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Request:
    method: str
    path: str
    body: Any
    headers: dict[str, str]


@dataclass(frozen=True)
class Response:
    body: Any = None  # bytes are sent as they are, everything else as JSON
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    after_s: float = 0.0


Script = Callable[[Request], Response]
NOT_FOUND = Response({"detail": "Not Found"}, 404)


class StandInServer:
    """``asked`` holds the requests for answers, ``requests`` all of them."""

    def __init__(self, script: Script, certificate: Path | None = None):
        self.requests: list[Request] = []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                self.answer(None)

            def do_POST(self) -> None:
                self.answer(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))

            def answer(self, body: Any) -> None:
                request = Request(self.command, self.path, body, dict(self.headers))
                outer.requests.append(request)
                response = script(request)
                time.sleep(response.after_s)
                content = response.body if isinstance(response.body, bytes) else json.dumps(response.body).encode()
                self.send_response(response.status)
                for name, value in response.headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, *_: object) -> None: ...

        class Server(ThreadingHTTPServer):
            daemon_threads = True
            request_queue_size = 128

            def handle_error(self, *_: object) -> None: ...  # clients that hang up

        self._server = Server(("127.0.0.1", 0), Handler)
        self.port = self._server.server_address[1]
        if certificate is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(certificate)
            self._server.socket = context.wrap_socket(self._server.socket, server_side=True)
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        self.url = f"{'http' if certificate is None else 'https'}://127.0.0.1:{self.port}/v1"

    @property
    def asked(self) -> list[Request]:
        return [request for request in self.requests if request.path.endswith("/completions")]

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


def chat(*texts: str | None, finish: str = "stop", usage: Any = None, after_s: float = 0.0, **message: Any) -> Response:
    choices = [
        {
            "index": index,
            "message": {"role": "assistant", "content": text, **message},
            "finish_reason": finish,
            "logprobs": None,
        }
        for index, text in enumerate(texts)
    ]
    body = {"id": "chatcmpl-1", "object": "chat.completion", "choices": choices, "usage": usage}
    return Response(body, after_s=after_s)


def completion(*texts: str, finish: str = "stop", usage: Any = None) -> Response:
    choices = [
        {"index": index, "text": text, "finish_reason": finish, "logprobs": None} for index, text in enumerate(texts)
    ]
    return Response({"id": "cmpl-1", "object": "text_completion", "choices": choices, "usage": usage})


def error(message: str, status: int = 400, param: str | None = None) -> Response:
    """In OpenAI's form."""
    return Response(
        {"error": {"message": message, "type": "invalid_request_error", "param": param, "code": None}}, status
    )
