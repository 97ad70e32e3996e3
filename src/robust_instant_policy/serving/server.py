"""Running the server."""

import socket
from collections.abc import Callable
from typing import Any

import uvicorn

from robust_instant_policy.network import checked_key
from robust_instant_policy.serving.app import make_app
from robust_instant_policy.serving.guard import MAX_MESSAGE_BYTES
from robust_instant_policy.serving.planner import Planner

SPARE_BYTES = 16 * 2**20  # a message too large by up to this gets an answer; beyond, the connection is closed
PING_S = 20.0  # between two keep-alive messages of a websocket
PONG_S = 60.0  # after which a silent client counts as gone
SHUTDOWN_S = 5  # for clients to hang up when the server ends


def serve(
    planner: Planner,
    listener: socket.socket,
    key: str | None = None,
    debug: bool = False,
    on_server: Callable[[Any], None] | None = None,
) -> None:
    """Serve until Ctrl-C, or until ``should_exit`` of the server given to ``on_server`` is set. Raises `UsageError`."""
    host = listener.getsockname()[0]
    config = uvicorn.Config(
        make_app(planner, host, checked_key(host, key), debug),
        log_level="warning",
        access_log=False,
        ws="websockets-sansio",
        ws_max_size=MAX_MESSAGE_BYTES + SPARE_BYTES,
        ws_ping_interval=PING_S,
        ws_ping_timeout=PONG_S,
        ws_per_message_deflate=False,  # a compressed message may unpack to any size, and depth hardly compresses
        timeout_graceful_shutdown=SHUTDOWN_S,
        server_header=False,
    )
    server = uvicorn.Server(config)
    if on_server is not None:
        on_server(server)
    try:
        server.run(sockets=[listener])
    finally:
        listener.close()
        planner.close()
