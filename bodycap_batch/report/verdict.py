"""Is it good? Each criterion graded against thresholds that say why they stand where they do."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from bodycap_batch.core.percent import percent
from bodycap_batch.model.map_diagnostics import MapDiagnostics
from bodycap_batch.report.beside import of_reach, of_shared_segments
from bodycap_batch.report.grades import Criterion, Grade, graded

_SHARP_PX = 1.0
"""Mean reprojection error that sharp corners and a lens that fits stay below."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What a person reads first.

    Attributes:
        headline: One sentence.
        grade: The worse of the two halves.
        cameras: Cameras and room.
        body: The motion; None where the job asks for none.
        criteria: All that was judged.
    """

    headline: str
    grade: Grade
    cameras: Grade
    body: Grade | None
    criteria: tuple[Criterion, ...]


def judge(metrics: Mapping[str, Any] | None, failure: Mapping[str, Any] | None) -> Verdict:
    """Grade a job by its own figures.

    Args:
        metrics: The content of ``metrics.json``; None where the job did not come that far.
        failure: What stopped it, as the error tells.
    """
    criteria = () if metrics is None else tuple(_all(metrics))
    cameras = _worst(criteria, "cameras") if metrics is not None else Grade.NONE
    body = _worst(criteria, "body") if metrics is not None and "merge" in metrics else None
    if failure is not None and body is None:
        body = Grade.NONE
    grade = max(cameras, Grade.GOOD if body is None else body)
    return Verdict(
        headline=_headline(cameras, body, metrics, failure),
        grade=grade,
        cameras=cameras,
        body=body,
        criteria=criteria,
    )


def _worst(criteria: tuple[Criterion, ...], about: str) -> Grade:
    return max((each.grade for each in criteria if each.about == about), default=Grade.NONE)


def _headline(
    cameras: Grade, body: Grade | None, metrics: Mapping[str, Any] | None, failure: Mapping[str, Any] | None
) -> str:
    if metrics is None:
        return "The job stopped before there was a result."
    words = ("are tracked well", "are tracked, with gaps or doubts", "are tracked poorly", "are not tracked")
    first = f"The cameras {words[cameras]}"
    if failure is not None:
        return f"{first}; the body could not be solved."
    if body is None:
        return f"{first}. No body was asked for."
    joint = "and" if (body == Grade.GOOD) == (cameras == Grade.GOOD) else "but"
    ends = (
        "the motion is good",
        "the motion is usable with care",
        "the motion is poor",
        "there is no motion",
    )
    return f"{first}, {joint} {ends[body]}."


def _all(metrics: Mapping[str, Any]) -> Iterator[Criterion]:
    yield from _of_frames(metrics)
    yield from _of_map(metrics)
    if "merge" in metrics:
        yield from _of_body(metrics["merge"])
        yield from _of_measured(metrics.get("motion", {}).get("joints", {}))


def _of_frames(metrics: Mapping[str, Any]) -> Iterator[Criterion]:
    total = metrics["total"]
    share = float(total["coverage"])
    yield Criterion(
        about="cameras",
        name="Frames registered",
        grade=graded(share, 0.98, 0.85, more_is_better=True) if share > 0.0 else Grade.NONE,
        says=f"{total['frames_registered']:,} of {total['frames']:,} frames ({percent(share, 1)})",
        why="From 98 % on only moments are missing, and the body's smoothness carries over them; below 85 % "
        "more than one frame in seven rests on nothing that was seen.",
        metric="total.coverage",
        value=share,
    )
    name, worst = min(metrics["cameras"].items(), key=lambda item: item[1]["coverage"], default=("", None))
    if worst is not None and len(metrics["cameras"]) > 1:
        share = float(worst["coverage"])
        yield Criterion(
            about="cameras",
            name="The worst camera",
            grade=graded(share, 0.95, 0.75, more_is_better=True),
            says=f"{name}: {worst['frames_registered']:,} of {worst['frames']:,} frames "
            f"({percent(share, 1)})",
            why="An average hides one bad camera, and a limb is as good as the camera on it.",
            metric=f"cameras.{name}.coverage",
            value=share,
        )


def _of_map(metrics: Mapping[str, Any]) -> Iterator[Criterion]:
    error = metrics["total"]["mean_reprojection_error_px"]
    if error is not None:
        yield Criterion(
            about="cameras",
            name="Map error",
            grade=graded(float(error), _SHARP_PX, 2.0),
            says=f"{error:.2f} px mean reprojection error",
            why="Sharp corners are found to about half a pixel; above one the lens, the shutter or blur is "
            "at work, above two the map is strained. A low value alone does not prove a right map.",
            metric="total.mean_reprojection_error_px",
            value=float(error),
        )
    apart = sorted(name for name, each in metrics["cameras"].items() if each["frame"] != metrics["frame"])
    lost = sorted(name for name, each in metrics["cameras"].items() if not each["frames_registered"])
    joined = sorted(metrics.get("merge", {}).get("joined_cameras", {}))
    if apart or lost:
        grade, says = Grade.POOR, f"apart from the main map: {', '.join(sorted({*apart, *lost}))}"
    elif joined:
        grade = Grade.FAIR
        says = f"placed by the body alone, for no view is shared with the main map: {', '.join(joined)}"
    else:
        grade, says = Grade.GOOD, "all cameras are placed in one map"
    yield Criterion(
        about="cameras",
        name="One room",
        grade=grade,
        says=says,
        why="A camera outside the main map has no known place in the room; nothing of it reaches the body, "
        "unless the body itself tells where it was, and then less exactly.",
    )
    mapping = MapDiagnostics.from_log(metrics.get("mapping", {}))
    merge = metrics.get("merge", {})
    unused = merge.get("unused_cameras", {})
    yield from of_reach(mapping.reach, unused)
    yield from of_shared_segments(metrics.get("relative_poses", ()), merge.get("mounts", {}), unused)
    misfits, freed = mapping.misfit_factors or {}, mapping.recalibrated
    # A lens of the wrong kind, a wide one given as a pinhole, leaves more than sharp corners do.
    yield from _of_lenses(misfits, freed if error is not None and float(error) <= _SHARP_PX else ())


def _of_lenses(misfits: Mapping[str, float], freed: Collection[str]) -> Iterator[Criterion]:
    """Given focal lengths that the map contradicts: by camera, what fits over what was given.

    Freed ones were found along with the map, and fit.
    """
    held = {name: factor for name, factor in misfits.items() if name not in freed}
    misfits = held or misfits
    name, worst = max(misfits.items(), key=lambda item: abs(item[1] - 1.0), default=("", None))
    if worst is not None:
        yield Criterion(
            about="cameras",
            name="Lenses fit the pictures",
            # A lens may be contradicted although its focal length fits.
            grade=max(Grade.FAIR, graded(abs(worst - 1.0), 0.0, 0.1)) if held else Grade.FAIR,
            says=f"{name}: the pictures fit {other_lens(worst)} than the calibration says"
            f"{'' if held else '; what fits was used instead'}",
            why="A wrong lens bends the whole map although its error in pixels is small: on a walk of 2 m, "
            "25 % of focal length put every camera 9 cm off, a centre 9 % off its place 16 cm.",
            metric="" if "." in name else f"mapping.misfitting_lenses.{name}",
            value=float(worst),
        )


def other_lens(factor: float) -> str:
    """What fits over what was given; a wrong centre alone can leave the focal length as it was."""
    percent = round(100 * abs(factor - 1.0))
    return (
        f"a focal length {percent} % {'longer' if factor > 1.0 else 'shorter'}" if percent else "another lens"
    )


def _of_body(merge: Mapping[str, Any]) -> Iterator[Criterion]:
    scale = merge.get("scale", {}).get("relative_sigma")
    if scale is not None:
        yield Criterion(
            about="body",
            name="Metric scale",
            grade=graded(float(scale), 0.025, 0.10),
            says=f"known to {scale:.1%} (one standard deviation)",
            why="It stretches everything alike. 2.5 % is 1.5 cm on the length of an arm, about what the rest "
            "of the chain leaves; 10 % is a short adult taken for a tall one.",
            metric="merge.scale.relative_sigma",
            value=float(scale),
        )
    cameras = merge.get("cameras", {})
    yield from _of_gaps(cameras)
    residuals = [float(each["residual_m"]["p95"]) for each in cameras.values()]
    if residuals:
        yield Criterion(
            about="body",
            name="Body against cameras",
            grade=graded(max(residuals), 0.01, 0.03),
            says=f"{100 * max(residuals):.1f} cm at the 95th percentile of the worst camera",
            why="How far the solved body moves the cameras away from where the map saw them. 1 cm is a few "
            "times a camera's own error; 3 cm can be seen as a hand that slides on what it holds.",
        )
    gaps = [float(each["p95"]) for each in merge.get("joint_gap_m", {}).values()]
    if gaps:
        yield Criterion(
            about="body",
            name="Joints hold together",
            grade=graded(max(gaps), 0.01, 0.03),
            says=f"{1000 * max(gaps):.1f} mm at the 95th percentile of the worst joint",
            why="Bones that do not meet at their joint tell of a wrong bone length, mount or scale.",
        )
    yield from _of_clocks(merge.get("doubted_clocks", {}))
    if merge.get("exchanged_sides"):
        yield Criterion(
            about="body",
            name="Left and right",
            grade=Grade.POOR,
            says=str(merge["exchanged_sides"]["says"]),
            why="No body fits arms that have changed sides: the metric scale was 62 % off on such a walk.",
        )
    yield from _of_mounts(merge.get("mounts", {}))
    yield from _of_unused(merge.get("unused_cameras", {}))


def _of_gaps(cameras: Mapping[str, Any]) -> Iterator[Criterion]:
    name, worst = max(cameras.items(), key=lambda item: item[1]["longest_gap_s"], default=("", None))
    if worst is None:
        return
    gap = float(worst["longest_gap_s"])
    yield Criterion(
        about="body",
        name="Longest gap",
        grade=graded(gap, 0.2, 0.6),
        says=f"{gap:.2f} s without a measurement ({name})",
        why="An arm swings there and back in about a second: over a fifth of it smoothness guesses right, "
        "over more than half of it a whole swing can be missing. The time before a camera's first "
        "measurement and after its last one counts.",
        metric=f"merge.cameras.{name}.longest_gap_s",
        value=gap,
    )


def _of_clocks(doubted: Mapping[str, Any]) -> Iterator[Criterion]:
    if doubted:
        yield Criterion(
            about="body",
            name="One clock",
            grade=Grade.POOR,
            says="; ".join(str(doubt["says"]) for _, doubt in sorted(doubted.items())),
            why="Half a second is half a step: with a clock that far off, limbs are where they were before, "
            "and the metric scale follows them (28 % off on a walk with two clocks 0.5 and 0.2 s off).",
        )


def _of_mounts(mounts: Mapping[str, Any]) -> Iterator[Criterion]:
    name, worst = max(mounts.items(), key=lambda item: item[1]["sigma_deg"], default=("", None))
    if worst is None:
        return
    sigma = float(worst["sigma_deg"])
    yield Criterion(
        about="body",
        name="Mounts",
        grade=graded(sigma, 4.0, 12.0),
        says=f"known to {sigma:.1f}° and {100 * worst['sigma_m']:.1f} cm at worst ({name})",
        why="The mount is a constant error of the bone that carries the camera. 4° is about how well a hand "
        "is aimed by eye in animation; over 12° a palm visibly faces the wrong way.",
        metric=f"merge.mounts.{name}.sigma_deg",
        value=sigma,
    )


def _of_unused(unused: Mapping[str, Any]) -> Iterator[Criterion]:
    if unused:
        yield Criterion(
            about="body",
            name="Unused cameras",
            grade=Grade.POOR,
            says="; ".join(f"{name}: {reason}" for name, reason in sorted(unused.items())),
            why="Their limbs are inferred, not measured.",
        )


def _of_measured(joints: Mapping[str, Any]) -> Iterator[Criterion]:
    shares = {name: float(each["observed_share"]) for name, each in joints.items() if each["observed"]}
    name, share = min(shares.items(), key=lambda item: item[1], default=("", None))
    if share is not None:
        yield Criterion(
            about="body",
            name="Time measured",
            grade=graded(share, 0.95, 0.8, more_is_better=True),
            says=f"{percent(share, 1)} of the motion at the joint that was measured least ({name})",
            why="A camera that starts late, ends early or is lost for long leaves its limb inferred, "
            "and an average over all joints would hide it.",
            metric="" if "." in name else f"motion.joints.{name}.observed_share",
            value=share,
        )
