"""What a connection needs, of either kind of client."""

from typing import List, Optional, Tuple

import grpc

from ._types import Tls

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


def arguments(tls: Optional[Tls]) -> Tuple[List[Tuple[str, object]], Optional[grpc.ChannelCredentials]]:
    """Options and credentials of a channel; None = no TLS."""
    options: List[Tuple[str, object]] = [("grpc.max_receive_message_length", REPLY_BYTES_MAX), *_PATIENCE]
    if tls is None:
        return options, None
    if tls.server_name:
        options.append(("grpc.ssl_target_name_override", tls.server_name))
    return options, grpc.ssl_channel_credentials(tls.authority, tls.key, tls.certificate)
