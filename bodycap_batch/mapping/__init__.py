"""Stage 2: build one sparse map from the keyframes of all cameras."""

from bodycap_batch.mapping.build import build_map
from bodycap_batch.mapping.empty_map import empty_map
from bodycap_batch.mapping.extend import extend_map
from bodycap_batch.mapping.further_maps import map_lost_keyframes
from bodycap_batch.mapping.inputs import with_estimated_lenses
from bodycap_batch.mapping.refine import refine_map

__all__ = [
    "build_map",
    "empty_map",
    "extend_map",
    "map_lost_keyframes",
    "refine_map",
    "with_estimated_lenses",
]
