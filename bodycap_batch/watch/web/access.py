"""Decide which requests may use the live page.

A server that listens only on loopback can still be attacked by other web pages. Such a page runs in the
user's browser and can send requests to 127.0.0.1. If the attacker also controls a name server (DNS
rebinding), the page can even read the answers. Therefore the Host header must be a name of the live page. A
request that changes something must come from the live page itself.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from bodycap_batch.core.errors import JobError

COOKIE = "bodycap_token"
_READING_METHODS = ("GET", "HEAD")
"""HTTP methods of requests that change nothing on the server."""
_MIN_TOKEN_LENGTH = 16
"""Minimum number of characters of a token. There are 64 permitted characters, so 16 characters hold up to 96
bits. A random token of this length cannot be guessed."""
_PORT = re.compile(r":[0-9]{1,5}$")
"""Pattern of the port in a Host header. Browsers omit the default port. A port has at most five digits."""
_TOKEN = re.compile(rf"[A-Za-z0-9_\-]{{{_MIN_TOKEN_LENGTH},200}}")
_TOKEN_HINT = "to create a token, run: python3 -c 'import secrets; print(secrets.token_urlsafe())'"  # noqa: S105 - a hint


@dataclass(frozen=True, slots=True, kw_only=True)
class Access:
    """Check whether a request may use the live page.

    Attributes:
        host: Name or address to listen on.
        port: Port to listen on.
        token: Token that a browser must send; "" if no token is required. Every address other than loopback
            requires a token.
    """

    host: str
    port: int
    token: str = ""

    @property
    def url(self) -> str:
        """Address (URL) of the page."""
        return f"http://{_host_in_url(self.host)}:{self.port}/"

    def refusal(self, method: str, headers: Mapping[str, str], query: str) -> tuple[int, str] | None:
        """Return the status code and the reason if a request is refused, or None if the request is allowed.

        Args:
            method: HTTP method, for example GET or POST.
            headers: HTTP headers by lower-case name.
            query: Part of the requested address after the question mark.
        """
        host = headers.get("host", "").lower()
        if not self._is_this_page(host):
            return 421, "the Host header is not a name of this page"
        origin = headers.get("origin")
        changes = method not in _READING_METHODS
        if (changes and origin is None) or (origin is not None and origin.lower() != f"http://{host}"):
            return 403, "the request comes from another page"
        is_link = not changes and headers.get("sec-fetch-dest") == "document"
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none") and not is_link:
            return 403, "the request comes from another page"
        if self.token and not self._shows_token(headers, "" if changes else query):
            return 401, "a token is needed: open the page as /?token=TOKEN"
        return None

    def token_in(self, query: str) -> bool:
        """Return True if the query holds the correct token."""
        return bool(self.token) and self._is_token(parse_qs(query).get("token", [""])[0])

    def _is_this_page(self, host: str) -> bool:
        name, _, port = (host if _PORT.search(host) else f"{host}:80").rpartition(":")
        if not port.isdecimal() or int(port) != self.port:
            return False
        if is_loopback(self.host):
            return name in ("localhost", "127.0.0.1", "[::1]", _host_in_url(self.host))
        # An attacker can register a domain name that points to this machine, so other names are refused.
        return _is_address(name) or name in (self.host.lower(), *_host_names())

    def _shows_token(self, headers: Mapping[str, str], query: str) -> bool:
        scheme, _, bearer = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer" and self._is_token(bearer):
            return True
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        except CookieError:
            cookie = None
        return (cookie is not None and self._is_token(cookie.value)) or self.token_in(query)

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(errors="replace"), self.token.encode())


def access_from_address(address: str, token: str) -> Access:
    """Return the access for an address of the command line.

    Args:
        address: Text of the form ``HOST:PORT``.
        token: Token that the page requires; "" for no token.

    Raises:
        JobError: The text is not an address, the token is not valid, or an address other than loopback has no
            token.
    """
    host, _, port = address.rpartition(":")
    host = host.strip("[]")
    if not host or not port.isdecimal() or not 0 <= int(port) < 1 << 16:
        raise JobError(
            f"{address!r} is not an address",
            field="--web",
            hint="write HOST:PORT, for example 127.0.0.1:8080",
        )
    if not is_loopback(host) and not token:
        raise JobError(
            f"{host} can be reached from other machines, so the page needs a token",
            field="--web",
            hint=f"set BODYCAP_WEB_TOKEN to a token ({_TOKEN_HINT}), or use --web 127.0.0.1:{port} and an "
            "SSH tunnel",
        )
    if token and not _TOKEN.fullmatch(token):
        hint = f"use at least {_MIN_TOKEN_LENGTH} letters, digits, - or _; {_TOKEN_HINT}"
        raise JobError(
            "the token is too short or contains characters that are not permitted",
            field="BODYCAP_WEB_TOKEN",
            hint=hint,
        )
    return Access(host=host, port=int(port), token=token)


def is_loopback(host: str) -> bool:
    """Return True for an address that only this machine can reach."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _host_names() -> tuple[str, ...]:
    return socket.gethostname().lower(), socket.getfqdn().lower()


def _host_in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host
