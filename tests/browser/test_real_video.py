"""`bodycap view` in a real browser: the video plays, and the overlay is that of the displayed frame."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch.capture import Capture, open_capture
from bodycap_batch.config.models import CaptureConfig
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.report import write_report
from bodycap_batch.report.frame_overlays import FrameOverlays
from bodycap_batch.report.serving import FRAMES_PER_PART, LOOPBACK, make_served_content, make_server
from tests.browser.conftest import Pages
from tests.reports import report_inputs
from tests.videos import textured_frame, write_video

pytestmark = [pytest.mark.browser, pytest.mark.slow]

FRAMES, CHAPTERS = 48, 2
"""Frames of a chapter, and chapters of a camera. The grey level of a frame encodes its number."""
START_S = 5.0

# Records for each displayed frame its number, read from its pixels, and the frame number of the overlay.
WATCH = """() => {
  const video = document.querySelector('.frame video');
  const pen = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
  window.seen = []; window.seeks = 0;
  video.addEventListener('seeking', () => (window.seeks += 1));
  const look = () => {
    pen.drawImage(video, 0, 0, 64, 48);
    const grey = pen.getImageData(48, 36, 1, 1).data[0];
    const chapter = Number(video.currentSrc.split('/').at(-1));
    return [Math.round((grey - 40) / 4) + 48 * chapter, Number(video.parentElement.dataset.index)];
  };
  const note = () => {
    window.seen.push(look());
    video.requestVideoFrameCallback(note);
  };
  window.look = () => String(look());
  video.requestVideoFrameCallback(note);
}"""


def wait_for(page: Any, expression: str) -> None:
    """Wait until an expression is true.

    It is evaluated from outside, because the page's security policy forbids evaluation inside.
    """
    for _ in range(600):
        if page.evaluate(f"Boolean({expression})"):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"never true: {expression}")


def make_capture(folder: Path, cameras: tuple[str, ...]) -> Capture:
    """Return a capture with frames that encode their number, in two chapters for each camera."""
    frames = [textured_frame(index) for index in range(FRAMES)]
    cameras_config = []
    for name in cameras:
        chapters = [write_video(folder / f"{name}_{index}.mp4", frames) for index in range(CHAPTERS)]
        lens = {"model": "PINHOLE", "params": [60.0, 60.0, 32.0, 24.0], "width": 64, "height": 48}
        cameras_config.append(
            {
                "name": name,
                "video": list(map(str, chapters)),
                "calibration": lens,
                "mount": "torso",
            }
        )
    opened = open_capture(CaptureConfig.model_validate({"cameras": cameras_config}))
    clock = ClockRelation(offset_s=START_S)
    return Capture(cameras=tuple(replace(camera, clock=clock) for camera in opened.cameras))


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("film")
    inputs = report_inputs(FRAMES * CHAPTERS)
    inputs = replace(inputs, capture=make_capture(folder, inputs.cameras))
    assert inputs.capture is not None
    write_report(inputs, folder / "report.html", StageContext(work_dir=folder))
    overlays = FrameOverlays(inputs)
    served = make_served_content(
        folder / "report.html",
        inputs.capture,
        lambda camera, first: overlays.describe_part(camera, first, FRAMES_PER_PART),
    )
    server = make_server(served)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://{LOOPBACK}:{server.server_port}/report.html?videos"
    server.shutdown()
    thread.join()
    server.server_close()


def test_the_real_video_plays_without_seeking_and_with_the_overlay_of_every_frame(
    pages: Pages, address: str
) -> None:
    page = pages.open(address)
    wait_for(page, "bodycap.picture.film.active && document.querySelector('video').readyState >= 2")
    page.evaluate(WATCH)
    page.click("#play")
    wait_for(page, "document.getElementById('play').textContent === 'Play'")
    seen, seeks = page.evaluate("[window.seen, window.seeks]")
    # One at the start of each chapter and one at the end. One for each frame would be 96.
    assert seeks <= 6
    numbers = [number for number, _ in seen]
    # A browser with software rendering may skip frames. Half of them must come, in order, from both chapters.
    assert len(set(numbers)) >= FRAMES * CHAPTERS // 2
    assert max(numbers) >= FRAMES * CHAPTERS - 3
    assert numbers == sorted(numbers)
    # If the browser is late, the canvas may already have the next frame, but never an earlier one.
    late = [number - marked for number, marked in seen]
    assert set(late) <= {0, 1}
    assert late.count(0) >= 0.8 * len(late)
    assert pages.messages == []


def test_the_slider_shows_the_frame_of_its_time_with_its_overlay(pages: Pages, address: str) -> None:
    page = pages.open(address)
    wait_for(page, "bodycap.picture.film.active && document.querySelector('video').readyState >= 2")
    page.evaluate(WATCH)
    for step in (31, 60, 7):
        page.evaluate(f"bodycap.timeline.go({step})")
        wait_for(page, f"window.look() === '{step},{step}'")
        wait_for(page, "bodycap.picture.shown.status")
        drawn = page.evaluate("bodycap.picture.lines.inlier.getAttribute('d').length")
        assert drawn > 100
        assert f"frame {step + 1} of {FRAMES * CHAPTERS}" in page.locator("#now").inner_text()


def test_a_chapter_is_shown_in_a_browser_that_decodes_nothing_before_a_seek(
    pages: Pages, address: str
) -> None:
    page = pages.open(address)
    wait_for(page, "bodycap.picture.film.active && document.querySelector('video').readyState >= 2")
    page.evaluate(WATCH)
    # This simulates a browser that stops after the metadata and never reports a frame.
    page.evaluate("document.addEventListener('loadeddata', (event) => event.stopPropagation(), true)")
    page.evaluate("bodycap.timeline.go(60)")
    wait_for(page, "window.look() === '60,60'")


def test_a_video_that_the_browser_cannot_play_is_replaced_by_pictures(pages: Pages, address: str) -> None:
    context = pages.browser.new_context()
    page = context.new_page()
    page.route("**/video/*/*", lambda route: route.fulfill(body=b"no video", content_type="video/mp4"))
    page.goto(address)
    page.wait_for_selector(".nofilm:not([hidden])")
    assert "does not play" in page.locator(".nofilm").inner_text()
    page.evaluate("bodycap.timeline.go(20)")
    assert page.locator(".frame img").is_visible()
    assert page.locator(".frame video").is_hidden()
