"""Which readout times a map is refined with."""

from __future__ import annotations

import math
from dataclasses import asdict
from types import SimpleNamespace
from typing import Any, cast

from bodycap_batch.mapping.intrinsics.readout_time import Readout, judged_readout
from bodycap_batch.mapping.refine import _readout_of, _Refinement


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
            rolling_shutter_known=name in stated, rolling_shutter_s=stated.get(name, 0.0), name=name
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


def test_readout_times_of_the_map_and_of_global_shutters_are_decided() -> None:
    none = judged_readout(0.0001, 0.0003)
    refined = refinement({"palm": 0.01}, {}, {"head": none, "palm": judged_readout(0.012, 0.002)})
    assert refined._readouts_are_decided()
    assert refined._readouts() == {"head": none, "palm": Readout(0.01, 0.0004, "of the map", 0.01, True)}


def test_a_stated_readout_time_stays_stated() -> None:
    refined = refinement({"head": 0.02, "palm": 0.01}, {"head": 0.02}, {})
    assert refined._readouts_are_decided()
    assert refined._readouts()["head"] == Readout(0.02, 0.0, "stated", 0.02)
    assert refined._readouts()["palm"].source == "of the map"


def test_a_readout_time_that_the_map_was_not_built_for_is_not_decided() -> None:
    assert not refinement({"palm": 0.01}, {"head": 0.02}, {})._readouts_are_decided()
    assert not refinement({"palm": 0.01}, {}, {"head": judged_readout(0.02, 0.001)})._readouts_are_decided()


def test_an_unknown_readout_time_is_not_decided() -> None:
    unknown = judged_readout(0.003, 0.0027)
    assert not refinement({"palm": 0.01}, {}, {"head": unknown})._readouts_are_decided()
    assert not refinement({"palm": 0.01}, {}, {})._readouts_are_decided()
    assert not refinement({}, {}, {"head": judged_readout(0.0001, 0.0003)})._readouts_are_decided()


def test_an_unknown_error_of_a_logged_readout_time_is_infinite() -> None:
    readout = judged_readout(0.002, math.inf)
    assert _readout_of({**asdict(readout), "sigma_s": None}) == readout
    assert _readout_of(asdict(judged_readout(0.02, 0.001))) == judged_readout(0.02, 0.001)
