"""Stored results of finished stages, found again by what they were computed from."""

from bodycap_batch.store.artefacts import Artefact, ArtefactKey, Store

__all__ = ["Artefact", "ArtefactKey", "Store"]
