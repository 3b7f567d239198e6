"""`bodycap view` in a real browser: the video plays by itself, and its marks fit the frame that is shown."""

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
from bodycap_batch.report import write_report
from bodycap_batch.report.frame_overlays import FrameOverlays
from bodycap_batch.report.serving import FRAMES_PER_PART, LOOPBACK, make_served_content, make_server
from tests.browser.conftest import Pages
from tests.reports import report_inputs
from tests.videos import textured_frame, write_video

pytestmark = [pytest.mark.browser, pytest.mark.slow]

FRAMES, CHAPTERS = 48, 2
"""In each chapter; the frame's grey level tells which it is."""
START_S = 5.0

# At each frame that is shown: which one it is by its own pixels, and which one the marks are of.
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


def wait(page: Any, expression: str) -> None:
    """Until it is true: asked from outside, for the page's own policy lets nothing be evaluated inside."""
    for _ in range(600):
        if page.evaluate(f"Boolean({expression})"):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"never true: {expression}")


def filmed(folder: Path, cameras: tuple[str, ...]) -> Capture:
    """A capture whose frames tell their number, in two chapters a camera."""
    frames = [textured_frame(index) for index in range(FRAMES)]
    described = []
    for name in cameras:
        chapters = [write_video(folder / f"{name}_{index}.mp4", frames) for index in range(CHAPTERS)]
        lens = {"model": "PINHOLE", "params": [60.0, 60.0, 32.0, 24.0], "width": 64, "height": 48}
        described.append(
            {
                "name": name,
                "video": list(map(str, chapters)),
                "calibration": lens,
                "offset_s": START_S,
                "mount": "torso",
            }
        )
    return open_capture(CaptureConfig.model_validate({"cameras": described}))


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("film")
    inputs = report_inputs(FRAMES * CHAPTERS)
    inputs = replace(inputs, capture=filmed(folder, inputs.cameras))
    assert inputs.capture is not None
    write_report(inputs, folder / "report.html", StageContext(work_dir=folder))
    marks = FrameOverlays(inputs)
    served = make_served_content(
        folder / "report.html",
        inputs.capture,
        lambda camera, first: marks.describe_part(camera, first, FRAMES_PER_PART),
    )
    server = make_server(served)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://{LOOPBACK}:{server.server_port}/report.html?videos"
    server.shutdown()
    thread.join()
    server.server_close()


def test_the_real_video_plays_without_seeking_and_its_marks_fit_every_frame(
    pages: Pages, address: str
) -> None:
    page = pages.open(address)
    wait(page, "bodycap.picture.film.active && document.querySelector('video').readyState >= 2")
    page.evaluate(WATCH)
    page.click("#play")
    wait(page, "document.getElementById('play').textContent === 'Play'")
    seen, seeks = page.evaluate("[window.seen, window.seeks]")
    # one at the start of each chapter, and one where the slider comes to rest; 96 frames would be as many
    assert seeks <= 6
    numbers = [number for number, _ in seen]
    # a software browser may skip frames; half of them, in order, through both chapters
    assert len(set(numbers)) >= FRAMES * CHAPTERS // 2
    assert max(numbers) >= FRAMES * CHAPTERS - 3
    assert numbers == sorted(numbers)
    # the canvas may be given the next frame already when the browser is late; never an earlier one
    late = [number - marked for number, marked in seen]
    assert set(late) <= {0, 1}
    assert late.count(0) >= 0.8 * len(late)
    assert pages.said == []


def test_the_slider_shows_the_frame_of_its_time_with_its_own_marks(pages: Pages, address: str) -> None:
    page = pages.open(address)
    wait(page, "bodycap.picture.film.active && document.querySelector('video').readyState >= 2")
    page.evaluate(WATCH)
    for step in (31, 60, 7):
        page.evaluate(f"bodycap.timeline.go({step})")
        wait(page, f"window.look() === '{step},{step}'")
        wait(page, "bodycap.picture.shown.status")
        drawn = page.evaluate("bodycap.picture.lines.inlier.getAttribute('d').length")
        assert drawn > 100
        assert f"frame {step + 1} of {FRAMES * CHAPTERS}" in page.locator("#now").inner_text()


def test_a_chapter_of_which_nothing_is_decoded_unasked_is_shown_all_the_same(
    pages: Pages, address: str
) -> None:
    page = pages.open(address)
    wait(page, "bodycap.picture.film.active && document.querySelector('video').readyState >= 2")
    page.evaluate(WATCH)
    # as of a browser that stops at the metadata: it never says that it has a frame
    page.evaluate("document.addEventListener('loadeddata', (event) => event.stopPropagation(), true)")
    page.evaluate("bodycap.timeline.go(60)")
    wait(page, "window.look() === '60,60'")


def test_a_video_that_the_browser_does_not_play_is_told_and_pictures_stay(pages: Pages, address: str) -> None:
    context = pages.browser.new_context()
    page = context.new_page()
    page.route("**/video/*/*", lambda route: route.fulfill(body=b"no video", content_type="video/mp4"))
    page.goto(address)
    page.wait_for_selector(".nofilm:not([hidden])")
    assert "does not play" in page.locator(".nofilm").inner_text()
    page.evaluate("bodycap.timeline.go(20)")
    assert page.locator(".frame img").is_visible()
    assert page.locator(".frame video").is_hidden()
