"""Answer the requests of the live page."""

from __future__ import annotations

import asyncio
import errno
import functools
import json
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
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

from bodycap_batch.config.body_height import height_from_text
from bodycap_batch.config.folder import VIDEO_SUFFIXES
from bodycap_batch.core.errors import BodycapError, CaptureError, StoreError
from bodycap_batch.store.artefacts import store_error
from bodycap_batch.watch.commands import cancel_job, retry_job
from bodycap_batch.watch.spool import JobDir, Spool
from bodycap_batch.watch.web.access import COOKIE, Access
from bodycap_batch.watch.web.job_list import JobList, list_result_files, read_log_end
from bodycap_batch.watch.web.questions import questions_about, write_answers
from bodycap_batch.watch.web.uploads import Uploads, is_accepted

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

_PAGE_FOLDER = Path(__file__).with_name("page")
_UPDATE_PERIOD_S = 1.0
"""Time (seconds) between two checks whether a job has changed. Changes are sent to the browsers.
Evidence: none."""
_KEEP_ALIVE_S = 15.0
"""Maximum time (seconds) without data on an event stream. After this time the server sends a comment, which
keeps the connection open. Evidence: none."""
_MAX_JSON_BYTES = 1 << 20
"""Maximum size (bytes) of a request's JSON document. The longest ones hold the names of all files of a
folder. Evidence: none."""
_NO_SUCH_PATH = (errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP)
"""Error numbers (errno) that mean that a path does not exist or cannot exist."""
_NOT_FOUND = "not found\n"
_PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
    "media-src 'self' blob:; "
    "form-action 'none'; frame-ancestors 'none'; base-uri 'none'"
)
# A result file is sandboxed: scripts in a result cannot send requests with the rights of this page.
_RESULT_POLICY = "sandbox allow-scripts allow-popups allow-downloads"
_COMMON_HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-resource-policy": "same-origin",
}


def make_app(job_list: JobList, access: Access, uploads: Uploads, stopped: threading.Event) -> ASGIApp:
    """Return the page as an ASGI application.

    Args:
        job_list: The jobs to show.
        access: Address of the page, and the token that it requires.
        uploads: Receiver of the files that browsers send.
        stopped: Event that is set when the watcher ends. The event streams end at the same time.
    """
    page = _Routes(job_list, uploads, stopped)
    routes = [
        Route("/", page.index),
        Route("/{name:str}", page.asset),
        Route("/api/events", page.events),
        Route("/api/jobs", page.jobs),
        Route("/api/jobs/{name}/log", page.log),
        Route("/api/jobs/{name}/files", page.files),
        Route("/api/jobs/{name}/retry", page.retry, methods=["POST"]),
        Route("/api/jobs/{name}/cancel", page.cancel, methods=["POST"]),
        Route("/api/questions", page.questions, methods=["POST"]),
        Route("/api/answers", page.check_answers, methods=["POST"]),
        Route("/api/uploads", page.start_upload, methods=["POST"]),
        Route("/api/uploads/{key}", page.discard_upload, methods=["DELETE"]),
        Route("/api/uploads/{key}/finish", page.finish_upload, methods=["POST"]),
        Route("/api/uploads/{key}/{name:path}", page.write_upload, methods=["PUT"]),
        Route("/results/{name}/{file:path}", page.result),
        Route("/inputs/{name}/{file:path}", page.input_video),
    ]
    handlers: dict[Any, Any] = {
        BodycapError: _error_response,
        OSError: functools.partial(_os_error_response, job_list.spool),
    }
    return _AccessControl(Starlette(routes=routes, exception_handlers=handlers), access)


class _AccessControl:
    """Pass the requests that `Access` allows to the page, and refuse all other requests.

    A token in the address is stored in a cookie.
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check one request, and answer it or pass it to the page."""
        if scope["type"] != "http":
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_COMMON_HEADERS)
            await send(message)

        request = Request(scope)
        query = request.url.query
        refusal = self._access.refusal(request.method, dict(request.headers), query)
        if refusal is not None:
            code, reason = refusal
            await PlainTextResponse(f"{reason}\n", code)(scope, receive, send_with_headers)
        elif request.url.path == "/" and self._access.token_in(query):
            response = RedirectResponse("/", 303)
            response.set_cookie(COOKIE, self._access.token, httponly=True, samesite="strict")
            await response(scope, receive, send_with_headers)
        else:
            await self._app(scope, receive, send_with_headers)


class _Routes:
    """The functions that answer requests, one for each route."""

    def __init__(self, job_list: JobList, uploads: Uploads, stopped: threading.Event) -> None:
        self._spool = job_list.spool
        self._uploads = uploads
        self._stopped = stopped
        self._job_list = job_list

    # Starlette calls functions that are not asynchronous in a thread, because they read the disk.

    def index(self, _: Request) -> Response:
        return _static("index.html")

    def asset(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in ("page.js", "page.css"):
            raise _not_found()
        return _static(name)

    def jobs(self, _: Request) -> Response:
        return Response(self._job_list.json_text(), media_type="application/json")

    async def events(self, request: Request) -> Response:
        return StreamingResponse(self._changes(request), media_type="text/event-stream")

    def log(self, request: Request) -> Response:
        return PlainTextResponse(read_log_end(self._job(request)))

    def files(self, request: Request) -> Response:
        return JSONResponse(list_result_files(self._job(request)))

    def result(self, request: Request) -> Response:
        """Return one file from a job's folder of results. Files outside this folder are not found."""
        return _file_response(self._job(request).result, request)

    def input_video(self, request: Request) -> Response:
        """Return one video of a job, which the page shows where it asks for the place of the camera."""
        if Path(request.path_params["file"]).suffix.lower() not in VIDEO_SUFFIXES:
            raise _not_found()
        return _file_response(self._job(request).input, request)

    async def retry(self, request: Request) -> Response:
        answers = await _read_small_json(request)
        job = await run_in_threadpool(self._spool.find, request.path_params["name"])
        if job is not None and job.path.parent == self._spool.failed:
            await run_in_threadpool(write_answers, job.input, answers)
        path = await run_in_threadpool(retry_job, self._spool, request.path_params["name"])
        return JSONResponse({"name": path.name})

    def cancel(self, request: Request) -> Response:
        cancel_job(self._spool, request.path_params["name"])
        return JSONResponse({})

    async def questions(self, request: Request) -> Response:
        """Return what the page asks about a folder before the folder is sent."""
        body = await _read_small_json(request)
        given = body.get("names")
        names = [str(name) for name in given] if isinstance(given, list) else []
        found = {**questions_about(names), "ignored": [name for name in names if not is_accepted(name)]}
        return JSONResponse(found)

    async def check_answers(self, request: Request) -> Response:
        """Check the height, so that the page can ask again before it sends the videos."""
        height = str((await _read_small_json(request)).get("height") or "").strip()
        metres = height_from_text(height) if height else None
        return JSONResponse({"height_m": metres})

    async def start_upload(self, request: Request) -> Response:
        body = await _read_small_json(request)
        key = await run_in_threadpool(self._uploads.start, str(body.get("name", "")))
        return JSONResponse({"key": key})

    async def write_upload(self, request: Request) -> Response:
        size = request.headers.get("content-length", "")
        if not size.isdecimal():
            raise CaptureError("the size of the file is not stated", hint="send a Content-Length")
        key, name = request.path_params["key"], request.path_params["name"]
        try:
            await self._uploads.write(key, name, int(size), request.stream())
        except ClientDisconnect:  # the browser can no longer receive an error message
            return Response(status_code=400)
        return JSONResponse({})

    async def finish_upload(self, request: Request) -> Response:
        answers = await _read_small_json(request)
        name = await run_in_threadpool(self._uploads.finish, request.path_params["key"], answers)
        return JSONResponse({"name": name})

    def discard_upload(self, request: Request) -> Response:
        self._uploads.discard(request.path_params["key"])
        return JSONResponse({})

    def _job(self, request: Request) -> JobDir:
        job = self._spool.find(request.path_params["name"])
        if job is None:
            raise _not_found()
        return job

    async def _changes(self, request: Request) -> AsyncIterator[str]:
        """Yield the list of all jobs as a server-sent event whenever a job has changed."""
        sent, silent_s = "", 0.0
        while not self._stopped.is_set() and not await request.is_disconnected():
            text = await run_in_threadpool(self._job_list.json_text)
            if text != sent:
                yield f"data: {text}\n\n"
                sent, silent_s = text, 0.0
            elif silent_s >= _KEEP_ALIVE_S:
                yield ": still here\n\n"
                silent_s = 0.0
            await asyncio.sleep(_UPDATE_PERIOD_S)
            silent_s += _UPDATE_PERIOD_S


def _static(name: str) -> Response:
    return FileResponse(_PAGE_FOLDER / name, headers={"content-security-policy": _PAGE_POLICY})


def _file_response(folder: Path, request: Request) -> Response:
    """Return one file of a folder. Files outside this folder are not found."""
    try:
        path = (folder / request.path_params["file"]).resolve()
    except (ValueError, RuntimeError):  # the name holds a NUL character, or links form a circle
        raise _not_found() from None
    if not path.is_relative_to(folder.resolve()) or not path.is_file():
        raise _not_found()
    # Because `stat_result` is given, the response raises `FileNotFoundError` if the job's folder is moved
    # before the file is opened.
    headers = {"content-security-policy": _RESULT_POLICY}
    return FileResponse(path, headers=headers, stat_result=path.stat())


async def _read_small_json(request: Request) -> dict[str, Any]:
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MAX_JSON_BYTES:
            return {}
    try:
        found = json.loads(body)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


async def _error_response(_: Request, error: Exception) -> Response:
    """Return an error in the form that the page can show."""
    assert isinstance(error, BodycapError)
    code = 507 if isinstance(error, StoreError) else 413 if isinstance(error, CaptureError) else 400
    return JSONResponse({"message": error.message, "hint": error.hint}, code)


async def _os_error_response(spool: Spool, request: Request, error: Exception) -> Response:
    """Return 404 if a path does not exist or cannot exist, and otherwise the error of the disk."""
    assert isinstance(error, OSError)
    if error.errno in _NO_SUCH_PATH:
        return PlainTextResponse(_NOT_FOUND, 404)
    return await _error_response(request, store_error(error, spool.root))


def _not_found() -> HTTPException:
    return HTTPException(404, _NOT_FOUND)
