"""The limits of the live page's connections and log messages."""

from __future__ import annotations

import asyncio
import resource
from collections.abc import Iterator
from typing import Any

import pytest
import uvicorn
from uvicorn.server import ServerState

from bodycap_batch.watch.web import connections
from bodycap_batch.watch.web.connections import (
    ConnectionLimits,
    LimitedConnection,
    connection_limits,
)


@pytest.mark.parametrize(
    ("descriptors", "total", "per_address"),
    [(resource.RLIM_INFINITY, 256, 64), (20_000, 256, 64), (256, 64, 16), (3, 1, 1)],
)
def test_most_descriptors_are_left_for_the_jobs(
    monkeypatch: pytest.MonkeyPatch, descriptors: int, total: int, per_address: int
) -> None:
    monkeypatch.setattr(connections.resource, "getrlimit", lambda _: (descriptors, descriptors))
    assert connection_limits() == ConnectionLimits(total=total, per_address=per_address)


def test_the_addresses_of_one_ipv6_network_are_one_client() -> None:
    network_of = connections._network_of
    assert network_of("2001:db8:0:1::5") == network_of("2001:db8:0:1:ffff::6")
    assert network_of("2001:db8:0:1::5") != network_of("2001:db8:0:2::5")
    assert network_of("10.0.0.1") != network_of("10.0.0.2")


class Transport(asyncio.Transport):
    """A transport that records what the server does."""

    def __init__(self, address: str) -> None:
        super().__init__({"peername": (address, 5000)})
        self.written = b""
        self.aborted = self.closing = False

    def write(self, data: Any) -> None:
        self.written += bytes(data)

    def is_closing(self) -> bool:
        return self.closing

    def close(self) -> None:
        self.closing = True

    def abort(self) -> None:
        self.aborted = True

    def pause_reading(self) -> None: ...

    def resume_reading(self) -> None: ...


class Connection:
    """A connection to an application that reads the body and then answers."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, state: ServerState | None = None, address: str = "10.0.0.1"
    ) -> None:
        self.loop = loop
        self.transport = Transport(address)
        config = uvicorn.Config(self.answer, http=LimitedConnection, log_config=None, lifespan="off")
        config.load()
        self.protocol = LimitedConnection(config, state or ServerState(), {}, loop)
        self.protocol.connection_made(self.transport)
        self.protocol.close_without_progress(0.0)

    @staticmethod
    async def answer(_: Any, receive: Any, send: Any) -> None:
        while (await receive()).get("more_body"):
            pass
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    def receive(self, data: bytes) -> None:
        self.protocol.data_received(data)
        for _ in range(5):  # let the application process the data
            self.loop.run_until_complete(asyncio.sleep(0))

    def is_closed_at(self, seconds: float) -> bool:
        self.protocol.close_without_progress(seconds)
        return self.transport.aborted


@pytest.fixture
def loop() -> Iterator[asyncio.AbstractEventLoop]:
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    yield loop
    asyncio.set_event_loop(None)
    loop.close()


@pytest.fixture
def connection(loop: asyncio.AbstractEventLoop) -> Connection:
    return Connection(loop)


@pytest.mark.parametrize(("total", "per_address"), [(2, 9), (9, 2)])
def test_a_connection_above_a_limit_is_closed(
    loop: asyncio.AbstractEventLoop,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    total: int,
    per_address: int,
) -> None:
    limits = ConnectionLimits(total=total, per_address=per_address)
    monkeypatch.setattr(connections, "connection_limits", lambda: limits)
    connections._report_limits.cache_clear()
    state = ServerState()
    clients = [Connection(loop, state) for _ in range(4)]
    assert [client.transport.aborted for client in clients] == [False, False, True, True]
    assert len(caplog.records) == 1, "reported once"
    other = Connection(loop, state, "10.0.0.2")
    assert other.transport.aborted == (total == 2)
    clients[0].protocol.connection_lost(None)
    clients[0].protocol.connection_lost(None)  # a second call does not count
    if total == 2:
        assert not Connection(loop, state).transport.aborted


PUT = b"PUT / HTTP/1.1\r\nHost: x\r\nContent-Length: 10000\r\n\r\n"


@pytest.mark.parametrize("data", [b"", b"GET / HTTP/1.1\r\nHost: x\r\nA: "])
def test_a_header_must_end_in_time(connection: Connection, data: bytes) -> None:
    for second in range(11):
        if data:
            connection.receive(data if second == 0 else b"a")
        assert not connection.is_closed_at(second)
    assert connection.is_closed_at(11)


def test_each_request_has_its_own_time_for_the_header(connection: Connection) -> None:
    for second in range(0, 90, 9):
        connection.receive(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        assert not connection.is_closed_at(second)
    assert connection.transport.written.count(b"204") == 10
    assert connection.is_closed_at(100)


def test_a_slow_body_is_received_but_a_standing_one_is_not(connection: Connection) -> None:
    connection.receive(PUT)
    for second in range(0, 200, 25):  # 1,200 bytes in 25 s are slow but enough
        connection.receive(b"x" * 1200)
        assert not connection.is_closed_at(second)
    assert connection.is_closed_at(210)


def test_single_bytes_do_not_keep_a_body_open(connection: Connection) -> None:
    connection.receive(PUT)
    for second in range(31):
        connection.receive(b"x")
        assert not connection.is_closed_at(second)
    assert connection.is_closed_at(31)


def test_the_time_of_a_body_does_not_count_while_the_server_is_slow(connection: Connection) -> None:
    connection.receive(PUT)
    connection.protocol.flow.pause_reading()
    assert not connection.is_closed_at(0)
    assert not connection.is_closed_at(1000)


def test_an_answer_must_be_read(connection: Connection) -> None:
    connection.protocol.pause_writing()
    assert not connection.is_closed_at(0)
    connection.protocol.resume_writing()  # the client has read a part
    connection.protocol.pause_writing()
    assert not connection.is_closed_at(55)
    assert not connection.is_closed_at(110)
    assert connection.is_closed_at(116)


def test_a_closed_connection_that_sends_the_last_data_ends_in_time(connection: Connection) -> None:
    connection.transport.close()
    assert not connection.is_closed_at(0)
    assert connection.is_closed_at(11)
