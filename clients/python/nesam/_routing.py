"""The vehicle in every call, for a proxy that sends each vehicle always to the same server."""

import collections
from typing import Any

import grpc

HEADER = "x-vehicle-id"


class _Details(
    collections.namedtuple("_Details", ("method", "timeout", "metadata", "credentials", "wait_for_ready", "compression")),
    grpc.ClientCallDetails,
):
    pass


class VehicleHeader(
    grpc.UnaryUnaryClientInterceptor,  # type: ignore[type-arg]
    grpc.UnaryStreamClientInterceptor,  # type: ignore[type-arg]
    grpc.StreamUnaryClientInterceptor,  # type: ignore[type-arg]
    grpc.StreamStreamClientInterceptor,  # type: ignore[type-arg]
):
    """Adds the metadata `x-vehicle-id`."""

    def __init__(self, vehicle_id: str):
        self._header = (HEADER, vehicle_id)

    def _with_header(self, details: Any) -> _Details:
        metadata = list(details.metadata or ()) + [self._header]
        return _Details(
            details.method, details.timeout, metadata, details.credentials, details.wait_for_ready, getattr(details, "compression", None)
        )

    def intercept_unary_unary(self, continuation: Any, details: Any, request: Any) -> Any:
        return continuation(self._with_header(details), request)

    def intercept_unary_stream(self, continuation: Any, details: Any, request: Any) -> Any:
        return continuation(self._with_header(details), request)

    def intercept_stream_unary(self, continuation: Any, details: Any, requests: Any) -> Any:
        return continuation(self._with_header(details), requests)

    def intercept_stream_stream(self, continuation: Any, details: Any, requests: Any) -> Any:
        return continuation(self._with_header(details), requests)
