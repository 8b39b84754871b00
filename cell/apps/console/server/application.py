"""What the server answers: the page, its data, commands and the live link, to those who may."""

import asyncio
import json
import re
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from cell.apps.console.server.access import HEADERS, Access, Bucket, PageSession, checked_command
from cell.apps.console.server.pages import PROTOCOL, Pages
from cell.apps.console.view.archive import Archive
from drivers.errors import ConfigError

MOST_BODY, MOST_PATH = 4096, 300
BODY_S = 5.0
"""Wall seconds in which a command has to be there as a whole."""
KEY = "x-cell-key"
"""The header with a session's key; a live link has it as its second subprotocol, beside `PROTOCOL`."""
SHOWN = re.compile(r"/api/runs/[^/]+/(pictures/[^/]+|report\.html)")
"""What a browser asks for by its address alone: there a ticket stands for the key."""
ENTERED = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Assembly cell</title>
<link rel="icon" href="/static/icon.svg" type="image/svg+xml">
<meta http-equiv="refresh" content="0;url=/#key={key}"><a href="/#key={key}">To the cell</a></html>"""
LOST = "open the link that `cell console` printed in its terminal; it works once, for one tab of the browser"
PAGE = Path(__file__).parents[1] / "page"
ENTER = "/enter"
REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)

Ask = Callable[[str, Mapping[str, object]], Awaitable[tuple[int, Mapping[str, object]]]]
"""What a page, by its id, wants done: status and answer."""


class AccessGuard:
    """Stands before everything: who may not is told so here, and every answer has the headers of `access.HEADERS`."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access
        self._strangers = Bucket(100.0, 400.0)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See ASGI."""
        if scope["type"] not in ("http", "websocket"):
            return
        live = scope["type"] == "websocket"
        pairs = [(name.decode("latin-1").lower(), value.decode("latin-1")) for name, value in scope["headers"]]
        plain = not live and scope["method"] in ("GET", "HEAD")
        refusal = self._access.refusal(
            dict(pairs), sum(name == "host" for name, _ in pairs), changes=not plain,
            enters=plain and scope["path"] == ENTER,
        )  # fmt: skip
        if refusal is None:
            refusal = self._unknown(scope, dict(pairs), plain)

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                known = dict(message["headers"])
                own = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                message["headers"] = [*message["headers"], *(pair for pair in own if pair[0] not in known)]
            await send(message)

        if refusal is None:
            await self._app(scope, receive, sent)
        elif live:
            # Before it is accepted this is an answer 403 to the upgrade.
            await send({"type": "websocket.close", "code": 1008})
        else:
            await PlainTextResponse(refusal[1] + "\n", refusal[0], {"connection": "close"})(scope, receive, sent)

    def _session(self, scope: Scope, headers: Mapping[str, str], plain: bool) -> PageSession | None:
        """Whose request it is; None when it is no session's."""
        path, session = scope["path"], self._access.session(headers.get("cookie", ""))
        # The page itself and its files say nothing of the cell.
        if session is None or (plain and (path == "/" or path.startswith("/static/"))):
            return session
        asked: list[str] = scope["subprotocols"] if scope["type"] == "websocket" else []
        key = asked[1] if len(asked) == 2 and asked[0] == PROTOCOL else headers.get(KEY, "")
        return self._access.opened(key, _asked(scope, "ticket") if plain and SHOWN.fullmatch(path) else "")

    def _unknown(self, scope: Scope, headers: Mapping[str, str], plain: bool) -> tuple[int, str] | None:
        """Status and words when this is no session's, or more than one session may ask for."""
        path, live = scope["path"], scope["type"] == "websocket"
        if len(path) > MOST_PATH:
            return 400, f"this address has {len(path)} characters; at most {MOST_PATH} are allowed"
        if plain and path == ENTER:
            return None if self._strangers.take() else (429, "too many requests; wait a moment")
        if (session := self._session(scope, headers, plain)) is None:
            return 401, LOST
        scope["session"] = session
        if (plain and not session.requests.take()) or (live and not session.links.take()):
            return 429, "too many requests; wait a moment"
        return None


class PageFiles(StaticFiles):
    """The page's files. A browser keeps them, and asks by their ETag whether they are still the same."""

    def file_response(self, *args: Any, **options: Any) -> Response:
        """See `StaticFiles`."""
        response = super().file_response(*args, **options)
        response.headers["cache-control"] = "no-cache"
        return response


class Application:
    """The routes. `cell` is `/api/cell`'s answer, and `of_job` the same with another job's station. `entered` is called
    whenever a link was used."""

    def __init__(
        self, access: Access, pages: Pages, archive: Archive, *, cell: Mapping[str, object], do: Ask,
        stop: Callable[[], Awaitable[str | None]], of_job: Callable[[str], Awaitable[tuple[int, Mapping[str, object]]]],
        entered: Callable[[], None],
    ) -> None:  # fmt: skip
        self._access, self._pages, self._archive, self._cell = access, pages, archive, cell
        self._do, self._stop, self._of_job, self._entered = do, stop, of_job, entered

    def asgi(self) -> ASGIApp:
        """What is served."""
        # Text alone: pictures are compressed already.
        small = [Middleware(GZipMiddleware, minimum_size=1000, compresslevel=6)]
        routes = [
            Route("/", self._index, middleware=small),
            Route(ENTER, self._enter),
            Route("/api/cell", self._tell_cell, middleware=small),
            Route("/api/runs", _told(self._archive.runs), middleware=small),
            Route("/api/trend", _told(self._archive.trend), middleware=small),
            Route("/api/health", self._health, middleware=small),
            Route("/api/runs/{run}", _told(self._archive.run), middleware=small),
            Route("/api/runs/{run}/replay", _told(self._archive.replay), middleware=small),
            Route("/api/runs/{run}/report.html", self._report),
            Route("/api/runs/{run}/pictures/{name}", self._picture),
            Route("/api/do", self._command, methods=["POST"]),
            WebSocketRoute("/live", self._live),
            Mount("/static", PageFiles(directory=PAGE), middleware=small),
        ]
        return AccessGuard(
            Starlette(routes=routes, exception_handlers={HTTPException: _refused, 500: _failed}), self._access
        )

    async def _index(self, request: Request) -> Response:
        return FileResponse(PAGE / "index.html", headers={"cache-control": "no-store"})

    async def _enter(self, request: Request) -> Response:
        session = self._access.enter(_asked(request.scope, "token"))
        if session is None:
            return PlainTextResponse("this link was used already, or is none; `cell console` shows a new one\n", 403)
        self._entered()
        # The key stands behind #, which no browser sends to anybody; the page takes it out of the address. A page that
        # goes on by itself, and no redirect: in a redirect that began elsewhere no browser sends this cookie.
        headers = {"set-cookie": self._access.set_cookie(session), "cache-control": "no-store"}
        return HTMLResponse(ENTERED.format(key=session.key), 200, headers)

    async def _tell_cell(self, request: Request) -> Response:
        job = request.query_params.get("job")
        if job is None:
            return _json(self._cell)
        if len(job) > MOST_PATH:
            return _no("ConfigError", f"a job's name has at most {MOST_PATH} characters, this one {len(job)}", 400)
        status, words = await self._of_job(job)
        return _json(words, status)

    async def _health(self, request: Request) -> Response:
        told = await run_in_threadpool(self._archive.health)
        return _no("missing", "the reports could not be read: see `cell health`", 404) if told is None else _json(told)

    async def _report(self, request: Request) -> Response:
        page = await run_in_threadpool(self._archive.page, request.path_params["run"])
        # It holds scripts and styles of its own: in a sandbox, from where it reaches nothing here.
        if page is None:
            # Opened in a window of its own, where a person reads what comes.
            return PlainTextResponse("There is no such run, or it has no report that could be drawn.\n", 404)
        return FileResponse(page, headers={"content-security-policy": REPORT_POLICY})

    async def _picture(self, request: Request) -> Response:
        path = self._archive.picture(request.path_params["run"], request.path_params["name"])
        return _found(None) if path is None else FileResponse(path, media_type="image/png")

    async def _command(self, request: Request) -> Response:
        if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            return _no("content", "commands are JSON (content-type application/json)", 415)
        body = b""
        try:
            async with asyncio.timeout(BODY_S):
                async for part in request.stream():
                    body += part
                    if len(body) > MOST_BODY:
                        return _no("content", f"a command has at most {MOST_BODY} bytes", 413)
        except (TimeoutError, ClientDisconnect):
            late = _no("content", f"the command did not come within {BODY_S:g} s; send it again", 408)
            late.headers["connection"] = "close"
            return late
        try:
            words = json.loads(body)
        except (ValueError, RecursionError):
            words = None
        if not isinstance(words, dict):
            return _no("content", "this is no JSON object", 400)
        if words.get("do") == "stop":
            trouble = await self._stop()
            if trouble is not None:
                return _no("DeviceFault", trouble, 500)
            return _json({"ok": True, "text": "the cell was stopped"})
        if not request.scope["session"].commands.take():
            return _no("rate", "too many commands; wait a moment", 429)
        if (page := self._pages.by_key(words.pop("key", None))) is None:
            return _no("InterlockError", "this page has no live link to the cell; load it again", 403)
        try:
            checked_command(words)
        except ConfigError as error:
            return _no("ConfigError", str(error), 400)
        status, answer = await self._do(page.id, words)
        return _json(answer, status)

    async def _live(self, socket: WebSocket) -> None:
        await self._pages.serve(socket, socket.scope["session"].ticket)


def _asked(scope: Scope, name: str) -> str:
    """A value of the query. Not by Starlette's own parser, whose errors would show what was sent."""
    return str(parse_qs(scope["query_string"].decode("latin-1")).get(name, [""])[0])


def _json(words: object, status: int = 200) -> Response:
    return JSONResponse(words, status, {"cache-control": "no-store"})


def _no(kind: str, text: str, status: int) -> Response:
    return _json({"ok": False, "error": kind, "text": text}, status)


def _found(words: object) -> Response:
    return _no("missing", "there is no such run, or it left none of this", 404) if words is None else _json(words)


def _told(find: Callable[..., object]) -> Callable[[Request], Awaitable[Response]]:
    """Answers with what `find` gives, of the run that the address names if it names one."""

    async def answer(request: Request) -> Response:
        return _found(await run_in_threadpool(find, *request.path_params.values()))

    return answer


async def _refused(request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else 500
    return _no("refused", {404: "there is no such address", 405: "this is not done so"}.get(status, "refused"), status)


async def _failed(request: Request, error: Exception) -> Response:
    # Never the request itself, which may hold a token.
    return _no("internal", f"the server failed ({type(error).__name__})", 500)
