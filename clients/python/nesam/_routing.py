"""The vehicle in every call, for a proxy that sends each vehicle always to the same server."""

import collections

import grpc

HEADER = "x-vehicle-id"


class _Details(
    collections.namedtuple("_Details", ("method", "timeout", "metadata", "credentials", "wait_for_ready", "compression")),
    grpc.ClientCallDetails,
):
    pass


class VehicleHeader(
    grpc.UnaryUnaryClientInterceptor,
    grpc.UnaryStreamClientInterceptor,
    grpc.StreamUnaryClientInterceptor,
    grpc.StreamStreamClientInterceptor,
):
    """Adds the metadata `x-vehicle-id`."""

    def __init__(self, vehicle_id: str):
        self._header = (HEADER, vehicle_id)

    def _with_header(self, details):
        metadata = list(details.metadata or ()) + [self._header]
        return _Details(
            details.method, details.timeout, metadata, details.credentials, details.wait_for_ready, getattr(details, "compression", None)
        )

    def intercept_unary_unary(self, continuation, details, request):
        return continuation(self._with_header(details), request)

    def intercept_unary_stream(self, continuation, details, request):
        return continuation(self._with_header(details), request)

    def intercept_stream_unary(self, continuation, details, requests):
        return continuation(self._with_header(details), requests)

    def intercept_stream_stream(self, continuation, details, requests):
        return continuation(self._with_header(details), requests)
