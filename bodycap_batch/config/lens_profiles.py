"""Lenses by name: a table of calibrations that users of action cameras and phones made and published.

A profile is a first guess: cameras of one model differ, and so do their modes. Mapping refines it.
"""

from __future__ import annotations

import difflib
import gzip
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from bodycap_batch.config.bounds import ASPECT_TOLERANCE
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX, Camera, with_two_focal_lengths

NAME_SEPARATOR = " / "
"""Separates the parts of a name: model, lens mode, size."""
_PACKAGE, _TABLE = "bodycap_batch.presets.lenses", "profiles.json.gz"
_RATE_TOLERANCE = 0.01
"""Maximum relative difference between two frame rates that are treated as equal: 29.97 and 30."""
_COMPARED_RAD = (0.1, 0.5)
"""Angles (radians) from the optical axis at which profiles are compared: near the centre, where the focal
length alone counts, and far from it."""
_SAME_FOCAL = 0.03
"""Maximum relative difference of the places of an angle in profiles that say the same. Origin: the
calibrations of one mode by different users scatter by 1 to 3 %."""
_MAX_OFFERED = 8
"""Maximum number of names that an error offers."""
_SIZE_NAMES = {
    "720p": (720,), "960p": (960,), "1080p": (1080,), "1440p": (1440,), "2.7k": (2704, 2720, 2688),
    "4k": (3840, 4000, 4096), "5k": (5120, 4992), "5.3k": (5312,), "5.6k": (5568, 5600), "6k": (6144, 6000),
}  # fmt: skip
"""Widths (pixels) that the name of a size means; for a name with p, heights."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LensProfile:
    """The calibration of one mode of one camera model, with OpenCV's fisheye model.

    Attributes:
        brand: Maker of the camera.
        model: Model of the camera.
        lens: Lens mode or lens; "" if it is not stated.
        setting: Further settings; "" if none are stated.
        width: Image width, pixels.
        height: Image height, pixels.
        fps: Frames per second; 0 if it is not stated.
        params: fx, fy, cx, cy (pixels, OpenCV's origin), k1, k2, k3, k4.
        rms_px: Reprojection error of the calibration, pixels.
        official: Whether the collection marks it as made by its maintainers or by the maker.
        stabilised: Whether it was made with stabilised pictures.
        anamorphic: Whether an anamorphic lens or attachment was used, or a mode that stretches the picture.
        readout_s: Time from the exposure of the first row to the last, seconds; negative if the sensor reads
            upwards; None if it is unknown.
        sizes: Further image sizes for which the collection lists the same profile, pixels.
    """

    brand: str
    model: str
    lens: str
    setting: str
    width: int
    height: int
    fps: float
    params: tuple[float, ...]
    rms_px: float
    official: bool
    stabilised: bool
    anamorphic: bool
    readout_s: float | None
    sizes: tuple[tuple[int, int], ...]

    @property
    def camera_name(self) -> str:
        """Maker and model."""
        return self.model if _key(self.model).startswith(_key(self.brand)) else f"{self.brand} {self.model}"

    @property
    def has_attachment(self) -> bool:
        """Whether the profile names an anamorphic lens or attachment."""
        words = f"{self.model} {self.lens} {self.setting}".lower()
        return self.anamorphic and ("anamor" in words or "anomor" in words)

    @property
    def name(self) -> str:
        """The name by which a job uses the profile."""
        parts = (self.camera_name, self.lens, f"{self.width}x{self.height}")
        return NAME_SEPARATOR.join(part for part in parts if part)

    def text(self) -> str:
        """Return the profile as text for the user."""
        rate = f" at {self.fps:g} fps" if self.fps else ""
        marks = [f"RMS {self.rms_px:g} px"]
        marks += ["official"] if self.official else []
        marks += ["anamorphic"] if self.anamorphic else []
        marks += ["stabilised"] if self.stabilised else []
        setting = f" ({self.setting})" if self.setting else ""
        return f"{self.name}{rate}{setting}, {', '.join(marks)}"

    def fits_size(self, size: tuple[int, int], *, exactly: bool) -> bool:
        """Return whether the profile is for an image size, or for another size of the same shape.

        Args:
            size: Width and height, pixels.
            exactly: True to accept only sizes for which the profile is listed.
        """
        if size in ((self.width, self.height), *self.sizes):
            return True
        same_shape = abs(size[0] * self.height / (size[1] * self.width) - 1.0) <= ASPECT_TOLERANCE
        return same_shape and not exactly

    def place_of(self, angle_rad: float) -> float:
        """Return the distance of an angle from the principal point, as a fraction of the image width."""
        squared = angle_rad**2
        series = 1.0 + squared * float(np.polynomial.polynomial.polyval(squared, self.params[4:]))
        return 0.5 * (self.params[0] + self.params[1]) * angle_rad * series / self.width

    def first_guess(self, size: tuple[int, int]) -> Camera:
        """Return the lens at an image size.

        Mapping refines its focal length and radial terms. One focal length and two terms are fitted to the
        radial curve of the profile, as far as the image goes, with a fisheye model or with a perspective
        model, whichever fits better. If neither fits, the lens has the four terms of the profile. If the
        pixels are not square, or the lens is anamorphic, it has a focal length for each axis.

        Args:
            size: Width and height, pixels. If its shape differs from that of the profile, the pixels of one
                of the two are not square.
        """
        fx, fy, cx, cy, *radial = self.params
        x, y = size[0] / self.width, size[1] / self.height
        fx, fy, centre = fx * x, fy * y, [(cx + CV2_PIXEL_OFFSET_PX) * x, (cy + CV2_PIXEL_OFFSET_PX) * y]
        focal = 0.5 * (fx + fy)
        corner = 0.5 * float(np.hypot(*size)) / focal
        theta = np.linspace(0.0, _MAX_ANGLE_RAD, _CURVE_POINTS)
        squared = theta**2
        curve = theta * (1.0 + squared * np.polynomial.polynomial.polyval(squared, radial))
        # Beyond its largest value, the curve of a profile is meaningless.
        end = int(np.argmax((np.diff(curve, append=-1.0) <= 0) | (curve > corner))) + 1
        fits = []
        for model, base in (("RADIAL_FISHEYE", theta[:end]), ("RADIAL", np.tan(theta[:end]))):
            terms = np.stack([base, base**3, base**5], axis=1)
            found = np.linalg.lstsq(terms, curve[:end], rcond=None)[0]
            misfit = float(np.sqrt(np.mean((terms @ found - curve[:end]) ** 2)))
            fits.append((misfit, model, found.tolist()))
        misfit, model, (scale, cubic, fifth) = min(fits)
        params: FloatArray | list[float] = [focal * scale, *centre, cubic / scale, fifth / scale]
        has_inverse = bool(curve[end - 1] > _LEAST_REACH * corner)
        if has_inverse and misfit * focal / max(size) > _MAX_MISFIT:
            model, params = "OPENCV_FISHEYE", [focal, focal, *centre, *radial]
        lens = Camera(model=model, width_px=size[0], height_px=size[1], params=np.array(params), refine=True)
        if abs(fx / fy - 1.0) <= _SAME_FOCAL:
            return lens
        lens = with_two_focal_lengths(lens)
        params = np.concatenate([lens.params[:2] * [fx / focal, fy / focal], lens.params[2:]])
        return replace(lens, params=params)


_MAX_MISFIT = 0.15 / 640
"""Maximum distance (root mean square) between the curve of a profile and the lens with two terms, as a ratio
to the longer side of the image. Origin: half of the noise of a keypoint, 0.3 of 640 pixels. A larger one
shifts the focal length of a map. Evidence: docs/decisions/telemetry.md."""
_LEAST_REACH = 0.95
"""Minimum largest value of the curve of a profile whose four terms are used, as a ratio to the distance of
the corners of the image. Pixels beyond this value have no viewing ray. Evidence: none."""
_MAX_ANGLE_RAD = 1.5
"""Largest angle (radians) from the optical axis at which the curve of a profile is read."""
_CURVE_POINTS = 300
"""Number of points at which the curve of a profile is read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LensChoice:
    """A profile that was chosen for a video.

    Attributes:
        profile: The profile.
        note: What the user should know about the choice; "" if there is nothing.
    """

    profile: LensProfile
    note: str = ""


@cache
def lens_profiles() -> tuple[LensProfile, ...]:
    """Return all profiles of the table."""
    packed = resources.files(_PACKAGE).joinpath(_TABLE).read_bytes()
    table = json.loads(gzip.decompress(packed))
    found = (dict(zip(table["columns"], row, strict=True)) for row in table["rows"])
    return tuple(map(_profile, found))


def _profile(row: Mapping[str, Any]) -> LensProfile:
    plain = ("brand", "model", "lens", "setting", "width", "height", "fps", "rms_px")
    return LensProfile(
        **{name: row[name] for name in plain},
        params=tuple(row[name] for name in ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
        official=bool(row["official"]),
        stabilised=bool(row["stabilised"]),
        anamorphic=bool(row["anamorphic"]),
        readout_s=1e-3 * row["readout_ms"] or None,
        sizes=tuple((width, height) for width, height in row["sizes"]),
    )


def search_lenses(words: str) -> list[LensProfile]:
    """Return the profiles whose name or setting contains all words, in any order and case."""
    wanted = [_key(word) for word in words.replace("/", " ").split() if _key(word)]
    found = []
    for profile in lens_profiles():
        text = _key(f"{profile.brand} {profile.model} {profile.lens} {profile.setting}")
        if all(word in text or _means_size(word, profile) for word in wanted):
            found.append(profile)
    return sorted(
        found, key=lambda each: (each.camera_name.lower(), each.lens.lower(), -each.width, each.rms_px)
    )


def profiles_named(name: str) -> list[LensProfile]:
    """Return the profiles with a name: ``model / lens mode / size``, of which only the model is needed.

    Raises:
        ValueError: There is no such profile. The message offers similar names.
    """
    model, *rest = [part.strip() for part in name.split("/")]
    of_model = [each for each in lens_profiles() if _key(model) in (_key(each.camera_name), _key(each.model))]
    if not of_model:
        names = sorted({each.camera_name for each in lens_profiles()})
        near = difflib.get_close_matches(model, names, n=3, cutoff=0.5)
        raise ValueError(
            f"there is no lens profile of a camera {model!r}; "
            + (f"did you mean {' or '.join(near)}?" if near else "search with `bodycap lenses`")
        )
    found = of_model
    for part in filter(None, rest):
        found = [each for each in found if _key(part) == _key(each.lens) or _means_size(_key(part), each)]
    if not found:
        offered = list(dict.fromkeys(each.name for each in of_model))[:_MAX_OFFERED]
        raise ValueError(
            f"there is no lens profile {name!r}; profiles of this camera are: {'; '.join(offered)}"
        )
    return found


def choose_named(name: str, size: tuple[int, int], fps: float) -> LensChoice | str:
    """Choose the profile with a name for a video.

    Args:
        name: Name of the profile.
        size: Width and height of the video as a player shows it, pixels.
        fps: Frame rate of the video.

    Returns:
        The choice, or the reason why there is none.
    """
    named = profiles_named(name)
    fitting = [each for each in named if each.fits_size(size, exactly=False)]
    if not fitting:
        sizes = ", ".join(sorted({f"{each.width}x{each.height}" for each in named})[:_MAX_OFFERED])
        return (
            f"the lens profiles with the name {name!r} are for pictures of {sizes}, but the video shows "
            f"{size[0]}x{size[1]}: the shapes differ"
        )
    # Other profiles with two focal lengths are of modes that stretch the picture of every such camera.
    if all(each.has_attachment for each in fitting) and "an" not in _key(name):
        return f"the lens profiles with the name {name!r} are all of anamorphic lenses"
    plain = [each for each in fitting if not each.anamorphic] or fitting
    best = _best(plain, size, fps)
    modes = sorted({each.lens or "no mode" for each in plain if not _same_lens(each, best)})
    note = _note(best, size, fps)
    if modes:
        other = f"other profiles with this name differ ({', '.join(modes[:3])})"
        note = f"{note}; {other}" if note else other
    return LensChoice(profile=best, note=note)


def choose_for_file(model: str, mode: str, size: tuple[int, int], fps: float) -> LensChoice | str:
    """Choose a profile for a video by its camera model, lens mode and size.

    Profiles of anamorphic lenses and of stabilised pictures are never chosen.

    Args:
        model: Name of the model in the file.
        mode: Lens mode in the file; "" if it is not stated.
        size: Width and height of the video as a player shows it, pixels.
        fps: Frame rate of the video.

    Returns:
        The choice, or the reason why there is none.
    """
    usable = [
        each
        for each in lens_profiles()
        if _key(model) in (_key(each.camera_name), _key(each.model))
        and not (each.anamorphic or each.stabilised)
        and each.fits_size(size, exactly=True)
    ]
    if not usable:
        return f"no lens profile for {model} at {size[0]}x{size[1]}"
    of_mode = [each for each in usable if mode and _key(each.lens) == _key(mode)]
    if mode and not of_mode:
        of_mode = [each for each in usable if not each.lens]
        if not of_mode:
            return f"no lens profile for {model} in the mode {mode} at {size[0]}x{size[1]}"
    candidates = of_mode or usable
    best = _best(candidates, size, fps)
    if not of_mode and any(not _same_lens(each, best) for each in candidates):
        modes = sorted({each.lens for each in candidates if each.lens})
        named = ", ".join(modes[:4]) or "they differ"
        return (
            f"several lens profiles for {model} at {size[0]}x{size[1]} ({named}), and the file does not "
            "state its lens mode"
        )
    return LensChoice(profile=best, note=_note(best, size, fps))


def _best(profiles: Sequence[LensProfile], size: tuple[int, int], fps: float) -> LensProfile:
    """Return the profile with the nearest size and rate, then an official one, then the most accurate."""
    return min(
        profiles,
        key=lambda each: (
            (each.width, each.height) != size and size not in each.sizes,
            each.stabilised,
            bool(each.setting),
            not _same_rate(each, fps),
            not each.official,
            each.rms_px,
            each.name,
        ),
    )


def _same_rate(profile: LensProfile, fps: float) -> bool:
    return profile.fps > 0 and fps > 0 and abs(profile.fps / fps - 1.0) <= _RATE_TOLERANCE


def _same_lens(one: LensProfile, other: LensProfile) -> bool:
    """Return whether two profiles put two angles at nearly the same place, in image widths."""
    return all(
        abs(one.place_of(angle) / other.place_of(angle) - 1.0) <= _SAME_FOCAL for angle in _COMPARED_RAD
    )


def _note(profile: LensProfile, size: tuple[int, int], fps: float) -> str:
    notes = []
    if profile.fps and fps > 0 and not _same_rate(profile, fps):
        notes.append(f"the lens profile was made at {profile.fps:g} fps, the video has {fps:g} fps")
    if not profile.fits_size(size, exactly=True):
        notes.append(f"the lens profile was made at {profile.width}x{profile.height} and is scaled")
    if profile.stabilised:
        notes.append("the lens profile was made with stabilised pictures")
    return "; ".join(notes)


def _means_size(word: str, profile: LensProfile) -> bool:
    """Return whether a part of a name, as `_key` returns it, means the size of a profile."""
    sizes = ((profile.width, profile.height), *profile.sizes)
    for name, lengths in _SIZE_NAMES.items():
        if word == _key(name):
            return any((height if name.endswith("p") else width) in lengths for width, height in sizes)
    return any(word == f"{width}x{height}" for width, height in sizes)


def _key(text: str) -> str:
    """Return the letters and digits of a text in lower case."""
    return re.sub(r"[^a-z0-9+]", "", text.lower().replace("×", "x"))
