"""Who may use the live page.

Listening on loopback alone does not keep other web pages out: one that the user has open can send requests
to 127.0.0.1, and with a name server of its own (DNS rebinding) even read the answers. So the Host header must
name this page as it was meant to be reached, and whatever changes something must come from the page itself.
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
_SAFE = ("GET", "HEAD")
_SHORTEST_TOKEN = 16
_PORT = re.compile(r":[0-9]+$")
"""Browsers leave the usual port out."""
_TOKEN = re.compile(rf"[A-Za-z0-9_\-]{{{_SHORTEST_TOKEN},200}}")
_TOKEN_HINT = "python3 -c 'import secrets; print(secrets.token_urlsafe())' makes one"  # noqa: S105 - a remedy


@dataclass(frozen=True, slots=True, kw_only=True)
class Access:
    """Where the page listens and what it asks for.

    Attributes:
        host: Address it listens on.
        port: Port it listens on.
        token: What a browser has to show; "" where none is asked for (loopback).
    """

    host: str
    port: int
    token: str = ""

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{_bracketed(self.host)}:{self.port}/"

    def refusal(self, method: str, headers: Mapping[str, str], query: str) -> tuple[int, str] | None:
        """Why a request is refused, with the status code; None where it may pass.

        Args:
            method: GET, POST …
            headers: By lower-case name.
            query: The part of the address after the question mark.
        """
        host = headers.get("host", "").lower()
        if not self._is_this_page(host):
            return 421, "this page is not reached under that name"
        origin = headers.get("origin")
        changes = method not in _SAFE
        if (changes and origin is None) or (origin is not None and origin.lower() != f"http://{host}"):
            return 403, "the request comes from another page"
        followed = not changes and headers.get("sec-fetch-dest") == "document"  # a link to this page
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none") and not followed:
            return 403, "the request comes from another page"
        if self.token and not self._shows_token(headers, "" if changes else query):
            return 401, "a token is needed: open the page as /?token=…"
        return None

    def token_in(self, query: str) -> bool:
        """True where the address carries the right token."""
        return bool(self.token) and self._is_token(parse_qs(query).get("token", [""])[0])

    def _is_this_page(self, host: str) -> bool:
        name, _, port = (host if _PORT.search(host) else f"{host}:80").rpartition(":")
        if not port.isdecimal() or int(port) != self.port:
            return False
        if is_loopback(self.host):
            return name in ("localhost", "127.0.0.1", "[::1]", _bracketed(self.host))
        # Another site can point its name here, but not an address, and not this machine's own name.
        return _is_address(name) or name in (self.host.lower(), *_own_names())

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


def access_from(address: str, token: str) -> Access:
    """Read ``HOST:PORT`` of the command line.

    Raises:
        JobError: No address, or one that is not loopback without a token.
    """
    host, _, port = address.rpartition(":")
    host = host.strip("[]")
    if not host or not port.isdecimal() or not 0 <= int(port) < 1 << 16:
        raise JobError(
            f"no address: {address!r}", field="--web", hint="HOST:PORT, for example 127.0.0.1:8080"
        )
    if not is_loopback(host) and not token:
        raise JobError(
            f"{host} can be reached from other machines: the page needs a token there",
            field="--web",
            hint=f"set BODYCAP_WEB_TOKEN ({_TOKEN_HINT}), or listen on 127.0.0.1 and use an SSH tunnel",
        )
    if token and not _TOKEN.fullmatch(token):
        hint = f"{_SHORTEST_TOKEN} letters, digits, - or _, or more; {_TOKEN_HINT}"
        raise JobError("the token is too short or has odd characters", field="BODYCAP_WEB_TOKEN", hint=hint)
    return Access(host=host, port=int(port), token=token)


def is_loopback(host: str) -> bool:
    """True for an address that only this machine can reach."""
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


def _own_names() -> tuple[str, ...]:
    return socket.gethostname().lower(), socket.getfqdn().lower()


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
