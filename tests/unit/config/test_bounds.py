"""Every number of a job has a lower and an upper bound, and a value outside is refused before any work."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from pydantic import BaseModel, Field, ValidationError

from bodycap_batch.config.calibration import read_calibration
from bodycap_batch.config.job import load_job
from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import CaptureError, JobError
from bodycap_batch.pipeline import Settings, prepare_capture
from bodycap_batch.store.artefacts import Store
from bodycap_batch.synthetic.options import SynthOptions

CALIBRATION = {
    "model": "PINHOLE", "params": [420, 420, 320, 240], "width": 640, "height": 480,
    "calibrated_with": {"rms_px": 0.2},
}  # fmt: skip
IDENTITY = [[float(row == column) for column in range(4)] for row in range(4)]
JOB: dict[str, Any] = {
    "capture": {
        "cameras": [
            {
                "name": "torso",
                "video": ["torso.mp4"],
                "joint_from_cam": {"translation_m": [0, 0, 0], "quat_xyzw": [0, 0, 0, 1]},
                "sigma_deg": 3,
                "sigma_m": 0.01,
                "calibration": CALIBRATION,
                "fov_deg": 90,
                "offset_s": 0,
                "drift_ppm": 0,
                "rolling_shutter_s": 0,
            },
            {"name": "left_palm", "video": ["left.mp4"], "joint_from_cam": IDENTITY},
        ],
        "calibration": CALIBRATION,
        "start_s": 0,
        "end_s": 9,
    },
    "tpose_frame": 0,
    "height_m": 1.75,
    "keyframes": {"max_per_min": 60},
    "merge": {
        "fps": 60,
        "t_pose_s": 1,
        "known_distance": ["torso:0", "torso:9", 1.5],
        "marker_board": {"square_m": 0.1, "columns": 7, "rows": 5},
    },
    "export": {"fps": 60, "smoothing_hz": 6},
}
"""A job that gives every number without a default, and every form of a mount."""
SYNTH: dict[str, Any] = {
    "lens_params": [420, 420, 320, 240],
    "offsets_s": {"torso": 0.0},
    "pressed_s": {"left_palm": [2, 4]},
    "cameras": ["torso", "left_palm"],
    "carried_s": {"right": [2, 4]},
    "bit_rate_mbps": 2.0,
    "body_in_view": True,
    "rates_fps": {"torso": 30.0},
    "poses_only": True,
    "imu": {"rate_hz": 200},
}
"""Options of a synthetic capture that give every number without a default."""
SOUNDING: dict[str, Any] = {
    **{key: value for key, value in SYNTH.items() if key not in ("rates_fps", "poses_only")},
    "clocks": "free",
    "sound": True,
    "drifts_ppm": {"torso": 0.0},
    "sound_skews_s": {"torso": 0.0},
}
"""The options that only videos have."""
WILD = (math.inf, -math.inf, math.nan, 1e308, -1e308, 10**30, 10**18 + 1)

Where = tuple[str | int, ...]


class Number(NamedTuple):
    """A number of a model: its place in the schema, and its bounds."""

    place: str
    schema: dict[str, Any]

    @property
    def least(self) -> float | None:
        """The smallest bound, whether it is allowed or not."""
        found: float | None = self.schema.get("minimum", self.schema.get("exclusiveMinimum"))
        return found

    @property
    def most(self) -> float | None:
        """The largest bound, whether it is allowed or not."""
        found: float | None = self.schema.get("maximum", self.schema.get("exclusiveMaximum"))
        return found

    def outside(self) -> Iterator[float]:
        """The nearest values that are too small and too large."""
        assert self.least is not None
        assert self.most is not None
        whole = self.schema["type"] == "integer"
        for bound, exclusive, towards in (
            (self.least, "exclusiveMinimum", -math.inf),
            (self.most, "exclusiveMaximum", math.inf),
        ):
            if exclusive in self.schema:
                yield bound
            elif whole:
                yield int(bound) + (1 if towards > 0 else -1)
            else:
                yield math.nextafter(bound, towards)


def numbers(
    schema: Mapping[str, Any], top: Mapping[str, Any], value: Any = None, place: str = "", where: Where = ()
) -> Iterator[tuple[Number, Where | None]]:
    """All numbers of a schema, each with its location in `value`; None where `value` does not give it."""
    if "$ref" in schema:
        schema = top["$defs"][schema["$ref"].rpartition("/")[2]]
    for index, choice in enumerate(schema.get("anyOf", schema.get("oneOf", []))):
        kind = top["$defs"][choice["$ref"].rpartition("/")[2]] if "$ref" in choice else choice
        fits = {"object": dict, "array": list | tuple, None: object}.get(kind.get("type"), int | float)
        held = value if isinstance(value, fits) else None
        yield from numbers(choice, top, held, f"{place}|{index}", where)
    if schema.get("type") in ("number", "integer"):
        yield Number(place, dict(schema)), None if value is None else where
    inner: dict[Any, Mapping[str, Any]] = dict(schema.get("properties", {}))
    for key, each in inner.items():
        held = None if value is None else value.get(key, each.get("default"))
        yield from numbers(each, top, held, f"{place}.{key}", (*where, key))
    if isinstance(schema.get("additionalProperties"), Mapping):
        for key in list(value or ()) or [None]:
            held = None if not value else value[key]
            yield from numbers(schema["additionalProperties"], top, held, f"{place}.*", (*where, key))
    items = list(schema.get("prefixItems", ()))
    if isinstance(schema.get("items"), Mapping):
        items += [schema["items"]] * max(1, len(value or ()))
    for index, each in enumerate(items):
        held = value[index] if value is not None and index < len(value) else None
        name = index if "prefixItems" in schema else "*"
        yield from numbers(each, top, held, f"{place}.{name}", (*where, index))


def numbers_of(model: type[BaseModel], value: Mapping[str, Any]) -> list[tuple[Number, Where | None]]:
    """All numbers of a model, except the parameters of calibrations: the plausibility check bounds them."""
    schema = model.model_json_schema()
    found = numbers(schema, schema, value)
    return [each for each in found if ".calibration" not in each[0].place or ".params." not in each[0].place]


def replaced(document: Any, where: Where, value: Any) -> Any:
    """A copy of the document with another value at one location."""
    if not where:
        return value
    copy = list(document) if isinstance(document, list | tuple) else dict(document or {})
    key, rest = where[0], where[1:]
    copy[key] = replaced(copy.get(key) if isinstance(copy, dict) else copy[key], rest, value)  # type: ignore[index]
    return copy


def full(model: type[BaseModel], value: Mapping[str, Any]) -> dict[str, Any]:
    """The document with the defaults that the model adds."""
    return dict(json.loads(model.model_validate(value).model_dump_json(exclude_none=True)))


def unbounded(model: type[BaseModel]) -> list[str]:
    return [each.place for each, _ in numbers_of(model, {}) if each.least is None or each.most is None]


@pytest.mark.parametrize(("model", "values"), [(Job, (JOB,)), (SynthOptions, (SYNTH, SOUNDING))])
def test_every_number_has_two_bounds_and_is_tried_below(
    model: type[BaseModel], values: tuple[Mapping[str, Any], ...]
) -> None:
    assert unbounded(model) == []
    found = [each for value in values for each in numbers_of(model, full(model, value))]
    tried = {each.place for each, where in found if where is not None}
    assert {each.place for each, _ in found} - tried == set(), "add the field to JOB or SYNTH above"
    assert len(tried) > 20


def test_a_new_number_without_bounds_is_found() -> None:
    class Block(BaseModel):
        good: float = Field(1.0, ge=0, le=2)
        half: float = Field(1.0, gt=0)
        row: tuple[int, float] = (1, 2.0)

    class Longer(Job):
        blocks: tuple[Block, ...] = ()
        by_name: dict[str, int] = Field(default_factory=dict)
        other: float | None = None

    assert unbounded(Longer) == [
        ".blocks.*.half", ".blocks.*.row.0", ".blocks.*.row.1", ".by_name.*", ".other|0",
    ]  # fmt: skip


def refusal(folder: Path, document: Mapping[str, Any]) -> JobError:
    path = folder / "job.yaml"
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    settings = Settings(
        store=Store(folder / "store"), threads=1, listener=lambda _: None, cancelled=lambda: False
    )
    with pytest.raises(JobError) as caught:
        load_job(path, prepare=lambda options, out, _: prepare_capture(options, out, settings))
    return caught.value


@pytest.mark.parametrize(
    ("model", "value", "block"),
    [
        (Job, JOB, ()),
        (SynthOptions, SYNTH, ("capture", "synthetic")),
        (SynthOptions, SOUNDING, ("capture", "synthetic")),
    ],
)
def test_a_number_outside_its_bounds_is_refused_with_its_field(
    tmp_path: Path, model: type[BaseModel], value: Mapping[str, Any], block: Where
) -> None:
    plain: dict[str, Any] = {"capture": {"cameras": [{"name": "torso", "video": ["torso.mp4"]}]}}
    for count, (number, where) in enumerate(numbers_of(model, document := full(model, value))):
        if where is None:
            continue
        for wrong in (*number.outside(), *WILD):
            with pytest.raises(ValidationError):
                model.model_validate(replaced(document, where, wrong))
        every = (*number.outside(), *WILD)
        wrong = every[count % len(every)]  # a file takes 10 ms
        changed = replaced(document, where, wrong)
        error = refusal(tmp_path, replaced(plain, block, changed) if block else changed)
        said = f"{where} = {wrong}: {error}"
        assert error.exit_code == 2, said
        assert error.hint, said
        assert error.field == ".".join(map(str, (*block, *where))), said


def test_the_job_of_this_test_is_sound(tmp_path: Path) -> None:
    (tmp_path / "job.yaml").write_text(yaml.safe_dump(full(Job, JOB)), encoding="utf-8")
    assert load_job(tmp_path / "job.yaml").merge.fps == 60


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"seconds": 3600, "fps": 240}, "3600 s at 240 frames"),
        ({"seconds": 1, "fps": 240, "offsets_s": {"torso": 3600}}, "3601 s at 240 frames"),
        ({"seconds": 600, "poses_only": True, "rates_fps": {"torso": 1000}}, "600 s at 1000 frames"),
    ],
)
def test_more_frames_than_fit_into_memory_are_refused(
    tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    capture = {"cameras": [{"name": "torso", "video": ["torso.mp4"]}], "synthetic": options}
    error = refusal(tmp_path, {"capture": capture})
    assert error.message.startswith(words)
    assert error.field == "capture.synthetic.seconds"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("params", [1e9, 420, 320, 240]),
        ("params", [420, 420, 320, -1e308]),
        ("width", 10**30),
        ("height", 0),
        ("offset_s", 5e9),
        ("rolling_shutter_s", 1.5),
        ("rolling_shutter_s", math.nan),
    ],
)
def test_calibration_files_have_the_same_bounds(tmp_path: Path, field: str, value: Any) -> None:
    path = tmp_path / "calib.json"
    path.write_text(json.dumps({**CALIBRATION, field: value}))
    with pytest.raises(CaptureError) as caught:
        read_calibration(path, "torso")
    assert caught.value.hint
    assert str(caught.value.field).startswith(field.replace("offset_s", "offsets_s"))
