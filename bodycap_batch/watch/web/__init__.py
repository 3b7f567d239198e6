"""The live page of a watched folder."""

from bodycap_batch.watch.web.access import Access, access_from
from bodycap_batch.watch.web.server import LivePage

__all__ = ["Access", "LivePage", "access_from"]
