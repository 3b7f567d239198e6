"""Frame rate of the report's viewer in software, without a graphics card."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

POINTS, FRAMES, SIZE = 50_000, 1_000, (960, 540)
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--no-sandbox", "--enable-unsafe-swiftshader")
_FILL = "position:fixed;left:0;top:0;width:{}px;height:{}px;z-index:99;aspect-ratio:auto"


def chromium() -> str | None:
    """Return the path of the installed browser, or None."""
    import shutil

    return next((path for name in CHROMIUM if (path := shutil.which(name))), None)


def run(seconds: float = 4.0) -> dict[str, Any]:
    """Return the frames per second while the scene turns and plays, and the fraction of points drawn."""
    from playwright.sync_api import sync_playwright

    from bodycap_batch.core.context import StageContext
    from bodycap_batch.report import write_report
    from tests.reports import report_inputs

    browser_path = chromium()
    if browser_path is None:
        return {"viewer": "no Chromium is installed"}
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
        page_path = Path(folder) / "report.html"
        write_report(report_inputs(FRAMES, POINTS), page_path, StageContext(work_dir=Path(folder)))
        browser = play.chromium.launch(executable_path=browser_path, args=list(FLAGS))
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(page_path.as_uri())
        page.wait_for_selector("section.viewer[data-mode=webgl]")
        page.evaluate(f"document.querySelector('.solid').style.cssText = '{_FILL.format(*SIZE)}'")
        page.wait_for_timeout(500)
        smooth = page.evaluate(f"bodycap.fps({seconds})")
        whole = page.evaluate(f"(bodycap.view.adapts = false, bodycap.fps({seconds}))")
        gpu = page.evaluate("bodycap.view.gpu")
        browser.close()
    return {"viewer": gpu, "fps": smooth["fps"], "share": smooth["share"], "fps_all_points": whole["fps"]}


def lines_of(result: dict[str, Any]) -> list[str]:
    """Return the figures as text."""
    if "fps" not in result:
        return [f"viewer: {result['viewer']}"]
    width, height = SIZE
    drawn = f"{result['fps']:.0f} frames/s with {result['share']:.0%} of them while it moves"
    return [
        f"viewer: {POINTS:,} points, {FRAMES:,} frames, {width}x{height}: {drawn}, "
        f"{result['fps_all_points']:.0f} with all ({result['viewer']})"
    ]
