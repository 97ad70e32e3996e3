"""Access control of the page: an address that others can reach needs a token; other web sites may not use the page.

viser listens on the loopback interface only; the gate passes connections on to it. The token is the first part of the
address' path, so the page's websocket has it, too.
"""

import asyncio
import hmac
import re
import secrets
import socket
import threading

from robust_instant_policy.network import is_loopback, listen

LONGEST_HEAD = 16_384  # bytes of a request before its body
HEAD_TIMEOUT_S = 10.0
REFUSAL = "HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain\r\nConnection: close\r\n\r\n"


class Gate:
    """Listens on ``host`` and ``port`` and passes accepted connections on to the loopback port ``inner``.

    ``address`` is what a person opens. Raises `UsageError` where it cannot listen.
    """

    def __init__(self, host: str, port: int, inner: int):
        self._host, self._inner = host.strip("[]"), inner
        self._token = "" if is_loopback(host) else secrets.token_urlsafe(16)
        listener = listen(host, port)
        self.port = listener.getsockname()[1]
        running = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run(listener, running)), daemon=True)
        self._thread.start()
        running.wait()
        name = f"[{self._host}]" if ":" in host else host
        if self._host in ("0.0.0.0", "::"):
            name = socket.gethostname()
        self.address = f"http://{name}:{self.port}/{self._token}".rstrip("/")

    def close(self) -> None:
        """Close all connections."""
        self._loop.call_soon_threadsafe(self._stopped.set)
        self._thread.join()

    async def _run(self, listener: socket.socket, running: threading.Event) -> None:
        self._loop, self._stopped = asyncio.get_running_loop(), asyncio.Event()
        running.set()
        server = await asyncio.start_server(self._serve, sock=listener)
        await self._stopped.wait()
        server.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inner: asyncio.StreamWriter | None = None
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_TIMEOUT_S)
            passed, reason = admit(head.decode("latin-1"), self._token, is_loopback(self._host))
            if reason:
                writer.write((REFUSAL + reason + "\n").encode())
                await writer.drain()
                return
            answers, inner = await asyncio.open_connection("127.0.0.1", self._inner)
            inner.write(passed.encode("latin-1"))
            await asyncio.gather(_copy(reader, inner), _copy(answers, writer))
        except asyncio.CancelledError:
            return  # the gate closes; asyncio's streams would report a cancelled task as an error
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # the browser went away, or is none
        finally:
            for end in (writer, inner):
                if end is not None:
                    end.close()


def admit(head: str, token: str, loopback: bool) -> tuple[str, str]:
    """The request ``head`` without the token in its path, and why it is refused, empty where it is not.

    A page of another web site is refused by the Origin that browsers name; on the loopback interface, a Host that
    is not this machine's is refused, too, since it may be a foreign name that resolves to this machine.
    """
    match = re.match(r"GET (/[^ ]*) HTTP/1\.[01]\r\n", head)
    if match is None or len(head) > LONGEST_HEAD:
        return "", "only a browser's requests are answered"
    fields = {name.lower(): value for name, value in re.findall(r"^([\w-]+): *([^\r]*)", head, re.MULTILINE)}
    host = fields.get("host", "")
    if loopback and not is_loopback(re.sub(r":\d+$", "", host).strip("[]")):
        return "", "this address is for this machine only"
    if "origin" in fields and fields["origin"].split("://")[-1] != host:
        return "", "another web site may not use this page"
    path = match[1]
    if token:
        first, _, rest = path[1:].partition("?")[0].partition("/")
        if not hmac.compare_digest(first.encode("latin-1"), token.encode()):
            return "", "open the whole address that rip studio printed; it ends with a token"
        path = "/" + rest
    return head.replace(match[1], path, 1), ""


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while data := await reader.read(1 << 16):
            writer.write(data)
            await writer.drain()
    finally:
        writer.close()
