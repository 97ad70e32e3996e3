"""Where a server listens, and who can reach it."""

from __future__ import annotations

import ipaddress
import socket

from robust_instant_policy.errors import UsageError


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


def is_loopback(host: str) -> bool:
    """Whether only programs on this machine reach ``host``, a name or an IP address, with or without brackets."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
