"""When a server needs a key."""

from __future__ import annotations

from robust_instant_policy.errors import UsageError
from robust_instant_policy.network import is_loopback

KEY_VARIABLE = "RIP_SERVE_KEY"


def checked_key(host: str, key: str | None) -> str | None:
    """The key that clients must give. Raises `UsageError` for a server that others can reach and that has none."""
    key = (key or "").strip()  # HTTP strips headers, too
    if not key and not is_loopback(host):
        raise UsageError(f"a server at {host} can be reached by others: set {KEY_VARIABLE} to a key, or use 127.0.0.1")
    return key or None
