"""Access control of the server, and limits for requests."""

import asyncio
import hmac
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import urlsplit

from fastapi import HTTPException
from starlette.responses import JSONResponse
from starlette.websockets import WebSocket

from robust_instant_policy.network import is_loopback

SCHEME = "Api-Key "  # of the header Authorization, as openpi's client sends it
OPEN_PATHS = ("/healthz", "/docs", "/openapi.json")  # they need no key
MAX_MESSAGE_BYTES = 64 * 2**20  # an RGB-D image of 3840 x 2160 pixels has 58 MB
UPLOAD_S = 30.0  # for one HTTP request
MAX_CONNECTIONS = 64  # by websocket

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]


class Guard:
    """ASGI middleware: requests need the ``key``, if there is one, and must not come from pages of other web sites.

    A browser lets any page open a websocket to this machine. So an Origin must be the server's own, and on a loopback
    address the Host must be a loopback address, too.
    """

    def __init__(self, app: Any, host: str, key: str | None):
        self.app, self.host, self.key = app, host, key

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            return await self.app(scope, receive, send)
        refusal = self._refusal(scope)
        if refusal is None:
            own = limited(receive) if scope["type"] == "http" else receive
            return await self.app(scope, own, send)
        status, error = refusal
        response = JSONResponse({"error": error}, status)
        if scope["type"] == "websocket":
            return await WebSocket(scope, receive, send).send_denial_response(response)
        await response(scope, receive, send)

    def _refusal(self, scope: Message) -> tuple[int, str] | None:
        headers = {name.lower(): value for name, value in scope["headers"]}
        host, origin = (headers.get(name, b"").decode("latin-1") for name in (b"host", b"origin"))
        try:
            origin_netloc, hostname = urlsplit(origin).netloc, urlsplit(f"//{host}").hostname
        except ValueError:
            return 400, "the header Host or Origin holds no address"
        if b"origin" in headers and origin_netloc != host:
            return 403, f"a page of {origin[:100]} may not use this server"
        if is_loopback(self.host) and not is_loopback(hostname or ""):
            return 403, f"this server is at {self.host}, not at {host[:100]!r}"
        if self.key is None or scope["path"] in OPEN_PATHS:
            return None
        if not hmac.compare_digest(headers.get(b"authorization", b""), (SCHEME + self.key).encode()):
            return 401, f"the header Authorization must be: {SCHEME}KEY"
        return None


def limited(receive: Receive) -> Receive:
    """``receive`` of one HTTP request, with bounds for the size of the body and for the time that it takes."""
    size, loop = 0, asyncio.get_running_loop()
    end = loop.time() + UPLOAD_S
    is_whole = False

    async def bounded() -> Message:
        nonlocal size, is_whole
        if is_whole:  # what comes now is that the client has hung up
            return await receive()
        try:
            async with asyncio.timeout_at(end):
                message = await receive()
        except TimeoutError:
            raise HTTPException(408, f"the body took longer than {UPLOAD_S:.0f} s") from None
        size += len(message.get("body", b""))
        if size > MAX_MESSAGE_BYTES:
            raise HTTPException(413, f"the body is larger than {MAX_MESSAGE_BYTES >> 20} MiB")
        is_whole = not message.get("more_body", False)
        return message

    return bounded
