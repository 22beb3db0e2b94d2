"""What a connection needs, of either kind of client."""

from typing import List, Optional, Tuple

import grpc

from ._types import Tls

REPLY_BYTES_MAX = 16 << 20
"""Largest reply that is accepted."""


def arguments(tls: Optional[Tls]) -> Tuple[List[Tuple[str, object]], Optional[grpc.ChannelCredentials]]:
    """Options and credentials of a channel; None = no TLS."""
    options: List[Tuple[str, object]] = [("grpc.max_receive_message_length", REPLY_BYTES_MAX)]
    if tls is None:
        return options, None
    if tls.server_name:
        options.append(("grpc.ssl_target_name_override", tls.server_name))
    return options, grpc.ssl_channel_credentials(tls.authority, tls.key, tls.certificate)
