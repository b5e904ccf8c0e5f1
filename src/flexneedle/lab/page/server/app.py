"""The addresses of the server."""

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from anyio import to_thread
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp
from starlette.websockets import WebSocket

from flexneedle.lab.page.server.catalog import build_catalog
from flexneedle.lab.page.server.desk import Desk
from flexneedle.lab.page.server.folder import FIGURES, replay_html, trace_csv, zipped
from flexneedle.lab.page.server.guard import Gate, Guard
from flexneedle.lab.page.server.live import live
from flexneedle.lab.page.server.refusal import Refusal
from flexneedle.scenario.files import dump_scenario

STATIC = Path(__file__).parents[1] / "static"
"""What browsers get, as it is."""


def application(desk: Desk, gate: Gate, static: Path = STATIC) -> ASGIApp:
    """The server's application (ASGI): pages, downloads and the web socket of a desk behind a gate."""
    downloads = Downloads(desk)

    @asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        await desk.start()
        yield
        await desk.end()

    async def index(_request: Request) -> Response:
        return FileResponse(static / "index.html")

    async def schema(_request: Request) -> Response:
        return Response(build_catalog().schema, media_type="application/schema+json")

    async def socket(connection: WebSocket) -> None:
        await live(connection, desk)

    routes = [
        Route("/", index),
        Route("/schema.json", schema),
        Route("/scenario.toml", downloads.scenario),
        Route("/runs/{name}/{file}", downloads.of_run),
        WebSocketRoute("/live", socket),
        Mount("/static", StaticFiles(directory=static)),
    ]
    handlers = {HTTPException: _refused}
    app = Starlette(routes=routes, lifespan=lifespan, exception_handlers=handlers)
    app.router.redirect_slashes = False  # a path is an address of the page, or refused
    return Guard(app, gate)


class Downloads:
    """Files that people take with them."""

    def __init__(self, desk: Desk) -> None:
        self._desk = desk
        self._made: dict[str, tuple[str, Callable[[Path], Coroutine[Any, Any, bytes]]]] = {
            "trace.csv": ("text/csv", trace_csv),
            "run.zip": ("application/zip", _zipped),
            "replay.html": ("text/html", replay_html),
        }
        self._busy = 0

    async def scenario(self, _request: Request) -> Response:
        """The present scenario as a file (TOML)."""
        text = dump_scenario(self._desk.session.scenario)
        return _file(text.encode(), "application/toml", "scenario.toml")

    async def of_run(self, request: Request) -> Response:
        """A file of a run."""
        name, file = request.path_params["name"], request.path_params["file"]
        try:
            folder = self._desk.runs.run(name)
            if file == "figure.png":
                return _figure(folder)
            if file not in self._made:
                choices = ", ".join(("figure.png", *self._made))
                raise Refusal(f"{file!r}: must be one of {choices}")
            media, make = self._made[file]
            if make is not _zipped:
                self._desk.require_processor()
            made = await _unless_gone(request, self._two_at_once(make, folder))
            return Response() if made is None else _file(made, media, f"{name}-{file}")
        except Refusal as refusal:
            raise HTTPException(404, refusal.reason) from None

    async def _two_at_once(self, make: Callable[[Path], Coroutine[Any, Any, bytes]], folder: Path) -> bytes:
        if self._busy >= 2:
            raise Refusal("two downloads are being made: try again in a moment")
        self._busy += 1
        try:
            return await make(folder)
        finally:
            self._busy -= 1


async def _unless_gone(request: Request, making: Coroutine[Any, Any, bytes]) -> bytes | None:
    """What is made, or None if the browser has gone, at which the making is cancelled."""
    task = asyncio.create_task(making)
    gone = asyncio.create_task(_gone(request))
    try:
        await asyncio.wait((task, gone), return_when=asyncio.FIRST_COMPLETED)
        return await task if task.done() else None
    finally:
        for each in (task, gone):
            each.cancel()
        await asyncio.gather(task, gone, return_exceptions=True)


async def _gone(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


async def _zipped(folder: Path) -> bytes:
    return await to_thread.run_sync(zipped, folder)


def _figure(folder: Path) -> Response:
    for name in FIGURES:
        if (folder / name).is_file():
            return FileResponse(folder / name)
    raise Refusal("the run has no figure: flexneedle view draws it")


def _file(data: bytes, media: str, name: str) -> Response:
    """A download. Header names are ASCII; those of runs may be anything."""
    plain = "".join(letter if letter.isascii() and letter.isprintable() else "_" for letter in name)
    return Response(
        data, media_type=media, headers={"content-disposition": f'attachment; filename="{plain}"'}
    )


async def _refused(_request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    return PlainTextResponse(f"{error.detail}\n", error.status_code, headers=error.headers)
