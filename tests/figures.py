"""The mannequin of the files, moved by a motion."""

from __future__ import annotations

import numpy as np

from bodycap_batch.formats.mannequin import make_mannequin
from bodycap_batch.model.skeleton import Motion, rest_pose


def skinned(motion: Motion, tick: int) -> np.ndarray:
    """Return the vertices of the mannequin at a tick, in the world."""
    mesh = make_mannequin(motion.skeleton)
    moved = motion.world_from_joint()[tick] @ np.linalg.inv(rest_pose(motion.skeleton))
    at = np.concatenate([mesh.vertices_m, np.ones((len(mesh.vertices_m), 1))], axis=1)
    return np.einsum("vk,vkab,vb->va", mesh.weights, moved[mesh.joints], at)[:, :3]
