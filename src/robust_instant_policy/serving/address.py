"""Where the server listens, and when it needs a key."""

from __future__ import annotations

import ipaddress
import socket

from robust_instant_policy.errors import UsageError

KEY_VARIABLE = "RIP_SERVE_KEY"


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes a free one. Raises `UsageError`."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host.strip("[]"), port), family=family, backlog=128)
    except (OSError, OverflowError) as error:
        raise UsageError(f"cannot listen at {host} port {port} ({error}); choose another with --host, --port") from None


def is_loopback(host: str) -> bool:
    """Whether only programs on this machine reach a server at ``host``."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def checked_key(host: str, key: str | None) -> str | None:
    """The key that clients must give. Raises `UsageError` for a server that others can reach and that has none."""
    key = (key or "").strip()  # HTTP strips headers, too
    if not key and not is_loopback(host):
        raise UsageError(f"a server at {host} can be reached by others: set {KEY_VARIABLE} to a key, or use 127.0.0.1")
    return key or None
