"""The store of finished tasks' results. The key of a result identifies everything it was computed from."""

from bodycap_batch.store.artefacts import Artefact, ArtefactKey, Store

__all__ = ["Artefact", "ArtefactKey", "Store"]
