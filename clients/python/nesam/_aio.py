"""The client for asyncio."""

import asyncio
import functools
from typing import Any, AsyncGenerator, AsyncIterable, AsyncIterator, Awaitable, Callable, Iterable, List, Optional, Sequence, Tuple, Union

import grpc
import numpy as np

from . import _calls as calls
from . import _diagnosis as diagnosis
from . import _messages as m
from . import _types as t
from ._aio_durable import AsyncDurableStream
from ._candidates import Drawing, PathCost
from ._connection import ATTEMPTS_MAX, Connected, Options, arguments, finite_timeout, trying_again
from ._errors import InvalidArgument, NesamError
from ._extras import Extras
from ._fallback import KinematicFallback
from ._given import vehicle_or_none
from ._routing import HEADER
from ._stream import ON_THE_WAY_MAX, OpenStream
from .v1 import (
    alarms_pb2,
    diagnosis_pb2_grpc,
    measurements_pb2_grpc,
    prediction_pb2_grpc,
    sessions_pb2_grpc,
    soil_pb2,
    soil_pb2_grpc,
    terrain_pb2_grpc,
)

Measurements = Union[Iterable[t.Measurement], AsyncIterable[t.Measurement]]


class AsyncClient(Connected):
    """`Client` in asyncio: the same methods with the same arguments, errors and answers, to be awaited; tasks of one event loop may share it. Use it in an
    `async with` block.

    A call that is cancelled is cancelled in the service too: a planner that has no more use for an answer costs no one else time.
    """

    def __init__(
        self, address: str, timeout_s: float = 10.0, tls: Optional[t.Tls] = None, vehicle_id: str = "", attempts_max: int = ATTEMPTS_MAX
    ):
        self.timeout_s = timeout_s
        options, credentials = arguments(address, tls)
        vehicle_id = vehicle_or_none(vehicle_id)

        def opened(options: Options) -> Any:
            return grpc.aio.insecure_channel(address, options) if credentials is None else grpc.aio.secure_channel(address, credentials, options)

        self._channel = channel = opened(options + trying_again(attempts_max))
        # As in `Client`.
        self._once = opened(options)
        self._metadata: Tuple[Tuple[str, str], ...] = ((HEADER, vehicle_id),) if vehicle_id else ()
        self._stubs = {
            "sessions": sessions_pb2_grpc.SessionsStub(channel),
            "prediction": prediction_pb2_grpc.PredictionStub(channel),
            "prediction_once": prediction_pb2_grpc.PredictionStub(self._once),
            "terrain": terrain_pb2_grpc.TerrainStub(channel),
            "soil": soil_pb2_grpc.SoilStub(channel),
            "diagnosis": diagnosis_pb2_grpc.DiagnosisStub(channel),
        }
        # See `_stream`; without TLS gRPC gives it the same connection.
        self._threads = grpc.insecure_channel(address, options) if credentials is None else grpc.secure_channel(address, credentials, options)
        self._open_measurements = functools.partial(measurements_pb2_grpc.MeasurementsStub(self._threads).Stream, metadata=self._metadata)
        self._known_states = calls.KnownStates()

    async def __aenter__(self) -> "AsyncClient":
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """As `Client.close`."""
        self._is_closed = True
        await self._channel.close()
        await self._once.close()
        self._threads.close()

    async def _do(self, call: calls.Call[calls.Told], timeout_s: Optional[float] = None) -> calls.Told:
        method = getattr(self._stubs[call.service], call.method)
        timeout = finite_timeout(self.timeout_s if timeout_s is None else timeout_s)
        try:
            return call.read(await self._settled(method(call.request, timeout=timeout, metadata=self._metadata)))
        except _FAILURES as error:
            raise self._refusal(error) from None

    async def _settled(self, call: Awaitable[Any]) -> Any:
        """What a call of gRPC gives. A channel that is closed cancels its calls, and gRPC tells the tasks that wait for them that they are cancelled; with a task in
        between, one that is not hears _CallCancelled."""
        waiting = asyncio.ensure_future(call)
        try:
            await asyncio.wait({waiting})
        except BaseException:
            waiting.cancel()
            # Nobody asks any more how it ended.
            waiting.add_done_callback(lambda ended: ended.cancelled() or ended.exception())
            raise
        if waiting.cancelled() and self._is_closed:
            raise _CallCancelled
        return waiting.result()

    async def _watch(self, service: str, method: str, request: Any, read: Callable[[Any], calls.Told], timeout_s: Optional[float]) -> AsyncIterator[calls.Told]:
        call = None
        try:
            call = getattr(self._stubs[service], method)(request, timeout=finite_timeout(timeout_s), metadata=self._metadata)
            while (message := await self._settled(call.read())) is not grpc.aio.EOF:  # type: ignore[attr-defined]
                yield read(message)
        except _FAILURES as error:
            raise self._refusal(error) from None
        finally:
            # Whoever stops listening ends the call, and what the service does for it.
            if call is not None:
                call.cancel()

    # Sessions

    async def open_session(
        self,
        vehicle_id: str,
        session_id: str = "",
        map_id: str = "",
        vehicle_card: str = "",
        initial: Optional[t.Measurement] = None,
    ) -> t.Session:
        """As `Client.open_session`."""
        return self._known_states.opened(await self._do(calls.open_session(vehicle_id, session_id, map_id, vehicle_card, initial)))

    async def session(self, session_id: str) -> t.Session:
        """As `Client.session`."""
        return await self._do(calls.session(session_id))

    async def sessions(self) -> List[t.Session]:
        """As `Client.sessions`."""
        return await self._do(calls.sessions())

    async def fork_session(self, session_id: str, new_session_id: str) -> t.Session:
        """As `Client.fork_session`."""
        return self._known_states.opened(await self._do(calls.fork_session(session_id, new_session_id)))

    async def export_session(self, session_id: str) -> bytes:
        """As `Client.export_session`."""
        return await self._do(calls.export_session(session_id))

    async def import_session(self, image: bytes, session_id: str = "") -> t.Session:
        """As `Client.import_session`."""
        return self._known_states.opened(await self._do(calls.import_session(image, session_id)))

    async def close_session(self, session_id: str) -> None:
        """As `Client.close_session`."""
        await self._do(calls.close_session(session_id))
        self._known_states.forget(session_id)

    # Effects and alarms

    async def apply_effects(self, session_id: str, effects: Sequence[t.Effect], source: str = "") -> t.Session:
        """As `Client.apply_effects`."""
        return await self._do(calls.apply_effects(session_id, effects, source))

    async def revert_effects(self, session_id: str) -> t.Session:
        """As `Client.revert_effects`."""
        return await self._do(calls.revert_effects(session_id))

    def alarms(self, session_id: str, timeout_s: Optional[float] = None) -> AsyncIterator[t.Alarm]:
        """As `Client.alarms`, for `async for`."""
        request = alarms_pb2.WatchAlarmsRequest(session_id=session_id)
        return self._watch("sessions", "WatchAlarms", request, m.alarm, timeout_s)

    def diagnose(
        self,
        session_id: str,
        recording: str = "",
        from_stamp_ns: Optional[int] = None,
        to_stamp_ns: Optional[int] = None,
        seed: Optional[int] = None,
        reference: str = "bundle",
        controls: bool = True,
        timeout_s: Optional[float] = None,
    ) -> AsyncIterator[t.DiagnosisEvent]:
        """As `Client.diagnose`, for `async for`; `aclose()` or the end of the task ends it."""
        request = diagnosis.request(session_id, recording, from_stamp_ns, to_stamp_ns, seed, reference, controls)
        return self._watch("diagnosis", "Start", request, diagnosis.event, timeout_s)

    # Soil

    def watch_soil(self, session_id: str, timeout_s: Optional[float] = None) -> AsyncIterator[t.SoilEstimate]:
        """As `Client.watch_soil`, for `async for`."""
        request = soil_pb2.WatchSoilRequest(session_id=session_id)
        return self._watch("soil", "Watch", request, t.soil_estimate, timeout_s)

    async def fleet_soil(self, map_id: str = "") -> t.FleetSoil:
        """As `Client.fleet_soil`."""
        return await self._do(calls.fleet_soil(map_id))

    # Maps

    async def upload_map(self, world: t.WorldMap, timeout_s: float = 120.0) -> t.MapDescription:
        """As `Client.upload_map`."""
        return await self._do(calls.upload_map(world), timeout_s)

    async def patch_tile(
        self,
        map_id: str,
        base_version: int,
        row: int,
        column: int,
        elevation_m: np.ndarray,
        semantic_rgb: Optional[np.ndarray] = None,
    ) -> t.MapDescription:
        """As `Client.patch_tile`."""
        try:
            return await self._do(calls.patch_tile(map_id, base_version, row, column, elevation_m, semantic_rgb))
        except InvalidArgument as error:
            raise calls.tile_too_large(error, elevation_m) from None

    async def map(self, map_id: str) -> t.MapDescription:
        """As `Client.map`."""
        return await self._do(calls.map_(map_id))

    async def maps(self) -> List[t.MapDescription]:
        """As `Client.maps`."""
        return await self._do(calls.maps())

    async def delete_map(self, map_id: str) -> None:
        """As `Client.delete_map`."""
        await self._do(calls.delete_map(map_id))

    # Measurements

    async def measure(self, measurements: Measurements) -> List[t.Answer]:
        """As `Client.measure`; measurements may also come from an asynchronous iterator."""
        return [answer async for answer in self.exchange(measurements)]

    async def exchange(self, measurements: Measurements) -> AsyncGenerator[t.Answer, None]:
        """As `Client.exchange`, for `async for`; measurements may also come from an asynchronous iterator. A task takes them from it; where the loop is left before
        its end, `aclose()` ends that."""
        async with self.measurement_stream() as stream:
            # Of each that was sent (True) and of the end (False).
            sent: "asyncio.Queue[bool]" = asyncio.Queue()
            room = asyncio.Semaphore(ON_THE_WAY_MAX)
            sending = asyncio.ensure_future(stream._put_all(measurements, sent, room))
            try:
                while await sent.get():
                    yield await stream._next(self.timeout_s)
                    room.release()
                await sending
            finally:
                sending.cancel()
                await asyncio.gather(sending, return_exceptions=True)

    def measurement_stream(self) -> "AsyncMeasurementStream":
        """An open stream that waits for the answer to each measurement; use it in an `async with` block."""
        return AsyncMeasurementStream(self)

    def durable_stream(
        self, session_id: str, reconnect_s: float = 30.0, pause_s: float = 0.2, pending_max: int = 65536
    ) -> AsyncDurableStream:
        """As `Client.durable_stream`; use it in an `async with` block."""
        return AsyncDurableStream(self, session_id, reconnect_s, pause_s, pending_max)

    # Predictions

    async def predict(
        self,
        session_id: Union[str, t.Session],
        controls: Union[np.ndarray, Drawing],
        start: Optional[t.Vector] = None,
        use_history: bool = True,
        channels: Optional[Sequence[str]] = None,
        stride: int = 1,
        wheel_sinkage: bool = False,
        timeout_s: Optional[float] = None,
        fallback: Optional[KinematicFallback] = None,
        start_stamp_ns: Optional[int] = None,
        sent: Sequence[Tuple[int, Sequence[float]]] = (),
        half: bool = False,
        extras: Optional[Extras] = None,
        cost: Optional[PathCost] = None,
        samples_min: int = 0,
    ) -> t.Prediction:
        """As `Client.predict`."""
        question = calls.Question(
            calls.name_of(session_id),
            controls,
            start=start,
            use_history=use_history,
            channels=channels,
            stride=stride,
            wheel_sinkage=wheel_sinkage,
            fallback=fallback,
            start_stamp_ns=start_stamp_ns,
            sent=sent,
            half=half,
            extras=extras,
            cost=cost,
            samples_min=samples_min,
        )
        asked = self._known_states.ask()
        try:
            return self._known_states.predicted(asked, question, await self._do(question.call(), timeout_s))
        except NesamError as error:
            return self._known_states.fall_back(question, error)


class _CallCancelled(Exception):
    """A call ended with its channel."""


# A channel that is closed is a wrong use of it.
_FAILURES = (grpc.RpcError, grpc.aio.UsageError, _CallCancelled)


class AsyncMeasurementStream(OpenStream):
    """One open stream. Tasks may share it: each `send` is answered in its turn."""

    def __init__(self, client: AsyncClient):
        self._heard: "asyncio.Queue[Any]" = asyncio.Queue()
        self._turn = asyncio.Lock()
        super().__init__(client, _teller(self._heard))

    async def __aenter__(self) -> "AsyncMeasurementStream":
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def send(self, measurement: t.Measurement, timeout_s: Optional[float] = None) -> t.Answer:
        """As `MeasurementStream.send`. One that is cancelled ends the stream."""
        async with self._turn:
            self._put(measurement)
            return await self._next(self._client.timeout_s if timeout_s is None else timeout_s)

    async def close(self) -> None:
        """Says that no more measurements come."""
        self._say_end()

    async def _put_all(self, measurements: Measurements, sent: "asyncio.Queue[bool]", room: asyncio.Semaphore) -> None:
        """Sends measurements where there is room, and tells of each (True) and of the end (False)."""
        try:
            async for measurement in _each(measurements):
                await room.acquire()
                self._put(measurement)
                sent.put_nowait(True)
                # What is at hand is sent at once; answers and other tasks have their turn all the same.
                await asyncio.sleep(0)
        finally:
            sent.put_nowait(False)

    async def _next(self, timeout_s: float) -> t.Answer:
        """The answer to the oldest measurement that waits for one."""
        try:
            # `wait_for` gives up at once where no time is left, whatever is there.
            heard = await asyncio.wait_for(self._heard.get(), self._left_s(timeout_s)) if self._heard.empty() else self._heard.get_nowait()
        except asyncio.TimeoutError:
            raise self._late(timeout_s) from None
        except BaseException:
            self._cancel()
            raise
        return self._answer(heard)


def _teller(heard: "asyncio.Queue[Any]") -> Callable[[Any], None]:
    """Puts what another thread hears into a queue of the running loop."""
    loop = asyncio.get_running_loop()

    def tell(message: Any) -> None:
        try:
            loop.call_soon_threadsafe(heard.put_nowait, message)
        except RuntimeError:
            # The loop is closed; nobody waits any more.
            pass

    return tell


async def _each(measurements: Measurements) -> AsyncIterator[t.Measurement]:
    if isinstance(measurements, AsyncIterable):
        async for measurement in measurements:
            yield measurement
    else:
        for measurement in measurements:
            yield measurement
