"""The live page's server, in a thread of the watcher."""

from __future__ import annotations

import importlib.util
import socket
import threading
from collections.abc import Callable
from dataclasses import replace

from bodycap_batch.config.limits import Limits
from bodycap_batch.core.errors import JobError
from bodycap_batch.watch.spool import Spool
from bodycap_batch.watch.web.access import Access
from bodycap_batch.watch.web.feed import Feed
from bodycap_batch.watch.web.uploads import Uploads, sweep

_END_S = 2


class LivePage:
    """Serves the page; a context manager.

    Args:
        spool: The spool it shows.
        access: Where it listens (port 0: any), and who may use it.
        limits: How much may be sent.
        trouble: Asked what keeps the watcher from its folders at the moment.

    Raises:
        JobError: The extra `web` is not installed, or the address cannot be listened on.
    """

    def __init__(
        self, spool: Spool, access: Access, limits: Limits, trouble: Callable[[], str] = str
    ) -> None:
        missing = [name for name in ("starlette", "uvicorn") if importlib.util.find_spec(name) is None]
        if missing:
            hint = "pip install 'bodycap_batch[web]', or `make extras` in a clone"
            raise JobError(f"the live page needs {' and '.join(missing)}", field="--web", hint=hint)
        self._socket = _listen(access)
        self.access = replace(access, port=self._socket.getsockname()[1])
        self._spool = spool
        self._stopped = threading.Event()
        self._uploads = Uploads(spool, limits)
        self._feed = Feed(spool, trouble)

    def __enter__(self) -> LivePage:
        """Start serving."""
        import uvicorn

        from bodycap_batch.watch.web.app import make_app

        sweep(self._spool.inbox)
        app = make_app(self._feed, self.access, self._uploads, self._stopped)
        config = uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            lifespan="off",
            server_header=False,
            proxy_headers=False,
            ws="none",
            timeout_graceful_shutdown=_END_S,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, name="live page", daemon=True
        )
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._server.should_exit = True
        self._thread.join(2 * _END_S)
        self._socket.close()
        self._uploads.clear()


def _listen(access: Access) -> socket.socket:
    family = socket.AF_INET6 if ":" in access.host else socket.AF_INET
    try:
        return socket.create_server((access.host, access.port), family=family)
    except OSError as error:
        raise JobError(
            f"cannot listen on {access.host}:{access.port}: {error.strerror or error}",
            field="--web",
            hint="another program uses the port, or the address is not this machine's: --web 127.0.0.1:8081",
        ) from error
