"""Serve the live page in a thread of the watcher."""

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
from bodycap_batch.watch.web.job_list import JobList
from bodycap_batch.watch.web.uploads import Uploads, remove_abandoned_uploads

_SHUTDOWN_S = 2
"""Maximum time (seconds) that open connections have to end at a shutdown. Evidence: none."""


class LivePage:
    """The server of the live page. This is a context manager.

    Args:
        spool: The folders whose jobs the page shows.
        access: Address to listen on, and the required token. With port 0, the system selects a free port.
        limits: Maximum size and number of uploaded files.
        trouble: Function that returns why the watcher cannot access its folders; "" if it can access them.

    Raises:
        JobError: The extra `web` is not installed, or the server cannot listen on the address.
    """

    def __init__(
        self, spool: Spool, access: Access, limits: Limits, trouble: Callable[[], str] = str
    ) -> None:
        missing = [name for name in ("starlette", "uvicorn") if importlib.util.find_spec(name) is None]
        if missing:
            hint = "run: pip install 'bodycap_batch[web]' (or `make extras` in a clone)"
            raise JobError(f"the live page needs {' and '.join(missing)}", field="--web", hint=hint)
        self._socket = _listen(access)
        self.access = replace(access, port=self._socket.getsockname()[1])
        self._spool = spool
        self._stopped = threading.Event()
        self._uploads = Uploads(spool, limits)
        self._job_list = JobList(spool, trouble)

    def __enter__(self) -> LivePage:
        """Start the server."""
        import uvicorn
        from starlette.concurrency import run_in_threadpool

        from bodycap_batch.watch.web.app import make_app
        from bodycap_batch.watch.web.connections import (
            SWEEP_PERIOD_S,
            LimitedConnection,
            close_connections_without_progress,
            connection_limits,
        )

        remove_abandoned_uploads(self._spool.inbox)
        app = make_app(self._job_list, self.access, self._uploads, self._stopped)
        config = uvicorn.Config(
            app,
            http=LimitedConnection,
            log_level="error",  # clients can cause warnings, and must not fill the disk with them
            access_log=False,
            lifespan="off",
            server_header=False,
            proxy_headers=False,
            ws="none",
            backlog=connection_limits().total,  # the event loop accepts this number at a time
            timeout_graceful_shutdown=_SHUTDOWN_S,
            timeout_notify=SWEEP_PERIOD_S,
        )
        self._server = uvicorn.Server(config)

        async def tidy() -> None:
            close_connections_without_progress(self._server.server_state.connections)
            await run_in_threadpool(self._uploads.remove_idle)

        config.callback_notify = tidy
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, name="live page", daemon=True
        )
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._server.should_exit = True
        self._thread.join(2 * _SHUTDOWN_S)
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
            hint="try --web 127.0.0.1:8081; another program may use the port, or the address may belong "
            "to another machine",
        ) from error
