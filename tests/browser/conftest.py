"""A real browser: Debian's Chromium without a window. The tests are skipped if it is not installed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch.core.context import StageContext
from bodycap_batch.report import ReportInputs, write_report
from tests.bench.viewer import FLAGS, chromium
from tests.reports import report_inputs

NO_3D = ("--no-sandbox", "--disable-3d-apis")
_HARMLESS = ("GL Driver Message",)
"""A message of Chromium's software renderer about reading pixels; the page cannot avoid it."""


class Pages:
    """Opens addresses in one browser and records messages of their consoles and their requests."""

    def __init__(self, browser: Any) -> None:
        self.browser = browser
        self.messages: list[str] = []
        self.requested_urls: list[str] = []

    def open(self, address: str, **options: Any) -> Any:
        """Open a new page; the options are those of Playwright's `new_context`.

        Without other options, the motion does not play by itself.
        """
        usual = {"viewport": {"width": 1100, "height": 800}, "reduced_motion": "reduce"}
        page = self.browser.new_context(**{**usual, **options}).new_page()
        page.on("console", lambda line: self._record(line.type, line.text))
        page.on("pageerror", lambda error: self._record("error", str(error)))
        page.on("request", lambda request: self.requested_urls.append(request.url))
        page.goto(address)
        return page

    def _record(self, kind: str, text: str) -> None:
        if kind in ("error", "warning") and not any(words in text for words in _HARMLESS):
            self.messages.append(f"{kind}: {text}")


def launch(flags: tuple[str, ...]) -> Iterator[Any]:
    path = chromium()
    if path is None:
        pytest.skip("no Chromium is installed (Debian: apt install chromium)")
    from playwright import sync_api

    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=path, args=list(flags))
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def browser(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Start a browser with software WebGL, or with the flags of a parametrised test."""
    yield from launch(getattr(request, "param", FLAGS))


@pytest.fixture
def pages(browser: Any) -> Pages:
    return Pages(browser)


@pytest.fixture(scope="session")
def inputs() -> ReportInputs:
    return report_inputs()


@pytest.fixture(scope="session")
def report(tmp_path_factory: pytest.TempPathFactory, inputs: ReportInputs) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_report(inputs, folder / "report.html", StageContext(work_dir=folder))
    return folder / "report.html"
