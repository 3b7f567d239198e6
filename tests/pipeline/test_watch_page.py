"""The live page: its requests, and the page itself in a real browser."""

from __future__ import annotations

import errno
import http.client
import json
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any
from urllib.parse import quote, unquote

import pytest

from bodycap_batch.cli.watch import _live_page
from bodycap_batch.config.limits import Limits
from bodycap_batch.core.errors import JobError
from bodycap_batch.watch.web import Access, LivePage, connections
from bodycap_batch.watch.web.job_list import JobList
from tests.pipeline.spools import SpoolFixture, wait_for
from tests.videos import unopened

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Client:
    """Send requests as the page does."""

    def __init__(self, page: LivePage) -> None:
        self.host = f"127.0.0.1:{page.access.port}"

    def ask(
        self, method: str, path: str, body: bytes | dict[str, Any] | None = None, **headers: str
    ) -> tuple[int, bytes, dict[str, str]]:
        connection = http.client.HTTPConnection(self.host, timeout=30)
        data = json.dumps(body).encode() if isinstance(body, dict) else body
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, data, {"Origin": f"http://{self.host}", **named})
        answer = connection.getresponse()
        found = answer.status, answer.read(), {name.lower(): value for name, value in answer.getheaders()}
        connection.close()
        return found

    def json(self, method: str, path: str, body: bytes | dict[str, Any] | None = None) -> Any:
        code, data, _ = self.ask(method, path, body)
        assert code == 200, data
        return json.loads(data)

    def begin(self, name: str) -> str:
        return str(self.json("POST", "/api/uploads", {"name": name})["key"])


@pytest.fixture
def page(bench: SpoolFixture) -> Iterator[LivePage]:
    with LivePage(bench.spool, Access(host="127.0.0.1", port=0), Limits(video_gb=1e-5)) as page:
        yield page


@pytest.fixture
def client(page: LivePage) -> Client:
    return Client(page)


def test_jobs_logs_and_results_are_shown(bench: SpoolFixture, client: Client) -> None:
    bench.drop("küche 1")
    bench.run_once()
    bench.drop("next")
    found = {job["name"]: job for job in client.json("GET", "/api/jobs")["jobs"]}
    assert (found["küche 1"]["state"], found["next"]["state"]) == ("done", "waiting")
    name = "k%C3%BCche%201"
    assert b"export: finished" in client.ask("GET", f"/api/jobs/{name}/log")[1]
    assert "trajectories/torso.tum" in client.json("GET", f"/api/jobs/{name}/files")
    code, data, headers = client.ask("GET", f"/results/{name}/metrics.json")
    assert (code, json.loads(data)) == (200, {"partial": False})
    assert "sandbox" in headers["content-security-policy"]
    assert "allow-same-origin" not in headers["content-security-policy"]


def test_a_missing_disk_is_reported_and_the_last_jobs_stay_listed(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.drop("walk")
    failure, now = [""], [0.0]
    job_list = JobList(bench.spool, lambda: failure[0], lambda: now[0])
    assert json.loads(job_list.json_text())["trouble"] == ""

    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("bodycap_batch.watch.web.job_list.inbox_rows", fail)
    for message, shown in (
        ("", "Input/output error"),
        ("the inbox no longer exists", "the inbox no longer exists"),
    ):
        failure[0] = message
        now[0] += 10.0
        found = json.loads(job_list.json_text())
        assert shown in found["trouble"]
        assert [job["name"] for job in found["jobs"]] == ["walk"]


def test_nothing_but_results_is_served(bench: SpoolFixture, client: Client) -> None:
    bench.drop("walk")
    bench.run_once()
    (bench.job("walk").result / "link").symlink_to("/etc/passwd")
    for path in (
        "/results/walk/../status.json",
        "/results/walk/..%2fstatus.json",
        "/results/walk/%2e%2e/%2e%2e/%2e%2e/inbox",
        "/results/walk//etc/passwd",
        "/results/walk/link",
        "/results/../done/walk/status.json",
        "/results/walk/trajectories",
        "/results/other/metrics.json",
        "/app.py",
        "/..%2fapp.py",
    ):
        assert client.ask("GET", path)[0] == 404, path


@pytest.mark.parametrize(
    "name",
    [
        "%00",
        "a%00b",
        "x" * 5000,
        "%FF%FE",
        "%ED%A0%80",
        "%C3",
        "..",
        "%2e%2e",
        "..%2f..",
        "%0a",
        "%",
        "küche",
    ],
    ids=lambda value: ascii(value)[:12],
)
def test_no_name_causes_a_failure_of_the_server(bench: SpoolFixture, client: Client, name: str) -> None:
    (bench.spool.done / "walk" / "result" / "trajectories").mkdir(parents=True)
    key = client.begin("next")
    name = name if name.isascii() else quote(name)
    for path in (f"/results/walk/{name}", f"/results/walk/trajectories/{name}", f"/results/{name}/a"):
        assert client.ask("GET", path)[0] == 404, path
    requests = [
        *(("GET", f"/api/jobs/{name}/{part}") for part in ("log", "files")),
        *(("POST", f"/api/jobs/{name}/{part}") for part in ("retry", "cancel")),
        *(("PUT", f"/api/uploads/{part}") for part in (f"{name}/torso.mp4", f"{key}/{name}")),
        *(("PUT", f"/api/uploads/{key}/{part}") for part in (f"{name}/torso.mp4", f"a/{name}.mp4")),
        ("POST", f"/api/uploads/{name}/finish"),
        ("DELETE", f"/api/uploads/{name}"),
        ("GET", f"/?token={name}"),
        ("GET", f"/{name}"),
        ("GET", f"/{name}/{name}"),
    ]
    for method, path in requests:
        assert client.ask(method, path, b"x" if method == "PUT" else b"")[0] < 500, path
    assert client.ask("POST", "/api/uploads", {"name": unquote(name)})[0] in (200, 400)


@pytest.mark.parametrize("host", ["[", "127.0.0.1:" + "9" * 5000, "a]b", "\xff", "127.0.0.1:x"])
def test_a_wrong_host_header_is_refused(client: Client, host: str) -> None:
    assert client.ask("GET", "/", host=host)[0] in (400, 421)


def test_a_result_that_cannot_be_read_is_an_error_of_the_disk(
    bench: SpoolFixture, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    (bench.spool.done / "walk").mkdir()

    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("bodycap_batch.watch.web.app._file_response", fail)
    code, data, _ = client.ask("GET", "/results/walk/metrics.json")
    assert (code, json.loads(data)["message"]) == (507, "Input/output error")


def test_connections_without_a_complete_header_are_closed(
    bench: SpoolFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(connections.TIME_LIMITS_S, "header", 0.0)
    monkeypatch.setattr(
        connections, "connection_limits", lambda: connections.ConnectionLimits(total=9, per_address=4)
    )
    with LivePage(bench.spool, Access(host="127.0.0.1", port=0), Limits()) as page:
        address = ("127.0.0.1", page.access.port)
        idle = [socket.create_connection(address, timeout=30) for _ in range(20)]
        for connection in idle:  # 4 are open until the time limit ends, the others are closed at once
            with suppress(ConnectionResetError):
                assert connection.recv(1) == b""
            connection.close()
        assert Client(page).ask("GET", "/api/jobs")[0] == 200


def test_requests_of_other_pages_are_refused(bench: SpoolFixture, client: Client) -> None:
    bench.drop("walk")
    for headers in (
        {"Origin": "http://evil.example"},
        {"Host": "evil.example"},
        {"Sec_Fetch_Site": "cross-site"},
    ):
        code, _, _ = client.ask("POST", "/api/jobs/walk/cancel", b"", **headers)
        assert code in (403, 421)
        assert client.ask("GET", "/api/jobs", **headers)[0] in (403, 421)
    assert (bench.spool.inbox / "walk").is_dir()
    assert client.ask("POST", "/api/jobs/walk/cancel", b"")[0] == 200
    assert (bench.spool.failed / "walk").is_dir()
    assert client.ask("POST", "/api/jobs/walk/retry", b"")[0] == 200
    code, data, _ = client.ask("POST", "/api/jobs/walk/retry", b"")
    assert code == 400
    assert json.loads(data)["hint"]


def test_a_token_is_required_and_stored_in_a_cookie(bench: SpoolFixture) -> None:
    token = "0123456789abcdef0123"  # noqa: S105
    with LivePage(bench.spool, Access(host="127.0.0.1", port=0, token=token), Limits()) as page:
        client = Client(page)
        for path in ("/", "/page.js", "/api/jobs", "/api/events"):
            assert client.ask("GET", path)[0] == 401
        code, _, headers = client.ask("GET", f"/?token={token}")
        assert (code, headers["location"]) == (303, "/")
        assert {"httponly", "samesite=strict"} <= {
            part.strip().lower() for part in headers["set-cookie"].split(";")
        }
        assert client.ask("GET", "/", cookie=headers["set-cookie"].split(";")[0])[0] == 200


def test_the_printed_address_and_the_refusal_agree(
    bench: SpoolFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    token = "0123456789abcdef0123"  # noqa: S105
    with _live_page(bench.watcher(), bench.options(), "127.0.0.1:0", token):
        line = capsys.readouterr().err.strip()
    refusal = Access(host="127.0.0.1", port=80, token=token).refusal("GET", {"host": "127.0.0.1"}, "")
    assert refusal is not None
    assert line.endswith("/?token=TOKEN")
    assert refusal[1].endswith("/?token=TOKEN")


def test_an_uploaded_folder_becomes_a_job(bench: SpoolFixture, client: Client) -> None:
    key = client.begin("kitchen walk")
    client.json("PUT", f"/api/uploads/{key}/torso.mp4", b"frames of torso")
    client.json("PUT", f"/api/uploads/{key}/left_palm/GX010001.MP4", b"frames of left_palm")
    assert client.json("GET", "/api/jobs")["jobs"] == []  # an incomplete upload is not a job
    assert client.json("POST", f"/api/uploads/{key}/finish")["name"] == "kitchen walk"
    assert bench.run_once() == 0, bench.lines
    assert (
        bench.job("kitchen walk").input / "left_palm" / "GX010001.MP4"
    ).read_bytes() == b"frames of left_palm"


@pytest.mark.parametrize(
    ("name", "body", "code"),
    [
        ("../torso.mp4", b"x", (400, 404)),
        ("..%2ftorso.mp4", b"x", (400, 404)),
        ("%2e%2e/torso.mp4", b"x", (400, 404)),
        ("a/b/torso.mp4", b"x", (400,)),
        (".torso.mp4", b"x", (400,)),
        ("%00.mp4", b"x", (400,)),
        ("x" * 250 + ".mp4", b"x", (400,)),
        ("job.yaml/torso.mp4", b"x", (400,)),
        ("torso.exe", b"x", (400,)),
        ("torso.mp4", b"", (413,)),
        ("torso.mp4", b"x" * 20_000, (413,)),
    ],
    ids=lambda value: str(value)[:30],
)
def test_uploaded_files_are_checked(
    bench: SpoolFixture, client: Client, name: str, body: bytes, code: tuple[int, ...]
) -> None:
    key = client.begin("walk")
    found, data, _ = client.ask("PUT", f"/api/uploads/{key}/{name}", body)
    assert found in code, data
    assert client.ask("POST", f"/api/uploads/{key}/finish")[0] == 400  # there is no video
    files = [path for path in bench.folder.rglob("*") if path.is_file()]
    assert files == [bench.orders]


def test_the_number_of_uploads_is_limited(bench: SpoolFixture, client: Client) -> None:
    keys = [client.begin(f"walk {number}") for number in range(8)]
    assert client.ask("POST", "/api/uploads", {"name": "one more"})[0] == 400
    assert client.ask("DELETE", f"/api/uploads/{keys[0]}")[0] == 200
    assert client.ask("POST", "/api/uploads", {"name": "../up"})[0] == 400
    assert client.ask("POST", "/api/uploads", b"no JSON")[0] == 400
    client.begin("one more")
    assert client.ask("PUT", "/api/uploads/unknown/torso.mp4", b"x")[0] == 400


class PartialUpload:
    """A file of 1,000 bytes; the first half has been sent."""

    def __init__(self, client: Client, key: str, name: str) -> None:
        self.connection = http.client.HTTPConnection(client.host, timeout=30)
        self.connection.putrequest("PUT", f"/api/uploads/{key}/{name}")
        self.connection.putheader("Origin", f"http://{client.host}")
        self.connection.putheader("Content-Length", "1000")
        self.connection.endheaders()
        self.connection.send(b"x" * 500)

    def send_rest(self) -> tuple[int, bytes]:
        self.connection.send(b"x" * 500)
        answer = self.connection.getresponse()
        found = answer.status, answer.read()
        self.connection.close()
        return found


@pytest.mark.parametrize("name", ["torso.mp4", "TORSO.mp4"])
def test_a_file_cannot_be_sent_by_two_requests(bench: SpoolFixture, client: Client, name: str) -> None:
    key = client.begin("walk")
    partial = PartialUpload(client, key, "torso.mp4")
    wait_for(lambda: any(bench.spool.inbox.glob(".upload-*/*.part")))
    code, data, _ = client.ask("PUT", f"/api/uploads/{key}/{name}", b"y" * 1000)
    assert (code, json.loads(data)["message"]) == (400, f"{name} was sent twice")
    code, data, _ = client.ask("PUT", f"/api/uploads/{key}/torso.mp4/a.mp4", b"y")
    assert (code, json.loads(data)["message"]) == (400, "torso.mp4/a.mp4 is both a file and a folder")
    assert partial.send_rest()[0] == 200
    assert client.json("POST", f"/api/uploads/{key}/finish")["name"] == "walk"
    assert (bench.spool.inbox / "walk" / "torso.mp4").read_bytes() == b"x" * 1000


def test_a_folder_is_not_finished_while_a_file_is_being_sent(bench: SpoolFixture, client: Client) -> None:
    key = client.begin("walk")
    client.json("PUT", f"/api/uploads/{key}/head.mp4", b"frames of head")
    partial = PartialUpload(client, key, "torso.mp4")
    wait_for(lambda: any(bench.spool.inbox.glob(".upload-*/*.part")))
    code, data, _ = client.ask("POST", f"/api/uploads/{key}/finish")
    assert (code, json.loads(data)["message"]) == (400, "torso.mp4: the browser is still sending this file")
    assert partial.send_rest()[0] == 200
    client.json("POST", f"/api/uploads/{key}/finish")
    code, _, _ = client.ask("POST", f"/api/uploads/{key}/finish")
    assert code == 400, "there is no such upload any more"
    files = sorted(path.name for path in (bench.spool.inbox / "walk").iterdir())
    assert files == ["READY", "head.mp4", "torso.mp4"]


def test_a_discarded_upload_is_removed_while_a_file_is_being_sent(
    bench: SpoolFixture, client: Client
) -> None:
    key = client.begin("walk")
    partial = PartialUpload(client, key, "torso.mp4")
    wait_for(lambda: any(bench.spool.inbox.glob(".upload-*/*.part")))
    assert client.ask("DELETE", f"/api/uploads/{key}")[0] == 200
    code, data = partial.send_rest()
    assert (code, json.loads(data)["message"]) == (400, "the upload does not exist or has ended")
    assert list(bench.spool.inbox.iterdir()) == []


def test_an_interrupted_upload_is_removed_with_the_page(bench: SpoolFixture) -> None:
    with LivePage(bench.spool, Access(host="127.0.0.1", port=0), Limits()) as page:
        client = Client(page)
        key = client.begin("walk")
        partial = PartialUpload(client, key, "torso.mp4")
        wait_for(lambda: any(bench.spool.inbox.glob(".upload-*/*.part")))
        partial.connection.close()
        wait_for(lambda: not any(bench.spool.inbox.glob(".upload-*/*.part")))
    assert list(bench.spool.inbox.iterdir()) == []


def test_a_starting_page_removes_the_uploads_of_a_killed_page(bench: SpoolFixture) -> None:
    (bench.spool.inbox / ".upload-left").mkdir()
    bench.drop("walk")
    with LivePage(bench.spool, Access(host="127.0.0.1", port=0), Limits()):
        assert [path.name for path in bench.spool.inbox.iterdir()] == ["walk"]


def test_a_port_in_use_is_named(bench: SpoolFixture, page: LivePage) -> None:
    with pytest.raises(JobError, match=str(page.access.port)):
        LivePage(bench.spool, page.access, Limits())


def test_the_command_serves_the_page_and_ends_with_it(bench: SpoolFixture) -> None:
    process = bench.start("watch", "jobs/inbox", "--web", "127.0.0.1:0")
    assert process.stderr is not None
    lines = iter(process.stderr.readline, "")
    url = next(line.split()[-1] for line in lines if "live page" in line)
    connection = http.client.HTTPConnection(url.removeprefix("http://").rstrip("/"), timeout=30)
    connection.request("GET", "/api/events")  # a stream that never ends by itself
    assert connection.getresponse().status == 200
    process.terminate()
    assert process.wait(30) == 143
    _, err = bench.start("watch", "jobs/inbox", "--web", "0.0.0.0:0").communicate(timeout=60)
    assert "BODYCAP_WEB_TOKEN" in err
    assert "Traceback" not in err


@pytest.fixture
def browser() -> Iterator[Any]:
    from playwright import sync_api

    if CHROMIUM is None:
        pytest.skip("needs Chromium")
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.mark.browser
@pytest.mark.slow
def test_the_page_shows_the_jobs_and_accepts_videos(
    bench: SpoolFixture, page: LivePage, browser: Any
) -> None:
    messages: list[str] = []
    tab = browser.new_page(viewport={"width": 900, "height": 900})
    tab.on("console", lambda message: messages.append(message.text))
    tab.on("pageerror", lambda error: messages.append(str(error)))
    tab.goto(page.access.url)
    tab.wait_for_function("document.getElementById('connection').textContent === 'live'")
    assert tab.inner_text("#summary") == "No jobs yet."

    # Drop the videos of a folder onto the page.
    tab.evaluate(
        """() => {
        const transfer = new DataTransfer();
        for (const name of ["torso.mp4", "left_palm.mp4"]) {
          transfer.items.add(new File([`frames ${name}`], name));
        }
        document.getElementById("name").value = "<img src=x";
        const drop = new DragEvent("drop", {dataTransfer: transfer, bubbles: true});
        document.getElementById("drop").dispatchEvent(drop);
        }"""
    )
    # The page asks for the height before it sends the videos, and refuses a height that nobody has.
    tab.fill("#uploads input[name=height]", "17,5")
    tab.click("#uploads button:text-is('Start')")
    tab.wait_for_selector("#uploads .cause >> text=not plausible")
    tab.fill("#uploads input[name=height]", "1,75")
    tab.click("#uploads button:text-is('Start')")
    tab.wait_for_selector("#jobs .state.waiting")
    (dropped,) = bench.spool.inbox.glob("[!.]*")
    assert "height_m: 1.75" in (dropped / "job.yaml").read_text()
    assert tab.inner_text("#jobs .name") == "<img src=x"  # shown as text, not as HTML
    bench.order(hang="map")
    watcher = bench.watcher(once=False)
    thread = threading.Thread(target=watcher.run)
    thread.start()
    try:
        tab.wait_for_selector("#jobs .state.running")
        tab.wait_for_selector("#jobs progress[aria-label='map']")
        tab.click("button:text-is('Log')")
        tab.wait_for_selector("#jobs pre >> text=keyframes torso: finished")
        tab.screenshot(path=str(bench.folder / "running.png"))
        tab.click("button:text-is('Cancel')")
        tab.wait_for_selector("#jobs .state.cancelled", timeout=15_000)
        bench.order()
        tab.click("button:text-is('Retry')")
        tab.wait_for_selector("#jobs .state.done", timeout=60_000)
        assert len(tab.query_selector_all("#jobs > li")) == 1
        tab.click("button:text-is('Files')")
        with tab.expect_navigation():
            tab.click("text=metrics.json")
        assert "partial" in tab.content()
        tab.go_back()
        # A file that a job does not use is not sent.
        tab.set_input_files("#files", files=[{"name": "notes.doc", "mimeType": "text/plain", "buffer": b"x"}])
        tab.wait_for_selector("#uploads .hint >> text=not sent, because a job does not use them: notes.doc")
    finally:
        watcher.stop()
        thread.join()
    # The browser itself reports the refused file, and the icon that it requested for the sandboxed result.
    assert [line for line in messages if "400" not in line and "NotSameOrigin" not in line] == []


@pytest.mark.browser
def test_the_page_asks_for_the_places_of_cameras_again_where_a_job_failed_for_them(
    bench: SpoolFixture, page: LivePage, browser: Any
) -> None:
    folder = bench.spool.inbox / "walk"
    folder.mkdir()
    for name in ("GX010120.MP4", "GX010121.MP4"):
        (folder / name).write_bytes(unopened(f"frames {name}"))
    (folder / "IMG_1.jpg").touch()
    assert bench.run_once() == 2
    tab = browser.new_page()
    tab.goto(page.access.url)
    tab.wait_for_selector("#jobs form.ask")
    tab.select_option("select[name='GX-0120']", "torso")
    tab.click("button:text-is('Start again')")
    assert bench.spool.failed.joinpath("walk").is_dir(), "the browser requires both places"
    tab.select_option("select[name='GX-0121']", "left_palm")
    tab.click("button:text-is('Start again')")
    tab.wait_for_selector("#jobs .state.waiting")
    assert bench.run_once() == 0, bench.lines
    tab.wait_for_selector("#jobs .state.done")


@pytest.mark.browser
def test_another_site_cannot_use_the_page(bench: SpoolFixture, page: LivePage, browser: Any) -> None:
    bench.drop("walk")
    tab = browser.new_page()
    tab.route(
        "http://evil.example/", lambda route: route.fulfill(body="<p>evil</p>", content_type="text/html")
    )
    tab.goto("http://evil.example/")
    outcome = tab.evaluate(
        """async (url) => {
        const outcomes = [];
        for (const [method, mode] of [["GET", "cors"], ["POST", "cors"], ["POST", "no-cors"]]) {
          try {
            const path = method === "GET" ? "api/jobs" : "api/jobs/walk/cancel";
            const answer = await fetch(url + path, {method, mode});
            outcomes.push(answer.type === "opaque" ? "opaque" : answer.status);
          } catch { outcomes.push("failed"); }
        }
        return outcomes;
        }""",
        page.access.url,
    )
    assert outcome[0] in ("failed", 403)
    assert outcome[1] in ("failed", 403)
    time.sleep(0.3)
    assert (bench.spool.inbox / "walk").is_dir()
