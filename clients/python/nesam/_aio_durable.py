"""Measurements that are kept until the service has them on stable storage, in asyncio."""

import asyncio
import math
import time
from typing import Any

from . import _calls as calls
from . import _types as t
from ._errors import NesamError, Unavailable
from ._kept import KeepingStream


class AsyncDurableStream(KeepingStream):
    """`DurableStream` in asyncio; open it with `client.durable_stream`. Tasks may share it: each `send` and `flush` waits for its turn.

    A `send` that is cancelled keeps its measurement; a later `send` or `flush` sends it again.
    """

    def __init__(self, client: Any, session_id: str, reconnect_s: float, pause_s: float, pending_max: int):
        super().__init__(client, session_id, reconnect_s, pause_s, pending_max)
        self._turn = asyncio.Lock()

    async def __aenter__(self) -> "AsyncDurableStream":
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def send(self, measurement: t.Measurement) -> t.Answer:
        """As `DurableStream.send`."""
        async with self._turn:
            self._keep(measurement)
            answer = await self._deliver()
            self._kept.tell_refused(answer)
            return answer

    async def flush(self, timeout_s: float = 10.0) -> None:
        """As `DurableStream.flush`; the time begins with its turn."""
        async with self._turn:
            end = time.monotonic() + timeout_s
            while self._kept:
                self._look()
                if self._kept.next:
                    try:
                        await self._deliver(end)
                    except Unavailable:
                        if time.monotonic() < end:
                            raise
                try:
                    left_s = max(0.0, min(end - time.monotonic(), self._client.timeout_s))
                    if not self._kept.told(await self._client._do(calls.session(self._session_id), left_s)):
                        self._drop()
                except NesamError as error:
                    self._kept.unheard(error)
                if self._kept and time.monotonic() >= end:
                    raise self._kept.overdue(timeout_s)
                if self._kept:
                    await asyncio.sleep(min(self._pause_s, 0.05))
            self._kept.tell_refused()

    async def close(self) -> None:
        """As `DurableStream.close`."""
        async with self._turn:
            if self._stream is not None:
                await self._stream.close()
            self._drop()

    def _drop(self) -> None:
        """Leaves the connection at once, with what nobody has answered on it."""
        if self._stream is not None:
            self._stream._cancel()
            self._stream = None
        self._kept.forget_places()

    async def _deliver(self, end: float = math.inf) -> t.Answer:
        """Sends what has no answer yet, oldest first, over as many connections as it takes until `end`; the answer to the newest."""
        until = min(end, time.monotonic() + self._reconnect_s)
        while True:
            try:
                return await self._attempt(end)
            except NesamError as error:
                self._drop()
                self._failed(error)
                left_s = until - time.monotonic()
                if left_s <= 0.0:
                    raise Unavailable(error.code, error.field, error.message, error.retry_after_s) from error
                await asyncio.sleep(min(left_s, self._until_again_s(error)))
            except BaseException:
                # Cancelled before its answer, which must not be taken for that of the next measurement.
                self._drop()
                raise

    async def _attempt(self, end: float) -> t.Answer:
        """The same over one connection, each measurement after the answer to the one before."""
        self._look()
        if self._stream is None:
            self._stream = self._client.measurement_stream()
        while True:
            answer: t.Answer = await self._stream.send(self._kept.next, max(0.0, min(self._reconnect_s, end - time.monotonic())))
            told = self._kept.answered(answer)
            if told is not None:
                return told
