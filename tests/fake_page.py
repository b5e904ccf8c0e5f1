"""A small server of the page's files without flexneedle: it sends given messages and records requests."""

import asyncio
import json
import threading
from contextlib import suppress
from pathlib import Path

import uvicorn
from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocketDisconnect

import flexneedle.lab.page
from flexneedle.lab.page.protocol import DoneMessage, RefusedMessage, ServerMessage
from flexneedle.lab.page.requests import REQUESTS
from flexneedle.lab.page.server.access import _with_headers
from recorded_page import TARGET, clients, opening, scene, scene_frames, session

STATIC = Path(flexneedle.lab.page.__file__).parent / "static"
PATIENCE_S = 60.0
_KEYS = ("target.depth_mm", "target.lateral_mm", "target.lateral_z_mm")


class FakePage:
    """The server in a separate thread, on a free port.

    Attributes:
        news: Messages and frames for a new client.
        requests: Requests of all clients.
        invalid: Requests that the page's server would refuse, with their problem.
        answers: By type of a request, a `RefusedMessage`, or a function of the request that returns messages and
            frames for its client, which precede the `DoneMessage`.
        files: Contents by path.
    """

    def __init__(self, schema=b"{}"):
        self._schema, self._sockets, self._cut = schema, [], []
        self._heard = threading.Condition()
        self._begin()
        routes = [
            Route("/", lambda _: FileResponse(STATIC / "index.html")),
            *(Route(path, self._file) for path in self.files),
            WebSocketRoute("/live", self._live),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
        app = Starlette(routes=routes)

        async def guarded(scope, receive, send):
            await app(scope, receive, _with_headers(send))

        config = uvicorn.Config(
            guarded,
            port=0,
            log_level="critical",
            ws="websockets-sansio",
            lifespan="off",
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._started = threading.Event()

    def __enter__(self):
        self._thread.start()
        assert self._started.wait(PATIENCE_S)
        port = self._server.servers[0].sockets[0].getsockname()[1]
        self.url = f"http://127.0.0.1:{port}/"
        return self

    def __exit__(self, *_):
        self._server.should_exit = True
        self.drop()
        self._thread.join(PATIENCE_S)

    def reset(self):
        """Wait until all clients have left, and reset the server; return the invalid requests."""
        asyncio.run_coroutine_threadsafe(self._left(), self._loop).result(PATIENCE_S)
        invalid = self.invalid
        self._begin()
        return invalid

    def send(self, *news):
        """Send messages and frames to all clients."""
        asyncio.run_coroutine_threadsafe(self._send_all(news), self._loop).result(PATIENCE_S)

    def drop(self, reason=""):
        """Close all connections."""
        asyncio.run_coroutine_threadsafe(self._drop(reason), self._loop).result(PATIENCE_S)

    def cut(self):
        """Send nothing more over the present connections, and leave them open, like a dead line."""
        self._cut = list(self._sockets)

    def asked(self, kind):
        """Requests of a type, without their numbers."""
        return [
            {k: v for k, v in each.items() if k != "request"}
            for each in self.requests
            if each["type"] == kind
        ]

    def wait_for(self, kind, count=1):
        """Wait for `count` requests of a type, and return them."""
        with self._heard:
            assert self._heard.wait_for(lambda: len(self.asked(kind)) >= count, PATIENCE_S), self.requests
        return self.asked(kind)

    def _begin(self):
        self.news, self.requests, self.invalid, self.answers = opening(), [], [], {}
        self.files = {"/schema.json": self._schema, "/scenario.toml": ""}
        self._revision, self._target = 1, list(TARGET)

    def _file(self, request):
        return Response(self.files[request.url.path])

    def _run(self):
        self._loop = asyncio.new_event_loop()
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self):
        serving = asyncio.ensure_future(self._server.serve())
        while not self._server.started:
            await asyncio.sleep(0.01)
        self._started.set()
        await serving

    async def _live(self, socket):
        await socket.accept()
        self._sockets.append(socket)
        try:
            with suppress(WebSocketDisconnect, RuntimeError):  # the latter: closed while it is sent to
                await self._send_to(socket, self.news)
                while True:
                    request = self._taken(await socket.receive_text())
                    await self._answer(socket, request)
        finally:
            self._sockets.remove(socket)

    def _taken(self, text):
        """Keep a request, and the problem that the page's server would find."""
        try:
            REQUESTS.validate_json(text)
        except ValidationError as error:
            self.invalid.append(f"{text}: {error}")
        with self._heard:
            self.requests.append(json.loads(text))
            self._heard.notify_all()
        return self.requests[-1]

    async def _answer(self, socket, request):
        given = self.answers.get(request["type"])
        if isinstance(given, RefusedMessage):
            await self._send_to(socket, [given.model_copy(update={"request": request["request"]})])
            return
        await self._send_all(self._consequences(request))
        await self._send_to(
            socket, [*(given(request) if given else ()), DoneMessage(request=request["request"])]
        )

    def _consequences(self, request):
        if request["type"] == "steer":
            return [clients(steering=1 if request["take"] else None)]
        if request["type"] == "edit" and set(request["values"]) <= set(_KEYS):
            self._revision += 1
            for axis, key in enumerate(_KEYS):
                self._target[axis] = request["values"].get(key, self._target[axis])
            target = tuple(self._target)
            moved = session(self._revision, target, reach_since=1)
            return [moved, scene(self._revision, target), *scene_frames(target)]
        return []

    async def _send_all(self, news):
        for socket in list(self._sockets):
            await self._send_to(socket, news)

    async def _send_to(self, socket, news):
        for each in () if socket in self._cut else news:
            if isinstance(each, ServerMessage):
                await socket.send_text(each.model_dump_json())
            else:
                await socket.send_bytes(each)

    async def _left(self):
        while self._sockets:
            await asyncio.sleep(0.005)

    async def _drop(self, reason):
        for socket in list(self._sockets):
            with suppress(RuntimeError):
                await socket.close(1012, reason)


def until(page, condition):
    """Wait until a condition in JavaScript holds; the policy of the page forbids Playwright's `wait_for_function`."""
    page.evaluate(
        f"""() => new Promise((resolve, reject) => {{
          const deadline = performance.now() + {1000 * PATIENCE_S};
          const check = () => {{
            if ({condition}) resolve();
            else if (performance.now() > deadline) reject(new Error({condition!r}));
            else setTimeout(check, 20);
          }};
          check();
        }})"""
    )
