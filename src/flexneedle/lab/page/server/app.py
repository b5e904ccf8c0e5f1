"""Routes of the server: pages, downloads, web socket."""

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

from flexneedle.lab.page.server.access import AccessGuard, AccessRules
from flexneedle.lab.page.server.catalog import build_catalog
from flexneedle.lab.page.server.clients import Refusal
from flexneedle.lab.page.server.request_handler import RequestHandler
from flexneedle.lab.page.server.runs_folder import FIGURES, export_csv, export_replay, zip_run
from flexneedle.lab.page.server.web_socket import serve_client
from flexneedle.scenario.files import dump_scenario

STATIC = Path(__file__).parents[1] / "static"
"""Files that browsers load unchanged."""


def make_application(handler: RequestHandler, rules: AccessRules) -> ASGIApp:
    """Return the server's application (ASGI), behind the access rules."""
    downloads = Downloads(handler)

    @asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        await handler.start()
        yield
        await handler.end()

    async def index(_request: Request) -> Response:
        return FileResponse(STATIC / "index.html")

    async def schema(_request: Request) -> Response:
        return Response(build_catalog().schema, media_type="application/schema+json")

    async def socket(connection: WebSocket) -> None:
        await serve_client(connection, handler)

    routes = [
        Route("/", index),
        Route("/schema.json", schema),
        Route("/scenario.toml", downloads.scenario),
        Route("/runs/{name}/{file}", downloads.of_run),
        WebSocketRoute("/live", socket),
        Mount("/static", StaticFiles(directory=STATIC)),
    ]
    handlers = {HTTPException: _answer_error}
    app = Starlette(routes=routes, lifespan=lifespan, exception_handlers=handlers)
    app.router.redirect_slashes = False  # other paths are refused
    return AccessGuard(app, rules)


class Downloads:
    """Files for download."""

    def __init__(self, handler: RequestHandler) -> None:
        self._handler = handler
        self._two_at_once = asyncio.Semaphore(2)

    async def scenario(self, _request: Request) -> Response:
        """Return the present scenario as a file (TOML)."""
        text = dump_scenario(self._handler.session.scenario)
        return _download(text.encode(), "application/toml", "scenario.toml")

    async def of_run(self, request: Request) -> Response:
        """Return a file of a run."""
        name, file = request.path_params["name"], request.path_params["file"]
        try:
            folder = self._handler.runs.find_run(name)
            if file == "figure.png":
                return _figure(folder)
            if file not in _MADE:
                choices = ", ".join(("figure.png", *_MADE))
                raise Refusal(f"{file!r}: must be one of {choices}")
            media, make = _MADE[file]
            if make is not _zip:
                self._handler.require_processor()
            async with self._two_at_once:
                return _download(await make(folder), media, f"{name}-{file}")
        except Refusal as refusal:
            raise HTTPException(404, refusal.reason) from None


async def _zip(folder: Path) -> bytes:
    return await to_thread.run_sync(zip_run, folder)


_MADE: dict[str, tuple[str, Callable[[Path], Coroutine[Any, Any, bytes]]]] = {
    "trace.csv": ("text/csv", export_csv),
    "run.zip": ("application/zip", _zip),
    "replay.html": ("text/html", export_replay),
}
"""Media type of each file, and the function that makes it."""


def _figure(folder: Path) -> Response:
    for name in FIGURES:
        if (folder / name).is_file():
            return FileResponse(folder / name)
    raise Refusal("the run has no figure: flexneedle view draws it")


def _download(data: bytes, media: str, name: str) -> Response:
    """Return a download. Header names are ASCII; names of runs may have any letters."""
    plain = "".join(letter if letter.isascii() and letter.isprintable() else "_" for letter in name)
    return Response(
        data, media_type=media, headers={"content-disposition": f'attachment; filename="{plain}"'}
    )


async def _answer_error(_request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    return PlainTextResponse(f"{error.detail}\n", error.status_code, headers=error.headers)
