"""Sockets to listen on, loopback addresses, and a small HTTP server."""

import contextlib
import ipaddress
import socket
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from robust_instant_policy.errors import UsageError

KEY_VARIABLE = "RIP_SERVE_KEY"


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes a free one. Raises `UsageError`."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host.strip("[]"), port), family=family, backlog=128)
    except OverflowError:
        reason = "ports are 0 to 65535"
    except OSError as error:
        reason = str(error.strerror).partition(" (while")[0]
    raise UsageError(f"cannot listen at {host} port {port} ({reason}); choose another with --host, --port")


def checked_key(host: str, key: str | None) -> str | None:
    """The key that clients must give. Raises `UsageError` for a server that others can reach and that has none."""
    key = (key or "").strip()  # HTTP strips headers, too
    if not key and not is_loopback(host):
        raise UsageError(f"a server at {host} can be reached by others: set {KEY_VARIABLE} to a key, or use 127.0.0.1")
    return key or None


def is_loopback(host: str) -> bool:
    """Whether only programs on this machine reach ``host``, a name or an IP address, with or without brackets."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


Answer = tuple[int, str, bytes]  # status, media type and content of an HTTP response


def serve_loopback(answer: Callable[[BaseHTTPRequestHandler], Answer]) -> str:
    """Give this machine's HTTP requests the ``answer(request)``, each in a thread of its own, until the process ends;
    returns the address."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            status, kind, content = answer(self)
            with contextlib.suppress(OSError):  # the client went away
                self.send_response(status)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(content)))
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                self.wfile.write(content)

        do_POST = do_GET

        def log_message(self, format: str, *arguments: object) -> None:
            """Write nothing to the terminal."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{server.server_address[1]}"
