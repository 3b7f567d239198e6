"""Which keyframe pairs are matched, and their geometric verification."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from itertools import combinations
from pathlib import Path

from bodycap_batch.config import MapOptions
from bodycap_batch.context import StageContext
from bodycap_batch.mapping.database import DATABASE_NAME, ImageRef

_BLOCK = 400


def choose_pairs(images: Collection[ImageRef], new: Collection[ImageRef]) -> list[tuple[ImageRef, ImageRef]]:
    """All pairs of keyframes that hold at least one new one, in a fixed order."""
    fresh = set(new)
    return [(a, b) for a, b in combinations(sorted(images), 2) if a in fresh or b in fresh]


def match_pairs(
    workspace: Path,
    pairs: list[tuple[ImageRef, ImageRef]],
    options: MapOptions,
    context: StageContext,
    scale: float,
) -> None:
    """Match and verify keyframe pairs into the database.

    Args:
        workspace: Folder of the database.
        pairs: Pairs to match.
        options: Seed.
        context: Threads, progress, cancellation.
        scale: Factor on pixel thresholds.
    """
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = context.threads
    matching.use_gpu = False
    pairing = pycolmap.ImportedPairingOptions()
    list_path = workspace / "pairs.txt"
    pairing.match_list_path = str(list_path)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    verification.ransac.max_error *= scale
    verification.filter_stationary_matches = False
    for done in range(0, len(pairs), _BLOCK):
        context.check_cancelled()
        context.progress(done, len(pairs), "pairs")
        _write_list(list_path, pairs[done : done + _BLOCK])
        pycolmap.match_image_pairs(
            str(workspace / DATABASE_NAME), matching, pairing, verification, pycolmap.Device.cpu
        )
    list_path.unlink(missing_ok=True)
    context.progress(len(pairs), len(pairs), "pairs")


def _write_list(path: Path, pairs: Iterable[tuple[ImageRef, ImageRef]]) -> None:
    path.write_text("".join(f"{a.name} {b.name}\n" for a, b in pairs), encoding="utf-8")
