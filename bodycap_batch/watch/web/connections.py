"""Limit the connections of the live page, so that clients cannot use up the watcher's file descriptors.

uvicorn limits neither the number of open connections nor the time that a request's header may take. This
module adds both limits. It also closes connections that make no progress.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import resource
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

SWEEP_PERIOD_S = 1
"""Minimum time (seconds) between two searches for connections without progress. Evidence: none."""
_MAX_CONNECTIONS = 256
"""Maximum number of open connections. Evidence: none."""
_DESCRIPTORS_PER_CONNECTION = 4
"""Number of file descriptors of the process for each permitted connection. A connection uses at most two, one
for itself and one for a file, and as many new ones may wait to be closed. The server therefore uses at most
three quarters of the descriptors."""
_ADDRESS_SHARE = 4
"""Ratio of the number of all connections to the number of connections of one client address. A browser opens
at most six connections to one server. Evidence: none."""
_IPV6_PREFIX_BITS = 64
"""Number of bits of an IPv6 address that identify the client's network. One client can use all addresses of
its network. Source: RFC 4291, section 2.5.1."""
_MIN_BODY_BYTES = 1024
"""Minimum number of bytes of a request's body that must arrive within the time limit for a body. Evidence:
none."""

Phase = Literal["header", "body", "answer", "close"]
TIME_LIMITS_S: dict[Phase, float] = {"header": 10.0, "body": 30.0, "answer": 60.0, "close": 10.0}
"""Maximum time (seconds) of a connection in each phase. In the phases "body" and "answer", the time starts
again with each progress. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionLimits:
    """Maximum numbers of open connections.

    Attributes:
        total: Maximum number of all connections.
        per_address: Maximum number of connections of one client address.
    """

    total: int
    per_address: int


def connection_limits() -> ConnectionLimits:
    """Return the limits for this process. They depend on the number of file descriptors it may open."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    total = _MAX_CONNECTIONS
    if soft != resource.RLIM_INFINITY:
        total = max(1, min(total, soft // _DESCRIPTORS_PER_CONNECTION))
    return ConnectionLimits(total=total, per_address=max(1, total // _ADDRESS_SHARE))


class LimitedConnection(H11Protocol):
    """An HTTP connection that ends at once if too many are open, or if the client makes no progress.

    The limits are those of `connection_limits` and of `TIME_LIMITS_S`.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.client_network = ""
        self._received = 0
        self._resumptions = 0
        self._progress: tuple[Phase, object] | None = None
        self._since_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a new connection, or close it if too many connections are open."""
        super().connection_made(transport)
        self.client_network = _network_of(str(self.client[0] if self.client else ""))
        others = [
            each for each in self.connections if isinstance(each, LimitedConnection) and each is not self
        ]
        same = sum(each.client_network == self.client_network for each in others)
        limits = connection_limits()
        if len(others) >= limits.total or same >= limits.per_address:
            _report_limits(limits)
            self.connections.discard(self)
            transport.abort()

    def data_received(self, data: bytes) -> None:
        """Count and process data from the client."""
        self._received += len(data)
        super().data_received(data)

    def resume_writing(self) -> None:
        """Record that the client has received a part of the answer."""
        self._resumptions += 1
        super().resume_writing()

    def close_without_progress(self, now_s: float) -> None:
        """Close the connection if the client has made no progress for too long.

        Args:
            now_s: Time (seconds) by the clock of the event loop.
        """
        progress = self._current_progress()
        if progress != self._progress:
            self._progress, self._since_s = progress, now_s
        elif progress is not None and now_s - self._since_s > TIME_LIMITS_S[progress[0]]:
            self.transport.abort()

    def _current_progress(self) -> tuple[Phase, object] | None:
        """Return the phase and a value that changes with each progress; None if the server is at work."""
        if self.transport.is_closing():
            return "close", None
        if self.flow.write_paused:
            return "answer", self._resumptions
        if self.conn.their_state is h11.SEND_BODY and not self.flow.read_paused:
            return "body", self._received // _MIN_BODY_BYTES
        if self.conn.their_state is h11.IDLE:
            return "header", self.cycle  # the latest request: its end starts the time of the next header
        return None


@cache
def _report_limits(limits: ConnectionLimits) -> None:
    """Tell the operator, once in a process, that connections above the limits are closed."""
    logging.getLogger(__name__).warning(
        "new connections to the live page are closed at once while %d are open, or %d from one address",
        limits.total,
        limits.per_address,
    )


def close_connections_without_progress(connections: set[Any]) -> None:
    """Close the connections whose clients have made no progress for too long.

    Args:
        connections: All open connections, as `LimitedConnection` objects.
    """
    now_s = asyncio.get_running_loop().time()
    for connection in list(connections):
        connection.close_without_progress(now_s)


def _network_of(address: str) -> str:
    """Return the text by which connections of one client are counted: its address, or its IPv6 network."""
    try:
        found = ipaddress.ip_address(address)
    except ValueError:  # a connection that has ended already has no address
        return ""
    if found.version == 4:
        return str(found)
    return str(ipaddress.ip_network((int(found), _IPV6_PREFIX_BITS), strict=False))
