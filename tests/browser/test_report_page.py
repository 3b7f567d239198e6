"""The report in a real browser: it draws, plays, shows the right figures and needs no network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch.core.context import StageContext
from bodycap_batch.report import ReportInputs, write_report
from bodycap_batch.report.metric_paths import metric_at
from tests.browser.conftest import NO_3D, Pages

pytestmark = [pytest.mark.browser, pytest.mark.slow]

WEBGL = "Boolean(document.createElement('canvas').getContext('webgl2'))"


def viewer_pixels(page: Any) -> bytes:
    """Return a screenshot of the 3D view after the pending frame is drawn."""
    page.wait_for_timeout(400)
    return bytes(page.locator(".solid").screenshot())


def test_it_draws_in_3d_without_messages_or_requests(pages: Pages, report: Path) -> None:
    page = pages.open(report.as_uri())
    assert page.evaluate(WEBGL), "the browser has no WebGL: the test would prove nothing"
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    assert page.locator(".nogl").is_hidden()
    assert len(set(viewer_pixels(page))) > 100
    assert pages.messages == []
    assert [url for url in pages.requested_urls if not url.startswith(("file:", "data:", "blob:"))] == []
    assert [url for url in pages.requested_urls if url.startswith("file:")] == [report.as_uri()]


SCREEN_EXTENT = """() => {
  const { view } = bodycap;
  const p = new view.three.Vector3();
  const ends = [0, 0];
  for (const each of [view.data.body.centres, ...view.data.paths.map((path) => path.centre)])
    for (let i = 0; i < each.length; i += 3) {
      if (!Number.isFinite(each[i])) continue;
      p.fromArray(each, i).project(view.camera);
      ends[0] = Math.max(ends[0], Math.abs(p.x));
      ends[1] = Math.max(ends[1], Math.abs(p.y));
    }
  return ends;
}"""


PERSON_EXTENT = """() => {
  const { view } = bodycap;
  const p = new view.three.Vector3();
  const ends = [0, 0];
  for (let i = 0; i < view.centres.length; i += 3) {
    p.fromArray(view.centres, i).project(view.camera);
    ends[0] = Math.max(ends[0], Math.abs(p.x));
    ends[1] = Math.max(ends[1], Math.abs(p.y));
  }
  return ends;
}"""


@pytest.mark.parametrize("width", [1400, 400])
def test_it_starts_with_the_person_who_fills_the_view(pages: Pages, report: Path, width: int) -> None:
    page = pages.open(report.as_uri())
    page.set_viewport_size({"width": width, "height": 900})
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    page.wait_for_timeout(400)
    assert page.is_checked("[data-layer=follow]")
    for look in ("", "front", "side", "top"):
        if look:
            page.click(f"[data-look={look}]")
            page.wait_for_timeout(200)
        across, up = page.evaluate(PERSON_EXTENT)
        # With room for the head above its joint, and for the feet.
        assert max(across, up) < 0.95, look
        assert max(across, up) > (0.2 if look == "top" else 0.6), look


def test_a_person_who_stands_up_after_the_start_stays_in_the_view(pages: Pages, report: Path) -> None:
    page = pages.open(report.as_uri())
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    page.evaluate("""() => {
      const { data, view, timeline } = bodycap;
      for (let i = 2; i < 3 * data.body.count; i += 3) data.body.centres[i] *= 0.5;
      timeline.go(0);
      view.look("person");
      timeline.go(timeline.steps);
    }""")
    page.wait_for_timeout(300)
    _, up = page.evaluate(PERSON_EXTENT)
    assert up < 1.0


def test_it_plays_by_itself_unless_the_user_wants_less_motion(pages: Pages, report: Path) -> None:
    page = pages.open(report.as_uri(), reduced_motion="no-preference")
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    page.wait_for_function("() => bodycap.timeline.step > 3")
    quiet = pages.open(report.as_uri(), reduced_motion="reduce")
    quiet.wait_for_selector("section.viewer[data-mode=webgl]")
    quiet.wait_for_timeout(400)
    assert quiet.evaluate("bodycap.timeline.step") == 0


def test_front_and_side_follow_the_direction_of_the_person(pages: Pages, report: Path) -> None:
    """The person faces −Y at the start, so the front view looks from −Y and the side view from +X."""
    page = pages.open(report.as_uri())
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    away = "() => bodycap.view.orbit.eye().map((value, i) => value - bodycap.view.orbit.target[i])"
    for look, axis, sign in (("front", 1, -1), ("side", 0, 1), ("top", 2, 1)):
        page.click(f"[data-look={look}]")
        way = page.evaluate(away)
        assert sign * way[axis] > 0.95 * sum(value**2 for value in way) ** 0.5, look


@pytest.mark.parametrize("width", [1400, 400])
def test_the_whole_room_shows_the_body_and_all_paths(pages: Pages, report: Path, width: int) -> None:
    page = pages.open(report.as_uri())
    page.set_viewport_size({"width": width, "height": 900})
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    page.click("#reset")
    page.wait_for_timeout(400)
    across, up = page.evaluate(SCREEN_EXTENT)
    # Everything is visible, and not too small.
    assert max(across, up) < 1.0
    assert max(across, up) > 0.8
    page.evaluate("bodycap.view.orbit.zoom(0.5)")
    near = page.evaluate("bodycap.view.orbit.distance")
    page.set_viewport_size({"width": width + 100, "height": 900})
    page.wait_for_timeout(400)
    assert page.evaluate("bodycap.view.orbit.distance") == near, "a view that the user has changed is kept"


def test_a_followed_body_stays_in_the_middle_when_the_window_changes(pages: Pages, report: Path) -> None:
    page = pages.open(report.as_uri())
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    page.check("[data-layer=follow]")
    page.locator("#time").focus()
    page.keyboard.press("End")
    page.wait_for_timeout(400)
    followed = page.evaluate("bodycap.view.orbit.target")
    assert followed != page.evaluate("bodycap.view.orbit.home.target")
    page.set_viewport_size({"width": 500, "height": 900})
    page.wait_for_timeout(400)
    assert page.evaluate("bodycap.view.orbit.target") == followed


def test_the_slider_moves_the_skeleton(pages: Pages, report: Path) -> None:
    page = pages.open(report.as_uri())
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    for layer in ("points", "paths", "keyframes", "cameras"):
        page.uncheck(f"[data-layer={layer}]")
    first = viewer_pixels(page)
    assert viewer_pixels(page) == first
    page.locator("#time").focus()
    page.keyboard.press("End")
    last = viewer_pixels(page)
    assert last != first
    page.keyboard.press("Home")
    assert viewer_pixels(page) == first
    page.uncheck("[data-layer=body]")
    assert viewer_pixels(page) != first
    assert page.locator("#clock").inner_text() == "5.00 s"


def test_the_figures_on_the_page_are_those_of_the_metrics(
    pages: Pages, report: Path, inputs: ReportInputs
) -> None:
    page = pages.open(report.as_uri())
    assert inputs.metrics is not None
    found = page.evaluate(
        "[...document.querySelectorAll('[data-metric]')].map(e => [e.dataset.metric, e.dataset.value])"
    )
    assert len(found) > 40
    for place, value in found:
        assert float(value) == metric_at(inputs.metrics, place)
    registered = inputs.metrics["total"]["frames_registered"]
    assert f"{registered:,}" in page.locator(".figures dd").first.inner_text()


def test_it_plays_and_reacts_to_the_keyboard(pages: Pages, report: Path) -> None:
    from playwright.sync_api import expect

    page = pages.open(report.as_uri())
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    page.locator(".solid").focus()
    page.keyboard.press("Space")
    assert page.locator("#play").inner_text() == "Pause"
    expect(page.locator("#clock")).not_to_have_text("5.00 s")
    page.keyboard.press("Space")
    assert page.locator("#play").get_attribute("aria-pressed") == "false"
    step = page.evaluate("bodycap.timeline.step")
    page.keyboard.press(".")
    assert page.evaluate("bodycap.timeline.step") == step + 1
    before = page.evaluate("bodycap.view.orbit.azimuth")
    page.keyboard.press("ArrowLeft")
    assert page.evaluate("bodycap.view.orbit.azimuth") != before
    box = page.locator(".solid").bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 160, box["y"] + 120)
    page.mouse.up()
    assert page.evaluate("bodycap.view.orbit.azimuth") < before


def test_every_control_can_be_reached_with_tab_and_has_a_name(pages: Pages, report: Path) -> None:
    page = pages.open(report.as_uri())
    nameless = page.evaluate(
        """[...document.querySelectorAll('button, input, select, svg[role=img], img, [role=application]')]
        .filter(e => !e.closest('[hidden]') && !e.hidden)
        .filter(e => !(e.labels?.length || e.getAttribute('aria-label') || e.textContent.trim()
                       || e.getAttribute('alt'))).map(e => e.outerHTML.slice(0, 80))"""
    )
    assert nameless == []
    reached = set()
    for _ in range(30):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.className"))
    assert {"skip", "solid", "play", "time", "camera", "reset"} <= reached
    assert page.evaluate("document.documentElement.lang") == "en"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_enough_contrast_in_both_schemes(pages: Pages, report: Path, scheme: str) -> None:
    page = pages.open(report.as_uri(), color_scheme=scheme)
    # Contrast by the relative luminance of WCAG 2, which requires 4.5 for text.
    contrast = page.evaluate(
        """() => {
          const pen = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
          const light = (css) => {
            pen.clearRect(0, 0, 1, 1); pen.fillStyle = css; pen.fillRect(0, 0, 1, 1);
            const [r, g, b] = [...pen.getImageData(0, 0, 1, 1).data].slice(0, 3)
              .map(v => v / 255).map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
            return 0.2126 * r + 0.7152 * g + 0.0722 * b;
          };
          const style = getComputedStyle(document.documentElement);
          const paper = light(style.getPropertyValue('--sheet'));
          return ['--ink', '--soft', '--accent', '--good', '--fair', '--poor'].map(name => {
            const ink = light(style.getPropertyValue(name));
            return (Math.max(ink, paper) + 0.05) / (Math.min(ink, paper) + 0.05);
          });
        }"""
    )
    assert min(contrast) >= 4.5


def test_it_fits_the_screen_of_a_phone(pages: Pages, report: Path) -> None:
    page = pages.open(report.as_uri(), viewport={"width": 360, "height": 740})
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    assert page.evaluate("document.documentElement.scrollWidth") <= 360


def test_it_prints_without_its_controls(pages: Pages, report: Path) -> None:
    page = pages.open(report.as_uri())
    page.emulate_media(media="print")
    assert page.locator(".controls").is_hidden()
    assert page.locator("#verdict").is_visible()
    assert page.pdf()[:4] == b"%PDF"


def test_the_page_of_a_failed_job_shows_its_error(pages: Pages, inputs: ReportInputs, tmp_path: Path) -> None:
    failure = {"stage": "map", "type": "EstimationError", "message": "no pair to start from", "hint": "walk"}
    failed = ReportInputs(name="x", cameras=inputs.cameras, selections=inputs.selections, failure=failure)
    write_report(failed, tmp_path / "report.html", StageContext(work_dir=tmp_path))
    page = pages.open((tmp_path / "report.html").as_uri())
    assert "no pair to start from" in page.locator(".failure").inner_text()
    assert page.locator("section.viewer").count() == 0
    assert page.locator(".badge.good").count() == 0
    assert pages.messages == []


@pytest.mark.parametrize("browser", [NO_3D], indirect=True)
def test_without_webgl_it_shows_a_message_and_a_2d_drawing(pages: Pages, report: Path) -> None:
    page = pages.open(report.as_uri())
    assert not page.evaluate(WEBGL)
    page.wait_for_selector("section.viewer[data-mode=flat]")
    assert "no WebGL" in page.locator(".nogl").inner_text()
    for layer in ("points", "paths", "keyframes", "cameras"):
        page.uncheck(f"[data-layer={layer}]")
    first = viewer_pixels(page)
    page.locator("#time").focus()
    page.keyboard.press("End")
    assert viewer_pixels(page) != first
    assert pages.messages == []


def test_known_uncertainty_is_drawn(pages: Pages, inputs: ReportInputs, tmp_path: Path) -> None:
    write_report(replace(inputs, name="y"), tmp_path / "report.html", StageContext(work_dir=tmp_path))
    page = pages.open((tmp_path / "report.html").as_uri())
    known = page.evaluate("Boolean(bodycap.data.body.sigma)")
    assert page.locator("[data-layer=sigma]").count() == int(known)


def test_without_a_graphics_card_points_have_the_positions_of_the_renderer(
    pages: Pages, report: Path
) -> None:
    page = pages.open(report.as_uri())
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    with_points = viewer_pixels(page)
    inside, drawn = page.evaluate(
        """() => {
          const { three, camera, splat, data } = bodycap.view, { width, height } = splat.canvas;
          let [inside, drawn] = [0, 0];
          for (let i = 0; i < data.points.length; i += 3) {
            const seen = new three.Vector3(...data.points.slice(i, i + 3)).project(camera);
            if (!(Math.abs(seen.x) < 0.99 && Math.abs(seen.y) < 0.99 && seen.z < 1)) continue;
            const [x, y] = [(seen.x + 1) / 2 * width - 0.5, (1 - seen.y) / 2 * height - 0.5].map(Math.floor);
            inside += 1;
            drawn += splat.pixels[y * width + x] !== 0;
          }
          return [inside, drawn];
        }"""
    )
    assert inside > 50
    # Rounding may move a point at the edge of a pixel into the next one.
    assert drawn >= 0.97 * inside
    page.uncheck("[data-layer=points]")
    assert viewer_pixels(page) != with_points
    assert page.evaluate("bodycap.view.splat.pixels.every((pixel) => pixel === 0)")
    page.check("[data-layer=points]")
    page.wait_for_timeout(400)
    assert page.evaluate("bodycap.view.splat.pixels.some(Boolean)")


def test_without_a_graphics_card_a_view_without_size_is_drawn_when_it_gets_one(
    pages: Pages, report: Path, tmp_path: Path
) -> None:
    hidden = tmp_path / "hidden.html"
    text = report.read_text(encoding="utf-8")
    hidden.write_text(text.replace("</style>", ".solid { display: none; }</style>", 1), encoding="utf-8")
    page = pages.open(hidden.as_uri())
    page.wait_for_selector("section.viewer[data-mode=webgl]")
    page.wait_for_timeout(400)
    page.add_style_tag(content=".solid { display: block !important; }")
    page.wait_for_timeout(400)
    assert page.evaluate("bodycap.view.splat.pixels.some(Boolean)")
    assert pages.messages == []
