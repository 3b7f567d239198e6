"""The live page's requests."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import (
    FileResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Route

from bodycap_batch.core.errors import BodycapError, CaptureError, StoreError
from bodycap_batch.watch.commands import cancel_job, retry_job
from bodycap_batch.watch.spool import JobDir
from bodycap_batch.watch.web.access import COOKIE, Access
from bodycap_batch.watch.web.feed import Feed, files_of, log_of
from bodycap_batch.watch.web.uploads import Uploads

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Receive, Scope, Send

_PAGE = Path(__file__).with_name("page")
_PERIOD_S = 1.0
_KEEP_ALIVE_S = 15.0
_MOST_JSON_BYTES = 4096
_PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
    "form-action 'none'; frame-ancestors 'none'; base-uri 'none'"
)
# A result is a document of its own: what it runs cannot speak for this page.
_RESULT_POLICY = "sandbox allow-scripts allow-popups allow-downloads"
_ALWAYS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-resource-policy": "same-origin",
}


def make_app(feed: Feed, access: Access, uploads: Uploads, stopped: threading.Event) -> ASGIApp:
    """The page as an ASGI application.

    Args:
        feed: The jobs that it shows.
        access: Who may use it.
        uploads: Takes what browsers send.
        stopped: Set when the watcher ends: streams end, too.
    """
    page = _Page(feed, uploads, stopped)
    routes = [
        Route("/", page.index),
        Route("/{name:str}", page.asset),
        Route("/api/events", page.events),
        Route("/api/jobs", page.jobs),
        Route("/api/jobs/{name}/log", page.log),
        Route("/api/jobs/{name}/files", page.files),
        Route("/api/jobs/{name}/retry", page.retry, methods=["POST"]),
        Route("/api/jobs/{name}/cancel", page.cancel, methods=["POST"]),
        Route("/api/uploads", page.begin, methods=["POST"]),
        Route("/api/uploads/{key}", page.drop, methods=["DELETE"]),
        Route("/api/uploads/{key}/finish", page.finish, methods=["POST"]),
        Route("/api/uploads/{key}/{name:path}", page.write, methods=["PUT"]),
        Route("/results/{name}/{file:path}", page.result),
    ]
    app = Starlette(routes=routes, exception_handlers={BodycapError: _told})
    return _Gate(app, access)


class _Gate:
    """Lets through what `Access` allows, and remembers a token that was shown in the address."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check one request."""
        if scope["type"] != "http":
            return
        request = Request(scope)
        query = request.url.query
        refusal = self._access.refusal(request.method, dict(request.headers), query)
        if refusal is not None:
            code, reason = refusal
            await PlainTextResponse(f"{reason}\n", code, headers=_ALWAYS)(scope, receive, send)
        elif request.url.path == "/" and self._access.token_in(query):
            response = RedirectResponse("/", 303, headers=_ALWAYS)
            response.set_cookie(COOKIE, self._access.token, httponly=True, samesite="strict")
            await response(scope, receive, send)
        else:
            await self._app(scope, receive, send)


class _Page:
    """The routes."""

    def __init__(self, feed: Feed, uploads: Uploads, stopped: threading.Event) -> None:
        self._spool = feed.spool
        self._uploads = uploads
        self._stopped = stopped
        self._feed = feed

    async def index(self, _: Request) -> Response:
        return self._static("index.html")

    async def asset(self, request: Request) -> Response:
        name = request.path_params["name"]
        return self._static(name) if name in ("page.js", "page.css") else _missing()

    async def jobs(self, _: Request) -> Response:
        text = await run_in_threadpool(self._feed.text)
        return Response(text, media_type="application/json", headers=_ALWAYS)

    async def events(self, request: Request) -> Response:
        return StreamingResponse(self._changes(request), media_type="text/event-stream", headers=_ALWAYS)

    async def log(self, request: Request) -> Response:
        job = await run_in_threadpool(self._job, request)
        return PlainTextResponse(await run_in_threadpool(log_of, job), headers=_ALWAYS) if job else _missing()

    async def files(self, request: Request) -> Response:
        job = await run_in_threadpool(self._job, request)
        return JSONResponse(await run_in_threadpool(files_of, job), headers=_ALWAYS) if job else _missing()

    async def result(self, request: Request) -> Response:
        """One file of a job's results; nothing outside of them."""
        job = await run_in_threadpool(self._job, request)
        if job is None:
            return _missing()
        path = (job.result / request.path_params["file"]).resolve()
        if not path.is_relative_to(job.result.resolve()) or not path.is_file():
            return _missing()
        return FileResponse(path, headers={**_ALWAYS, "content-security-policy": _RESULT_POLICY})

    async def retry(self, request: Request) -> Response:
        path = await run_in_threadpool(retry_job, self._spool, request.path_params["name"])
        return JSONResponse({"name": path.name}, headers=_ALWAYS)

    async def cancel(self, request: Request) -> Response:
        await run_in_threadpool(cancel_job, self._spool, request.path_params["name"])
        return JSONResponse({}, headers=_ALWAYS)

    async def begin(self, request: Request) -> Response:
        body = await _small_json(request)
        key = await run_in_threadpool(self._uploads.begin, str(body.get("name", "")))
        return JSONResponse({"key": key}, headers=_ALWAYS)

    async def write(self, request: Request) -> Response:
        size = request.headers.get("content-length", "")
        if not size.isdecimal():
            raise CaptureError("the size of the file was not announced", hint="send a Content-Length")
        key, name = request.path_params["key"], request.path_params["name"]
        try:
            await self._uploads.write(key, name, int(size), request.stream())
        except ClientDisconnect:  # nobody is there to be told
            return Response(status_code=400)
        return JSONResponse({}, headers=_ALWAYS)

    async def finish(self, request: Request) -> Response:
        name = await run_in_threadpool(self._uploads.finish, request.path_params["key"])
        return JSONResponse({"name": name}, headers=_ALWAYS)

    async def drop(self, request: Request) -> Response:
        await run_in_threadpool(self._uploads.drop, request.path_params["key"])
        return JSONResponse({}, headers=_ALWAYS)

    def _job(self, request: Request) -> JobDir | None:
        return self._spool.find(request.path_params["name"])

    def _static(self, name: str) -> Response:
        return FileResponse(_PAGE / name, headers={**_ALWAYS, "content-security-policy": _PAGE_POLICY})

    async def _changes(self, request: Request) -> AsyncIterator[str]:
        """All jobs whenever something about them has changed, as server-sent events."""
        sent, silent_s = "", 0.0
        while not self._stopped.is_set() and not await request.is_disconnected():
            text = await run_in_threadpool(self._feed.text)
            if text != sent:
                yield f"data: {text}\n\n"
                sent, silent_s = text, 0.0
            elif silent_s >= _KEEP_ALIVE_S:
                yield ": still here\n\n"
                silent_s = 0.0
            await asyncio.sleep(_PERIOD_S)
            silent_s += _PERIOD_S


async def _small_json(request: Request) -> dict[str, Any]:
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MOST_JSON_BYTES:
            return {}
    try:
        found = json.loads(body)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


async def _told(_: Request, error: Exception) -> Response:
    """A typed error as the page shows it."""
    assert isinstance(error, BodycapError)
    code = 507 if isinstance(error, StoreError) else 413 if isinstance(error, CaptureError) else 400
    return JSONResponse({"message": error.message, "hint": error.hint}, code, headers=_ALWAYS)


def _missing() -> Response:
    return PlainTextResponse("there is no such thing here\n", 404, headers=_ALWAYS)
