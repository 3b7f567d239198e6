"""The live page of a watched folder: a web page that shows the state of all jobs."""

from bodycap_batch.watch.web.access import Access, access_from_address
from bodycap_batch.watch.web.server import LivePage

__all__ = ["Access", "LivePage", "access_from_address"]
