"""Find the keyframes of a model that the rotation of their video contradicts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.validation.track_agreement import image_sequences
from bodycap_batch.model.rotation_chain import RotationChain, find_folded


def find_folded_images(model: Any, chains: Mapping[str, RotationChain | None]) -> set[int]:
    """Return the ids of the keyframes whose rotation in the model contradicts that of their video.

    A part of the video can lie at a wrong place of the model that looks like the right one, for example in
    another bay of the room. All its matches agree with that place. The rotation of the video does not.

    Args:
        model: The model, a `pycolmap.Reconstruction`.
        chains: How each camera turns, by camera name.
    """
    folded = set[int]()
    for sequence in image_sequences(model) if is_on(Mechanism.CONTINUITY) else ():
        images = [model.image(number) for number in sequence]
        refs = [ImageRef.parse(image.name) for image in images]
        world_from_cam = [image.cam_from_world().inverse().rotation.matrix() for image in images]
        found = find_folded(
            chains.get(refs[0].camera), np.array([ref.frame for ref in refs]), np.array(world_from_cam)
        )
        folded |= set(np.array(sequence)[found].tolist())
    record_act(Mechanism.CONTINUITY, len(folded))
    return folded
