"""Requests that the live page allows and refuses."""

from __future__ import annotations

import socket

import pytest

from bodycap_batch.core.errors import JobError
from bodycap_batch.watch.web.access import Access, access_from_address

TOKEN = "s3cret-s3cret-s3cret"  # noqa: S105
LOCAL = Access(host="127.0.0.1", port=8080)
OPEN = Access(host="0.0.0.0", port=8080, token=TOKEN)  # noqa: S104 - that a token is asked for is the point


def code(access: Access, method: str = "GET", query: str = "", **headers: str) -> int:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    refusal = access.refusal(method, {"host": "127.0.0.1:8080", **named}, query)
    return 200 if refusal is None else refusal[0]


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "LOCALHOST:8080", "[::1]:8080"])
def test_loopback_is_reached_under_its_names(host: str) -> None:
    assert code(LOCAL, host=host) == 200
    assert code(LOCAL, "POST", host=host, origin=f"http://{host}") == 200


@pytest.mark.parametrize(
    "host",
    ["", "evil.example:8080", "127.0.0.1", "127.0.0.1:80", "127.0.0.1.evil.example:8080", "10.0.0.5:8080"],
)
def test_another_host_name_is_refused_on_loopback(host: str) -> None:
    assert code(LOCAL, host=host) == 421


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH"])
@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"origin": "null"},
        {"origin": "http://evil.example"},
        {"origin": "http://127.0.0.1"},
        {"origin": "http://127.0.0.1:9090"},
        {"origin": "https://127.0.0.1:8080"},
        {"origin": "http://localhost:8080"},
        {"origin": "http://127.0.0.1:8080", "sec_fetch_site": "cross-site"},
    ],
    ids=str,
)
def test_requests_with_changes_must_come_from_the_page(method: str, headers: dict[str, str]) -> None:
    assert code(LOCAL, method, **headers) == 403


def test_other_pages_may_link_to_the_page_but_not_read_it() -> None:
    assert code(LOCAL, sec_fetch_site="cross-site", sec_fetch_dest="document") == 200
    assert code(LOCAL, sec_fetch_site="cross-site", sec_fetch_dest="script") == 403
    assert code(LOCAL, origin="http://evil.example") == 403
    assert code(LOCAL, "POST", sec_fetch_site="cross-site", sec_fetch_dest="document", origin="null") == 403


def test_a_token_is_required_except_on_loopback() -> None:
    assert code(OPEN, host="10.0.0.5:8080") == 401
    assert code(OPEN, host="10.0.0.5:8080", query=f"token={TOKEN}") == 200
    assert code(OPEN, host="10.0.0.5:8080", query="token=wrong") == 401
    assert code(OPEN, host="10.0.0.5:8080", cookie=f"a=b; bodycap_token={TOKEN}") == 200
    assert code(OPEN, host="10.0.0.5:8080", cookie="bodycap_token=") == 401
    assert code(OPEN, host="10.0.0.5:8080", authorization=f"Bearer {TOKEN}") == 200
    assert code(OPEN, host="10.0.0.5:8080", authorization=f"Basic {TOKEN}") == 401
    here = {"host": "10.0.0.5:8080", "origin": "http://10.0.0.5:8080"}
    assert code(OPEN, "POST", query=f"token={TOKEN}", **here) == 401  # an address ends up in logs
    assert code(OPEN, "POST", cookie=f"bodycap_token={TOKEN}", **here) == 200
    assert code(OPEN, host=f"{socket.gethostname()}:8080", authorization=f"Bearer {TOKEN}") == 200
    assert code(OPEN, host="evil.example:8080", authorization=f"Bearer {TOKEN}") == 421


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "[::1]", "127.0.0.1:80"])
def test_browsers_omit_the_default_port(host: str) -> None:
    usual = Access(host="127.0.0.1", port=80)
    assert code(usual, host=host) == 200
    assert code(usual, "POST", host=host, origin=f"http://{host}") == 200
    assert code(usual, host="evil.example") == 421


def test_addresses_are_parsed() -> None:
    assert access_from_address("127.0.0.1:8080", "") == LOCAL
    assert access_from_address("[::1]:80", "").url == "http://[::1]:80/"
    assert access_from_address("0.0.0.0:8080", TOKEN) == OPEN
    for address, token in (
        ("8080", ""),
        ("127.0.0.1:http", ""),
        ("127.0.0.1:70000", ""),
        ("0.0.0.0:8080", ""),
        ("192.168.1.7:8080", ""),
        ("example.org:8080", ""),
        ("0.0.0.0:8080", "short"),
        ("0.0.0.0:8080", "with; semicolons and spaces"),
    ):
        with pytest.raises(JobError):
            access_from_address(address, token)
