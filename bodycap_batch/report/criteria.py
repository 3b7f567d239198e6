"""The criteria by which the result of a job is judged, as one table.

Each criterion is evidence about what is delivered. What is missing is no criterion, but coverage.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bodycap_batch.config.path_bounds import MAX_CONTRADICTED, MAX_UNCERTAINTY
from bodycap_batch.core.percent import format_percent
from bodycap_batch.report import readings
from bodycap_batch.report.grades import Advice, Bounds, Criterion, Grade
from bodycap_batch.report.readings import Metrics, Reader, Reading


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """One row of the table. The texts have placeholders, which the words of the reading replace.

    Attributes:
        name: Name of the graded quantity.
        read: Function that reads the value; it returns None if the metrics hold no such value.
        bounds: The bounds of the grades; None if the criterion is not numerical.
        grade: Grade of a criterion that is not numerical.
        unit: Unit of the value; "" if it has none.
        finding: The value in words.
        rationale: The bounds, and the reason for them.
        action: The change that improves the value; "" if none is known.
        how: Commands and settings for the change.
        priority: Importance of the advice. Larger values are shown first.
    """

    name: str
    read: Reader
    bounds: Bounds | None = None
    grade: Grade = Grade.GOOD
    unit: str = ""
    finding: str
    rationale: str
    action: str = ""
    how: str = ""
    priority: float = 1.0


_CLOCK_RATIONALE = (
    "Half a second is half a step. If a camera's clock is wrong by half a second, the limb with this camera "
    "is half a step too early or too late. The metric scale is wrong too: by 28 % on a walk with two clocks "
    "that were wrong by 0.5 and 0.2 s. A hand that moves at 1 m/s is 1 cm off if its clock is 10 ms off. Up "
    "to 10 ms is good; more than 40 ms, a frame of a cinema camera, is poor."
)
_MORE_TEXTURE = (
    "Put up posters or patterned cloth where the cameras look, and pass the same places more than once."
)

CAMERA_RULES = (
    Rule(
        name="Map error",
        read=readings.at("total.mean_reprojection_error_px"),
        bounds=Bounds(good=1.0, fair=2.0),
        unit="px",
        finding="the mean reprojection error is {value:.2f} px",
        rationale="Sharp corners are located to about half a pixel. An error above one pixel comes from the "
        "lens, the shutter or blur; above two pixels the map does not fit the pictures. A low value alone "
        "does not prove that the map is right.",
        action="Calibrate the camera in the video mode of this capture, with stabilisation and digital zoom "
        "off.",
        how="Film a board and use `bodycap calibrate`.",
    ),
    Rule(
        name="Uncertainty of the paths",
        read=readings.read_path_uncertainty,
        bounds=Bounds(good=0.2, fair=MAX_UNCERTAINTY),
        finding="the positions of {camera} are uncertain by {percent} of the extent of the longest path",
        rationale="Compared are root mean squares, the position's standard deviation and its distance from "
        "the mean position. Up to a fifth, the shape of the path is clear. Above a quarter, it may be "
        "noise: a head that moved by 2 cm had positions without relation to the true ones, at 30 to 48 %.",
        action="Walk at least some steps, with more than plain surfaces in view: a camera that only turns "
        "shows no position.",
        priority=1.6,
    ),
    Rule(
        name="Rotation alone",
        read=readings.read_rotation_only,
        grade=Grade.FAIR,
        finding="{cameras}: only the rotation is known, to ± {sigma:.2f}° per axis; no position is delivered",
        rationale="A camera that moves by a hundredth of the distance to the room shows how it turns, and "
        "not where it is. A path that a map gave would be noise, or that of a thing which the hands move.",
    ),
    Rule(
        name="Links of the video",
        read=readings.read_links,
        bounds=Bounds(good=0.02, fair=MAX_CONTRADICTED),
        finding="{camera}: the video contradicts {percent} of the compared frames{where}",
        rationale="Points are followed through the video without any map. They show how the camera turned "
        "and moved from frame to frame, and where a path folds, leaps or changes its scale.",
        action="Turn more slowly, keep near and far things with texture in view, and point the camera away "
        "from the wearer's own body.",
        priority=1.8,
    ),
    Rule(
        name="Matches that contradict the map",
        read=readings.at("mapping.repair.contradicted_share"),
        bounds=Bounds(good=0.02),
        finding="{percent} of the matches between keyframes contradict the map",
        rationale="Matches of different places that look alike, of the wearer's body or of moving objects "
        "contradict the rest of a map. Right maps have less than 1 %. Of maps of real captures with more "
        "than 5 %, a third were wrong in a part.",
        action="Turn the camera so that it sees less of the wearer's body, and keep other people and moving "
        "things out of the picture.",
        priority=1.6,
    ),
    Rule(
        name="Points without confirmation",
        read=readings.read_unconfirmed,
        bounds=Bounds(good=1.0),
        finding="{removed:,} points were left out because no later view confirms them, and {kept:,} are in "
        "the maps",
        rationale="Points on moving hands, on reflections and on edges that only seem to cross are seen for "
        "a moment. If most points of a map are such points, those that remain determine it poorly. Of eight "
        "real results with more points left out than kept, five had a part in a wrong place; most right "
        "results have less than half as many.",
        action="Turn the camera so that it sees less of the wearer's body, and keep other people and moving "
        "things out of the picture.",
        priority=1.6,
    ),
    Rule(
        name="Parts that contradict the map",
        read=readings.read_misplaced,
        bounds=Bounds(good=0.1),
        finding="{camera}: {what} the rest of the map and {was} left out ({where})",
        rationale="The matches of these keyframes do not belong to common points: the part has another scale "
        "or another place. The part is left out, which lowers the coverage. If it is large, frames beside it "
        "can be wrong by decimetres, although their error in pixels is small: of 41 results with more than "
        "10 %, eleven had a part in a wrong place, of eight with less none. One keyframe alone can be a "
        "blurred one.",
        action=_MORE_TEXTURE,
        priority=1.6,
    ),
    Rule(
        name="One room",
        read=readings.read_joined_cameras,
        grade=Grade.FAIR,
        finding="only the body's movement determines the positions of these cameras, because their map has "
        "no place in common with the main map: {cameras}",
        rationale="A position in the room that only the body determines is less accurate than one from "
        "common places.",
        action="Let all cameras see the same places: walk in a loop and look around in each place.",
    ),
    Rule(
        name="Distances between cameras",
        read=readings.read_reach,
        bounds=Bounds(good=0.98, fair=0.9, more_is_better=True),
        finding="{percent} of {distances:,} distances between cameras are possible on one body{doubt}",
        rationale="Cameras on one body cannot be farther apart than the body reaches. A small share shows "
        "that the map merges two similar places, even if the map's error in pixels is small.",
        action=_MORE_TEXTURE,
    ),
    Rule(
        name="Lenses fit the pictures",
        read=readings.read_lenses,
        bounds=Bounds(good=0.0, fair=0.1),
        finding="{camera}: the pictures fit {lens} than the calibration says{then}",
        rationale="A wrong calibration bends the whole map, although the map's error in pixels is small. On "
        "a walk of 2 m, an error of 25 % in the focal length moved every camera by 9 cm; an image centre "
        "that was wrong by 9 % moved every camera by 16 cm.",
        action="Calibrate the camera in the video mode of this capture, with stabilisation and digital zoom "
        "off; or run the job again and let the program find the lens.",
        how="Film a board and use `bodycap calibrate`; or write `calibration: auto` under `capture:` in the "
        "job file.",
        priority=3.0,
    ),
    Rule(
        name="Frozen parts",
        read=readings.read_frozen,
        bounds=Bounds(good=0.0),
        unit="frames",
        finding="{name}: {value:,.0f} frames repeat one picture although the camera moves",
        rationale="A recording that stops for a while often loses time as well: all later frames of this "
        "camera are then too early. Compare the picture with the other cameras after the frozen part.",
        action="Use a fast memory card and a fully charged battery, close other apps, and play the videos "
        "before the cameras are taken off.",
        priority=2.0,
    ),
)
"""Criteria about the cameras' paths and the map. Evidence of the bounds: docs/decisions/report.md."""

BODY_RULES = (
    Rule(
        name="Skeleton file",
        read=readings.read_skeleton,
        grade=Grade.FAIR,
        finding="{says}",
        rationale="All lengths of the body come from this file. If a joint, an axis or the unit of length is "
        "understood wrongly, the whole motion is wrong: by 28 to 46 cm on one walk.",
    ),
    Rule(
        name="Metric scale",
        read=readings.read_scale,
        bounds=Bounds(good=0.025, fair=0.10),
        finding="sizes are known to about ± {height} of body height ({percent})",
        rationale="An error of the scale changes all lengths by the same factor. 2.5 % is 1.5 cm for the "
        "length of an arm, about as much as all other errors together. 10 % is the difference between a "
        "short and a tall adult.",
        action="{action}",
        how="{how}",
        priority=1.15,
    ),
    Rule(
        name="Distance between cameras and body",
        read=readings.largest("merge.cameras", "residual_m", "p95"),
        bounds=Bounds(good=0.01, fair=0.03),
        unit="m",
        finding="{cm:.1f} cm for camera {name} (95th percentile)",
        rationale="This is the distance between a camera's position on the solved body and the same camera's "
        "position in the map. 1 cm is a few times the error of a camera's position. 3 cm is visible: a hand "
        "slides on the object that the hand holds.",
    ),
    Rule(
        name="Distance between bones at the joints",
        read=readings.largest("merge.joint_gap_m", "p95"),
        bounds=Bounds(good=0.01, fair=0.03),
        unit="m",
        finding="{mm:.1f} mm between the two bones at the joint {name} (95th percentile)",
        rationale="If bones do not meet at their joint, a bone length, a mount or the scale is wrong.",
    ),
    Rule(
        name="Left and right",
        read=readings.says("merge.exchanged_sides"),
        grade=Grade.POOR,
        finding="{says}",
        rationale="If left and right are exchanged, no body fits the cameras: on one such walk, the metric "
        "scale was wrong by 62 %.",
        action="Exchange the names (or mounts) of the left and the right cameras, and run the job again.",
        priority=2.8,
    ),
    Rule(
        name="Cameras upside down",
        read=readings.says("merge.inverted_cameras"),
        grade=Grade.FAIR,
        finding="{says}",
        rationale="The body was solved with the cameras upside down. If they were mounted upright, its "
        "poses are wrong.",
    ),
    Rule(
        name="Straps",
        read=readings.says("merge.slipped_mounts"),
        grade=Grade.FAIR,
        finding="{says}",
        rationale="The camera jumped to another place on the body from one frame to the next and stayed "
        "there; a limb moves smoothly. A strap that slides slowly, or that slips while the limb is thrown "
        "about or while frames are lost, is not found.",
        action="Tighten the strap of {names}, and check it during the take.",
        priority=2.6,
    ),
    Rule(
        name="Cameras on one bone",
        read=readings.read_shared_segment,
        bounds=Bounds(good=2.0, fair=6.0),
        unit="deg",
        finding="{cameras} are turned by {spread:.1f}° relative to their usual positions (median of "
        "{instants:,} frames); the noise of their poses explains {noise:.1f}°",
        rationale="Cameras on one bone keep their relative position, except if their straps are soft or the "
        "forearm twists. If these cameras turn by more than the noise of their poses, one camera is loose "
        "or a clock is wrong (offset_s): a clock error of 0.4 s turned a slowly moving camera by 5°. Up to "
        "2° more than the noise is good; more than 6° is poor.",
        action="Fasten the cameras with stiff straps.",
    ),
    Rule(
        name="Mounts",
        read=readings.read_mounts,
        bounds=Bounds(good=4.0, fair=12.0),
        unit="deg",
        finding="the worst mount ({name}) has an uncertainty of {value:.1f}° and {sigma_m:.3f} m",
        rationale="If a mount is wrong, the bone that carries the camera is wrong by the same angle all the "
        "time. For comparison: an animator who turns a hand by eye makes an error of about 4°. Above 12°, a "
        "palm visibly faces the wrong way.",
        action="{action}",
        how="{how}",
    ),
    Rule(
        name="Postures",
        read=readings.read_postures,
        bounds=Bounds(good=0.33, fair=0.85),
        unit="sigma",
        finding="the joints are {value:.2f} sigma of their everyday range from the rest pose{mean}, most of "
        "all those of the {limb}",
        rationale="People who walk and reach out keep below 0.33, people who throw their arms about reach "
        "0.76 (0.5 in the mean over the capture). A wrong clock, a video with a cut, exchanged cameras, or "
        "a camera in another place than the job says needs rare postures: 0.35 to 1. The motion then looks "
        "possible, but it is wrong. This figure alone cannot tell thrown arms from a wrong clock.",
    ),
    Rule(
        name="Sources of the scale",
        read=readings.read_scale_sources,
        bounds=Bounds(good=0.01, fair=0.0001, more_is_better=True),
        finding="the scales from {sources} differ by a chi-square of {chi2:.1f} with {freedom} of freedom",
        rationale="Each scale has a stated uncertainty. If correct scales disagree so much in less than one "
        "capture of a hundred, a bone length, a clock, the place of a camera or a part of the map is wrong.",
    ),
    Rule(
        name="Cameras in their usual places",
        read=readings.largest("merge.mounts", "from_usual_deg"),
        bounds=Bounds(good=35.0, fair=60.0),
        unit="deg",
        finding="camera {name} is turned by {value:.0f}° from the usual mount on {role}",
        rationale="One camera in a thousand is strapped on more than 35° away from the usual mount or a "
        "quarter turn of it. More often the camera is on another part of the body than the job says, or its "
        "clock is wrong.",
    ),
    Rule(
        name="One clock",
        read=readings.read_contradicted_clocks,
        grade=Grade.POOR,
        finding="{notes}",
        rationale=_CLOCK_RATIONALE,
        action="Correct the stated clock offset, or leave it out, so that it is estimated.",
        how="`offset_s` is the time of an event in the video of the reference camera minus its time in the "
        "camera's own video.",
        priority=2.5,
    ),
    Rule(
        name="One clock",
        read=readings.read_clock,
        bounds=Bounds(good=0.010, fair=0.040),
        unit="s",
        finding="the clock of {name} is known to {ms:.0f} ms, from the {source}",
        rationale=_CLOCK_RATIONALE,
        action="Clap once, or hop once, while all cameras record with sound.",
        priority=1.3,
    ),
)
"""Criteria about the body's motion."""


def judge_criteria(metrics: Metrics) -> Iterator[Criterion]:
    """Yield each criterion for which the metrics hold a value.

    Args:
        metrics: The content of ``metrics.json``.
    """
    rules: Sequence[Rule] = CAMERA_RULES
    if readings.read_rotation_only(metrics) is not None and not readings.main_cameras(metrics):
        # No path depends on the map, so what it is like says nothing about what is delivered.
        rules = tuple(
            rule for rule in rules if rule.read in (readings.read_rotation_only, readings.read_frozen)
        )
    yield from judge_rules("cameras", rules, metrics)
    if "merge" in metrics:
        yield from judge_rules("body", BODY_RULES, metrics)


def judge_rules(subject: str, rules: Sequence[Rule], metrics: Metrics) -> Iterator[Criterion]:
    """Yield the criterion of each rule for which the metrics hold a value."""
    for rule in rules:
        if (reading := rule.read(metrics)) is not None:
            yield _judged(subject, rule, reading)


def _judged(subject: str, rule: Rule, reading: Reading) -> Criterion:
    grade = rule.grade
    if rule.bounds is not None and reading.value is not None:
        grade = rule.bounds.grade(reading.value)
    grade = min(max(grade, reading.best), reading.worst)
    value = 0.0 if reading.value is None else reading.value
    units = {"percent": format_percent(value, 1), "cm": 100 * value, "mm": 1000 * value, "ms": 1000 * value}
    words = {"value": reading.value, **units, **reading.words}
    finding, action = rule.finding.format(**words), rule.action.format(**words)
    advice = None
    if action and grade > Grade.GOOD:
        how = rule.how.format(**words)
        advice = Advice(action=action, reason=finding, priority=rule.priority, how=how)
    return Criterion(
        subject=subject,
        name=rule.name,
        grade=grade,
        finding=finding,
        rationale=rule.rationale,
        metric=reading.metric,
        value=reading.value,
        unit=rule.unit,
        bounds=rule.bounds,
        advice=advice,
    )
