"""Pictogram, curves and links of the page: what was measured is told from what was not."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from bodycap_batch.report.figures.motion_curves import Take, draw_motion_curves
from bodycap_batch.report.figures.pictogram import draw_pictogram
from bodycap_batch.report.result_links import describe_files
from tests.bodies import reaching
from tests.steps import walking


def test_the_pictogram_shows_each_state() -> None:
    motion = reaching(20)
    observed = np.zeros_like(motion.observed)
    roles = motion.skeleton.roles
    observed[:, roles.index("LeftArm")] = True
    observed[:10, roles.index("RightArm")] = True
    filled = np.array([role.endswith("Leg") for role in roles])
    drawing = draw_pictogram(replace(motion, observed=observed), filled)
    kinds = re.findall(r'class="(measured|partly|filled|unknown)"', drawing)
    assert kinds.count("measured") == 1
    assert kinds.count("partly") == 1
    assert kinds.count("filled") == 4
    assert kinds.count("unknown") > 6
    # Seen from the front, the left arm is on the right.
    (x1,) = re.findall(r'class="measured" x1="([\d.]+)"', drawing)
    assert float(x1) > 84


def test_unmeasured_spans_are_shaded_and_dashed() -> None:
    motion, _ = walking(60)
    observed = np.ones_like(motion.observed)
    observed[20:40, motion.skeleton.roles.index("LeftHand")] = False
    take = Take(name="a", motion=replace(motion, observed=observed), start_s=5.0)
    drawing = draw_motion_curves([take], (5.0, 7.0))
    assert drawing.count('class="unmeasured"') == 1
    assert drawing.count('guessed"') == 1
    assert 'class="contact take0"' in drawing
    assert "assumed" not in drawing
    unseen = Take(name="a", motion=motion, start_s=5.0)
    assert 'class="contact take0 assumed"' in draw_motion_curves([unseen], (5.0, 7.0))


def test_two_takes_share_their_axes() -> None:
    motion, _ = walking(60)
    takes = [Take(name=name, motion=motion, start_s=0.0) for name in ("a", "b")]
    drawing = draw_motion_curves(takes, (0.0, 2.0))
    assert drawing.count("curve take0") == drawing.count("curve take1") > 5
    assert "left stands, b" in drawing


def test_each_kind_of_file_says_what_opens_it() -> None:
    names = [
        "motion.bvh",
        "map_1.ply",
        "trajectories/torso.tum",
        "colmap/0/cameras.bin",
        "colmap/0/images.bin",
    ]
    links = {link.path: link for link in describe_files(names)}
    assert set(links) == {"motion.bvh", "map_1.ply", "trajectories/torso.tum", "colmap/0/"}
    assert "Blender" in links["motion.bvh"].opens_in
    assert all(link.content and link.opens_in for link in links.values())
