"""Stored results of finished tasks, found again by what they were computed from."""

from bodycap_batch.store.artefacts import Artefact, ArtefactKey, Store

__all__ = ["Artefact", "ArtefactKey", "Store"]
