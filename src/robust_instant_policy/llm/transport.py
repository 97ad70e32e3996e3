"""HTTP with one server: the key, the proxy, the size limit of replies, and one-line errors."""

import asyncio
import email.utils
import math
import os
import re
import ssl
import time
import urllib.parse
from typing import Any

import httpx2

from robust_instant_policy.errors import ModelError
from robust_instant_policy.llm.reply import Complaint, UnreadableReplyError, one_line, read_complaint, read_json
from robust_instant_policy.network import is_loopback

CONNECT_TIMEOUT_S = 5.0
TLS_PROBE_S = 1.0  # for the handshake that tells whether a port expects TLS
MAX_REPLY_BYTES = 8 << 20
LONGEST_RETRY_AFTER_S = 60.0
_PASSING_STATUS = (408, 409, 425, 429, 500, 502, 503, 504)
_PASSING_WORDS = re.compile(r"overload|rate.?limit|capacity|too many|try again|unavailable|timed? ?out|loading", re.I)


class UnavailableError(Exception):
    """The request may succeed later. ``wait_s`` is the pause that the server asks for; ``absent``: no server listens at
    the address; ``broken``: it fails inside, or its reply is not JSON, which seldom passes."""

    def __init__(self, message: str, wait_s: float = 0.0, absent: bool = False, broken: bool = False):
        super().__init__(message)
        self.wait_s, self.absent, self.broken = wait_s, absent, broken


class RefusedError(Exception):
    """The server does not accept the request as it is."""

    def __init__(self, status: int, complaint: Complaint):
        super().__init__(complaint.message)
        self.status, self.complaint = status, complaint


class Connection:
    """A client of the server at ``url`` (with its ``/v1``).

    ``has_answered``: the server is known to speak HTTP at ``url``.
    """

    def __init__(self, url: str, has_answered: bool = False):
        self.url = url
        self._has_answered = has_answered
        self._key_variable, key = _key(url)
        headers = {"Accept-Encoding": "identity"} | ({"Authorization": f"Bearer {key}"} if key else {})
        try:
            self._client = httpx2.AsyncClient(
                headers=headers,
                trust_env=not is_loopback(urllib.parse.urlsplit(url).hostname or ""),  # the environment's proxies
                verify=httpx2.create_ssl_context(),
                timeout=httpx2.Timeout(None, connect=CONNECT_TIMEOUT_S),
            )
        except OSError:
            raise ModelError(
                "SSL_CERT_FILE or SSL_CERT_DIR names no readable certificates; correct or unset it"
            ) from None
        except (ImportError, ValueError):  # the message of the error may contain a password
            raise ModelError(
                f"the proxy that the environment names for {url} cannot be used; give it as http://host:port, or "
                "put the server into no_proxy"
            ) from None

    async def aclose(self) -> None:
        await self._client.aclose()

    async def request(self, address: str, body: dict[str, Any] | None = None, timeout_s: float = 5.0) -> Any:
        """The JSON that ``address`` answers to GET, or to POST where there is a ``body``, within ``timeout_s`` in all.

        Raises `UnavailableError`, `RefusedError`, and `ModelError` where another request would fail in the same way.
        """
        try:
            async with (
                asyncio.timeout(timeout_s),
                self._client.stream("GET" if body is None else "POST", address, json=body) as response,
            ):
                self._has_answered = True
                content = await _content(response)
        except TimeoutError:
            raise UnavailableError("it did not answer in time") from None
        except httpx2.TransportError as error:
            await self._raise_for_tls(error)
            reason = one_line(str(error)) or type(error).__name__
            absent = isinstance(error, httpx2.ConnectError | httpx2.ConnectTimeout)
            raise UnavailableError(f"the connection failed ({reason})", absent=absent) from None
        if not response.is_success:
            raise self._failure(response.status_code, response.headers, content)
        if content.lstrip()[:1] == b"<":  # web interfaces answer so to addresses that they do not know
            page = f"its reply could not be read (it is a web page: {read_complaint(content).message[:80]!r})"
            raise RefusedError(404, Complaint(page))
        try:
            reply = read_json(content)
        except UnreadableReplyError as error:
            raise UnavailableError(f"its reply could not be read ({error})", broken=True) from None
        if isinstance(reply, dict) and reply.get("error") and not reply.get("choices"):
            # Gateways send errors inside HTTP 200.
            code = reply["error"].get("code") if isinstance(reply["error"], dict) else None
            passes = _PASSING_WORDS.search(read_complaint(content).message)
            code = str(code) if isinstance(code, int | str) else ""
            status = code if re.fullmatch(r"[45]\d\d", code) else "503" if passes else "400"
            raise self._failure(int(status), response.headers, content)
        return reply

    def _failure(self, status: int, headers: httpx2.Headers, content: bytes) -> Exception:
        complaint = read_complaint(content)
        if 300 <= status < 400:
            place = one_line(headers.get("Location", ""))
            return ModelError(f"{self.url} redirects to {place!r}; give the final address instead")
        if status in (401, 403):
            return ModelError(f"{self.url} refused the key ({status}); set {self._key_variable} to a valid one")
        if b"insufficient_quota" in content:
            return ModelError(f"{self.url} refused the request: {complaint.message}")
        if status in _PASSING_STATUS:
            words = f"it answered {status} ({complaint.message})"
            return UnavailableError(words, _retry_after(headers), broken=status == 500)
        return RefusedError(status, complaint)

    async def _raise_for_tls(self, error: httpx2.TransportError) -> None:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, ssl.SSLError):
            cause = cause.__cause__ or cause.__context__
        advice = "put its certificate, or its authority's, into a file and name that in SSL_CERT_FILE"
        if isinstance(cause, ssl.SSLCertVerificationError):
            if cause.verify_code in (62, 64):  # X509_V_ERR_HOSTNAME_MISMATCH, _IP_ADDRESS_MISMATCH
                advice = "use the name that its certificate is for"
            elif cause.verify_code == 10:  # X509_V_ERR_CERT_HAS_EXPIRED
                advice = "renew it"
            raise ModelError(f"{self.url} has a certificate that is not trusted ({cause.verify_message}); {advice}")
        parts = urllib.parse.urlsplit(self.url)
        if isinstance(cause, ssl.SSLError) and re.search("WRONG_VERSION|RECORD_LAYER|HTTP_REQUEST", cause.reason or ""):
            raise ModelError(f"{self.url} does not speak TLS; write http:// instead of https://")
        closed = isinstance(error, httpx2.RemoteProtocolError | httpx2.ReadError)
        if self._has_answered or parts.scheme != "http" or not closed:
            return
        if await _speaks_tls(parts.hostname or "", parts.port or 80):
            raise ModelError(f"{self.url} speaks TLS; write https:// instead of http://")


async def _content(response: httpx2.Response) -> bytes:
    if response.headers.get("Content-Encoding", "identity") != "identity":
        raise httpx2.RemoteProtocolError("the reply is compressed although that was not asked for")
    content = bytearray()
    async for chunk in response.aiter_raw():
        content += chunk
        if len(content) > MAX_REPLY_BYTES:
            raise httpx2.RemoteProtocolError(f"the reply is longer than {MAX_REPLY_BYTES >> 20} MB")
    return bytes(content)


async def _speaks_tls(host: str, port: int) -> bool:
    """Whether a TLS handshake succeeds. Nothing is sent over it, so the certificate does not matter."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        async with asyncio.timeout(TLS_PROBE_S):
            _, writer = await asyncio.open_connection(host, port, ssl=context)
    except (OSError, TimeoutError):
        return False
    writer.close()
    return True


def _key(url: str) -> tuple[str, str]:
    """The variable that holds the key for ``url``, and the key, empty where it is not set.

    OpenAI's key goes to OpenAI alone. Raises `ModelError` where the key would travel unencrypted, or is none.
    """
    parts = urllib.parse.urlsplit(url)
    host = parts.hostname or ""
    is_openai = parts.scheme == "https" and (host == "api.openai.com" or host.endswith(".api.openai.com"))
    variable = "OPENAI_API_KEY" if is_openai else "RIP_API_KEY"
    key = os.environ.get(variable, "").strip()  # files and pipes leave a line break behind it
    if not (key.isascii() and key.isprintable()):
        raise ModelError(f"{variable} holds characters that no key has; set it to the key alone")
    if key and parts.scheme == "http" and not is_loopback(host):
        raise ModelError(
            f"the key in {variable} would travel unencrypted to {url}; use https or an SSH tunnel, or unset {variable}"
        )
    return variable, key


def _retry_after(headers: httpx2.Headers) -> float:
    """Seconds; 0 where the header is missing or makes no sense. RFC 9110 allows seconds and dates."""
    value = headers.get("Retry-After", "")
    try:
        seconds = float(value)
    except ValueError:
        try:
            seconds = email.utils.parsedate_to_datetime(value).timestamp() - time.time()
        except (ValueError, OverflowError):
            return 0.0
    return min(seconds, LONGEST_RETRY_AFTER_S) if math.isfinite(seconds) and seconds > 0 else 0.0
