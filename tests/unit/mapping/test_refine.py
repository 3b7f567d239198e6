"""Which readout times a map is refined with."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping import refine, refine_map
from bodycap_batch.mapping.intrinsics.readout_time import Readout, judged_readout
from bodycap_batch.mapping.refine import _readout_of, _Refinement
from bodycap_batch.model.scene import MapResult
from tests.scenes import small_map


def refinement(
    of_map: dict[str, float], stated: dict[str, float], from_matches: dict[str, Readout]
) -> _Refinement:
    """A map of the cameras head and palm.

    Args:
        of_map: Readout times for which the map was built, seconds.
        stated: Readout times that the job gives, seconds.
        from_matches: Readout times from matches.
    """
    names = ("head", "palm")
    scene_map = SimpleNamespace(
        cameras={name: SimpleNamespace(sideways=name == "palm") for name in names},
        readout_s=of_map,
        readout_sigma_s={name: 0.0004 for name in of_map if name not in stated},
    )
    cameras = {
        name: SimpleNamespace(
            rolling_shutter_known=name in stated,
            rolling_shutter_s=stated.get(name, 0.0),
            name=name,
            camera=SimpleNamespace(sideways=False),
        )
        for name in names
    }
    nothing = cast(Any, None)
    return _Refinement(
        model=nothing,
        rolling=nothing,
        scene_map=cast(Any, scene_map),
        cameras=cast(Any, cameras),
        equal_cameras=(),
        from_matches=from_matches,
        mapping=nothing,
    )


def test_readout_times_of_the_map_and_of_matches_are_known() -> None:
    none = judged_readout(0.0001, 0.0003)
    refined = refinement({"palm": 0.01}, {}, {"head": none, "palm": judged_readout(0.012, 0.002)})
    assert refined._known_readouts() == {
        "head": none,
        "palm": Readout(0.01, 0.0004, "of the map", 0.01, True),
    }


def test_a_stated_readout_time_stays_stated() -> None:
    known = refinement({"head": 0.02, "palm": 0.01}, {"head": 0.02}, {})._known_readouts()
    assert known["head"] == Readout(0.02, 0.0, "stated", 0.02)
    assert known["palm"].source == "of the map"


def test_a_readout_time_that_matches_do_not_determine_is_unknown() -> None:
    unknown = judged_readout(0.003, 0.0027)
    assert refinement({"palm": 0.01}, {}, {"head": unknown})._known_readouts().keys() == {"palm"}
    assert refinement({"palm": 0.01}, {}, {})._known_readouts().keys() == {"palm"}


@pytest.mark.parametrize(("of_map", "is_kept"), [({}, True), ({"palm": 0.01}, False)])
def test_a_map_without_shutters_stays_as_it_is_if_its_adjustment_finds_none(
    of_map: dict[str, float], is_kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fastest keyframes of the head show a rolling shutter, all keyframes together show none."""
    none = judged_readout(0.0001, 0.0003)
    refined = refinement(of_map, {}, {} if of_map else {"palm": none})
    found = {} if of_map else {"head": judged_readout(0.005, 0.001)}
    rolling = SimpleNamespace(with_sideways=lambda _: rolling, find_unknown_readouts=lambda *_: found)
    refined = replace(refined, rolling=cast(Any, rolling), model=cast(Any, "before"))
    adjusted = SimpleNamespace(readouts={"head": none, "palm": none}, model="after")
    monkeypatch.setattr(_Refinement, "_with_velocities", lambda *_: adjusted)
    assert refined.run().model == ("before" if is_kept else "after")


def test_an_unknown_error_of_a_logged_readout_time_is_infinite() -> None:
    readout = judged_readout(0.002, math.inf)
    assert _readout_of({**asdict(readout), "sigma_s": None}) == readout
    assert _readout_of(asdict(judged_readout(0.02, 0.001))) == judged_readout(0.02, 0.001)


@pytest.mark.parametrize(("left", "runs"), [(90, 1), (10, 2)])
def test_lenses_stay_if_their_refinement_would_lose_the_points(
    left: int, runs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[list[int]] = []

    def model(points: int) -> Any:
        return SimpleNamespace(num_points3D=lambda: points, reg_image_ids=list)

    def run(self: _Refinement) -> Any:
        held.append(list(self.mapping.calibrated_ids))
        rolling = SimpleNamespace(motions=lambda *_: {})
        return SimpleNamespace(
            model=model(left if len(held) == 1 else 80),
            readouts={},
            corrected_px={},
            rolling=rolling,
            removed=0,
            error_scales=None,
        )

    monkeypatch.setattr(_Refinement, "run", run)
    monkeypatch.setattr(refine, "read_model", lambda *_: model(100))
    monkeypatch.setattr(refine, "read_camera_ids", lambda _: {"head": 1, "palm": 2})
    monkeypatch.setattr(refine, "calibrated_camera_ids", lambda *_: [2])
    monkeypatch.setattr(
        refine, "make_mapping_context", lambda *items: SimpleNamespace(calibrated_ids=items[3])
    )
    for name in ("RollingShutterModel", "_rotations", "write_models", "groups_of_equal_cameras"):
        monkeypatch.setattr(refine, name, lambda *_: None)
    monkeypatch.setattr(refine, "make_result", lambda models, *_: _result(models))
    workspace = tmp_path / "before"
    workspace.mkdir()
    previous = MapResult(maps=(small_map(),), workspace=workspace, log={})
    context = StageContext(work_dir=tmp_path / "now")
    context.work_dir.mkdir()
    result = refine_map(Capture(cameras=()), previous, (), MapOptions(), context)
    assert held == [[2], [1, 2]][:runs]
    assert result.log["points"] == [left if runs == 1 else 80]


def _result(models: Any) -> MapResult:
    points = [item.num_points3D() for item in models]
    return MapResult(maps=(small_map(),), workspace=Path(), log={"points": points})
