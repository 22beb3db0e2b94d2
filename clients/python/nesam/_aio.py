"""The client for asyncio."""

import asyncio
from typing import AsyncIterator, List, Optional, Sequence, Tuple, Union

import grpc
import numpy as np

from . import _calls as calls
from . import _diagnosis as diagnosis
from . import _messages as m
from . import _types as t
from ._candidates import Drawing, PathCost
from ._connection import arguments
from ._errors import DeadlineExceeded, Unavailable, from_rpc
from ._extras import Extras
from ._fallback import KinematicFallback
from ._routing import HEADER
from .v1 import (
    alarms_pb2,
    diagnosis_pb2_grpc,
    measurements_pb2,
    measurements_pb2_grpc,
    prediction_pb2_grpc,
    sessions_pb2_grpc,
    soil_pb2,
    soil_pb2_grpc,
    terrain_pb2_grpc,
)


class AsyncClient:
    """`Client` in asyncio: the same methods with the same arguments, errors and answers, to be awaited; tasks of one event loop may share it. Use it in an
    `async with` block.

    A call that is cancelled is cancelled in the service too: a planner that has no more use for an answer costs no one else time.
    """

    def __init__(self, address: str, timeout_s: float = 10.0, tls: Optional[t.Tls] = None, vehicle_id: str = ""):
        self.timeout_s = timeout_s
        options, credentials = arguments(tls)
        secure = credentials is not None
        channel = grpc.aio.secure_channel(address, credentials, options) if secure else grpc.aio.insecure_channel(address, options)
        self._channel = channel
        self._metadata: Tuple[Tuple[str, str], ...] = ((HEADER, vehicle_id),) if vehicle_id else ()
        self._stubs = {
            "sessions": sessions_pb2_grpc.SessionsStub(channel),
            "prediction": prediction_pb2_grpc.PredictionStub(channel),
            "terrain": terrain_pb2_grpc.TerrainStub(channel),
            "soil": soil_pb2_grpc.SoilStub(channel),
            "diagnosis": diagnosis_pb2_grpc.DiagnosisStub(channel),
            "measurements": measurements_pb2_grpc.MeasurementsStub(channel),
        }
        self._known_states = calls.KnownStates()

    async def __aenter__(self) -> "AsyncClient":
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes the connection."""
        await self._channel.close()

    async def _do(self, call: calls.Call, timeout_s: Optional[float] = None):
        method = getattr(self._stubs[call.service], call.method)
        try:
            timeout = self.timeout_s if timeout_s is None else timeout_s
            return call.read(await method(call.request, timeout=timeout, metadata=self._metadata))
        except grpc.RpcError as error:
            raise from_rpc(error) from None

    async def _watch(self, service: str, method: str, request, read):
        call = getattr(self._stubs[service], method)(request, metadata=self._metadata)
        try:
            async for message in call:
                yield read(message)
        except grpc.RpcError as error:
            raise from_rpc(error) from None
        finally:
            # Whoever stops listening ends the call, and what the service does for it.
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
        return await self._do(calls.open_session(vehicle_id, session_id, map_id, vehicle_card, initial))

    async def session(self, session_id: str) -> t.Session:
        """As `Client.session`."""
        return await self._do(calls.session(session_id))

    async def sessions(self) -> List[t.Session]:
        """As `Client.sessions`."""
        return await self._do(calls.sessions())

    async def fork_session(self, session_id: str, new_session_id: str) -> t.Session:
        """As `Client.fork_session`."""
        return await self._do(calls.fork_session(session_id, new_session_id))

    async def export_session(self, session_id: str) -> bytes:
        """As `Client.export_session`."""
        return await self._do(calls.export_session(session_id))

    async def import_session(self, image: bytes, session_id: str = "") -> t.Session:
        """As `Client.import_session`."""
        return await self._do(calls.import_session(image, session_id))

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

    def alarms(self, session_id: str) -> AsyncIterator[t.Alarm]:
        """As `Client.alarms`, for `async for`."""
        return self._watch("sessions", "WatchAlarms", alarms_pb2.WatchAlarmsRequest(session_id=session_id), m.alarm)

    def diagnose(
        self,
        session_id: str,
        recording: str = "",
        from_stamp_ns: Optional[int] = None,
        to_stamp_ns: Optional[int] = None,
        seed: Optional[int] = None,
        reference: str = "bundle",
        controls: bool = True,
    ) -> AsyncIterator[t.DiagnosisEvent]:
        """As `Client.diagnose`, for `async for`; `aclose()` or the end of the task ends it."""
        request = diagnosis.request(session_id, recording, from_stamp_ns, to_stamp_ns, seed, reference, controls)
        return self._watch("diagnosis", "Start", request, diagnosis.event)

    # Soil

    def watch_soil(self, session_id: str) -> AsyncIterator[t.SoilEstimate]:
        """As `Client.watch_soil`, for `async for`."""
        return self._watch("soil", "Watch", soil_pb2.WatchSoilRequest(session_id=session_id), t.soil_estimate)

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
        return await self._do(calls.patch_tile(map_id, base_version, row, column, elevation_m, semantic_rgb))

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

    def measurement_stream(self) -> "AsyncMeasurementStream":
        """An open stream for a vehicle that reports at its own pace; use it in an `async with` block."""
        return AsyncMeasurementStream(self)

    # Predictions

    async def predict(
        self,
        session_id: str,
        controls: Union[np.ndarray, Drawing],
        start: Optional[Sequence[float]] = None,
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
            session_id,
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
        except calls.LATE as error:
            return self._known_states.fall_back(question, error)


class AsyncMeasurementStream:
    """One open stream. Tasks may share it: each `send` is answered in its turn."""

    def __init__(self, client: AsyncClient):
        self._client = client
        self._stream = client._stubs["measurements"].Stream(metadata=client._metadata)
        self._turn = asyncio.Lock()

    async def __aenter__(self) -> "AsyncMeasurementStream":
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def send(self, measurement: t.Measurement, timeout_s: Optional[float] = None) -> t.Answer:
        """As `MeasurementStream.send`."""
        message = m.measurement_message(measurement)
        timeout_s = self._client.timeout_s if timeout_s is None else timeout_s
        async with self._turn:
            asked = self._client._known_states.ask()
            try:
                reply = await asyncio.wait_for(self._exchange(message), timeout_s)
            except asyncio.TimeoutError:
                self._stream.cancel()
                raise DeadlineExceeded(grpc.StatusCode.DEADLINE_EXCEEDED, "", f"no answer to a measurement in {timeout_s:.3g} s") from None
            except asyncio.InvalidStateError:
                raise Unavailable(grpc.StatusCode.UNAVAILABLE, "", "the measurement stream is closed") from None
            except grpc.RpcError as error:
                raise from_rpc(error) from None
        if reply is grpc.aio.EOF:
            raise Unavailable(grpc.StatusCode.UNAVAILABLE, "", "the service ended the measurement stream")
        answer = m.answer(reply)
        self._client._known_states.measured(asked, measurement, answer)
        return answer

    async def _exchange(self, message: measurements_pb2.Measurement) -> measurements_pb2.MeasurementAnswer:
        await self._stream.write(message)
        return await self._stream.read()

    async def close(self) -> None:
        """Says that no more measurements come."""
        if not self._stream.done():
            await self._stream.done_writing()
