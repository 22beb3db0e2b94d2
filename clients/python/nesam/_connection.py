"""What a connection needs, of either kind of client."""

import json
import re
from typing import Dict, List, Optional, Tuple

import grpc
from google.protobuf.descriptor_pb2 import MethodOptions

from ._errors import Unavailable, from_rpc
from ._types import Tls
from .v1 import diagnosis_pb2, measurements_pb2, prediction_pb2, sessions_pb2, soil_pb2, terrain_pb2

Options = List[Tuple[str, object]]

REPLY_BYTES_MAX = 64 << 20
"""Largest reply that is accepted; the soil map of a fleet takes 25 MiB at the default limits of a server."""

# As the C++ client does. A server that has gone is noticed after 40 s, also while a stream rests; one that comes back is found within 2 s.
_PATIENCE = [
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 20_000),
    ("grpc.http2.max_pings_without_data", 0),
    ("grpc.initial_reconnect_backoff_ms", 200),
    ("grpc.max_reconnect_backoff_ms", 2_000),
]

# What gRPC keeps of a call, to send it again; without room for it a call is not tried again. It takes a prediction at the limits of the protocol.
_KEPT_BYTES_MAX = 16 << 20

ATTEMPTS_MAX = 5
"""As many as gRPC makes at most."""

# About 2 s from the first to the last of five attempts: a server has started again by then, or another one has taken its sessions over. gRPC makes each pause
# up to a fifth shorter or longer, so that clients of one server do not come back at once.
_PAUSES = {"initialBackoff": "0.1s", "backoffMultiplier": 2.5, "maxBackoff": "1s"}


# Addresses that gRPC takes apart itself.
_SCHEMES = ("unix:", "unix-abstract:", "vsock:", "dns:", "ipv4:", "ipv6:", "xds:")
_HOST_AND_PORT = re.compile(r"(\[[^\[\]]+\]|[^:\[\]]+):[0-9]+")

# Longer than anybody waits; gRPC takes an infinite time for one that is over.
_FOR_EVER_S = 1e9


class Connected:
    """What both clients know of their connection: whether they have closed it."""

    _is_closed = False

    def _refusal(self, error: Exception) -> Exception:
        """What a call raises that failed: the error by its class, and Unavailable where this client was closed before or meanwhile."""
        if not isinstance(error, grpc.RpcError):
            return _client_is_closed() if self._is_closed else error
        told = from_rpc(error)
        return _client_is_closed() if self._is_closed and told.code == grpc.StatusCode.CANCELLED else told


def _client_is_closed() -> Unavailable:
    return Unavailable(grpc.StatusCode.UNAVAILABLE, "", "the client is closed")


def finite_timeout(timeout_s: Optional[float]) -> Optional[float]:
    """A timeout as gRPC and the standard library take it, s; None = none, also for an infinite one."""
    return None if timeout_s is None or timeout_s >= _FOR_EVER_S else timeout_s


def arguments(address: str, tls: Optional[Tls]) -> Tuple[Options, Optional[grpc.ChannelCredentials]]:
    """Options and credentials of a channel; None = no TLS. ValueError for an address as a browser has it, which gRPC takes for the name of a host, and for one
    without a port, for which gRPC takes that of https."""
    if address.startswith(("http://", "https://")):
        raise ValueError(f"the address is {address}, expected host:port without http; whether TLS is used says `tls`")
    if not address.startswith(_SCHEMES) and not _HOST_AND_PORT.fullmatch(address):
        raise ValueError(f"the address is {address!r}, expected host:port, for example 127.0.0.1:50051 or [::1]:50051; the port is missing")
    options: Options = [("grpc.max_receive_message_length", REPLY_BYTES_MAX), ("grpc.per_rpc_retry_buffer_size", _KEPT_BYTES_MAX), *_PATIENCE]
    if tls is None:
        return options, None
    if tls.server_name:
        options.append(("grpc.ssl_target_name_override", tls.server_name))
    return options, grpc.ssl_channel_credentials(tls.authority, tls.key, tls.certificate)


def trying_again(attempts_max: int) -> Options:
    """What lets gRPC try calls again that only read, on UNAVAILABLE and within their deadline. ValueError for less than 1 attempt or more than 5."""
    if not 1 <= attempts_max <= ATTEMPTS_MAX:
        raise ValueError(f"attempts_max is {attempts_max}, allowed are 1 to {ATTEMPTS_MAX}")
    if attempts_max == 1:
        return []
    policy = {"maxAttempts": attempts_max, "retryableStatusCodes": ["UNAVAILABLE"], **_PAUSES}
    return [("grpc.service_config", json.dumps({"methodConfig": [{"name": reading_methods(), "retryPolicy": policy}]}))]


def reading_methods() -> List[Dict[str, str]]:
    """The methods of the protocol that have no side effects, as it says itself."""
    return [
        {"service": service.full_name, "method": method.name}
        for file in (diagnosis_pb2, measurements_pb2, prediction_pb2, sessions_pb2, soil_pb2, terrain_pb2)
        for service in file.DESCRIPTOR.services_by_name.values()
        for method in service.methods
        if method.GetOptions().idempotency_level == MethodOptions.NO_SIDE_EFFECTS
    ]
