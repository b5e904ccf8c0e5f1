"""A worker's process: started, written to, and started again when it has ended."""

import asyncio
import json
import os
import signal
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from flexneedle.errors import describe_error
from flexneedle.lab.page.channel import Message, packed, received
from flexneedle.lab.page.orders import Ready, Signal, Work

OnMessage = Callable[[Message, dict[str, Any] | None], None]
"""Called with each message; a text also as values."""
_READY = Ready().model_dump()
_SHORT_S, _LONGEST_PAUSE_S, _END_S = 2.0, 30.0, 3.0


class Worker:
    """The process of a command, which speaks over its stdin and stdout."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        on_message: OnMessage,
        on_ready: Callable[[], None],
        on_end: Callable[[int], None],
    ) -> None:
        """on_ready, on_end: called when the process is ready, and with its exit status when it has ended."""
        self._name, self._command = name, command
        self._on_message, self._on_ready, self._on_end = on_message, on_ready, on_end
        self.ready = False
        """Whether the process can be given work."""
        self._process: Process | None = None
        self._keeping: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start the process, and keep it running."""
        self._keeping = asyncio.create_task(self._keep())

    def send(self, order: Work | Signal) -> None:
        """Write an order, if the process runs."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.write(packed(order.model_dump_json(exclude_defaults=True)))

    def kill(self) -> None:
        """End the process at once; it is started again."""
        if self._process is not None:
            kill_process(self._process)

    async def end(self, seconds: float = _END_S) -> None:
        """End the process for good: its stdin ends, on which it stops what it does; after a time it is killed."""
        if self._keeping is not None:
            self._keeping.cancel()
            await asyncio.gather(self._keeping, return_exceptions=True)
        process, self._process = self._process, None
        if process is None:
            return
        if process.stdin is not None:
            process.stdin.close()
        try:
            async with asyncio.timeout(seconds):
                await _drained(process)
        except TimeoutError:
            kill_process(process)
            await _drained(process)

    async def _keep(self) -> None:
        pause = 0.0
        while True:
            began = asyncio.get_running_loop().time()
            status = await self._run()
            lived = asyncio.get_running_loop().time() - began
            pause = 0.0 if lived > _SHORT_S else min(_LONGEST_PAUSE_S, 2.0 * pause + 0.1)
            self._on_end(status)
            await asyncio.sleep(pause)

    async def _run(self) -> int:
        """One process, from its start to its end; returns its exit status."""
        # A session of its own: Ctrl-C on the terminal is the server's, which ends its workers itself.
        process = await asyncio.create_subprocess_exec(
            *self._command, stdin=PIPE, stdout=PIPE, start_new_session=True
        )
        self._process = process
        await self._listen(process)
        self._process, self.ready = None, False
        with suppress(TimeoutError):
            async with asyncio.timeout(_END_S):
                return await process.wait()
        kill_process(process)
        return await process.wait()

    def _hear(self, message: Message, values: dict[str, Any] | None) -> None:
        if values == _READY:
            self.ready = True
            self._on_ready()
        else:
            self._on_message(message, values)

    async def _listen(self, process: Process) -> None:
        if process.stdout is None:
            raise RuntimeError("a process without stdout")
        try:
            while (message := await received(process.stdout)) is not None:
                self._hear(message, json.loads(message) if isinstance(message, str) else None)
        except Exception as error:  # noqa: BLE001 - whatever a worker writes, the server stays
            print(
                f"flexneedle: the worker of {self._name} is ended: {describe_error(error)}", file=sys.stderr
            )
            kill_process(process)


def kill_process(process: Process) -> None:
    """End a process at once. Process.kill would first collect its status, of which asyncio's watcher then complains."""
    if process.returncode is None:
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGKILL)


async def _drained(process: Process) -> None:
    """Wait for the end of a process, whose last messages nobody reads."""
    if process.stdout is not None:
        while await process.stdout.read(65_536):
            pass
    await process.wait()
