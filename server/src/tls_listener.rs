//! TLS connections: handshakes run beside one another, each with the certificates that are in force when it begins.

use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::sync::{mpsc, watch};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::server::TlsStream;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::server::TcpIncoming;

use crate::grpc::stopped;

/// Connections that wait to be served.
const WAITING: usize = 64;
/// Pause after a connection could not be accepted, for want of file descriptors for instance.
const PAUSE: Duration = Duration::from_millis(50);

/// Connections whose handshake has succeeded within `handshake`; the others are closed.
pub fn accept(
    incoming: TcpIncoming,
    tls: watch::Receiver<Arc<ServerConfig>>,
    handshake: Duration,
    stopping: watch::Receiver<bool>,
) -> ReceiverStream<std::io::Result<TlsStream<TcpStream>>> {
    let (sender, receiver) = mpsc::channel(WAITING);
    tokio::spawn(async move {
        let stop = stopped(stopping);
        tokio::pin!(stop, incoming);
        loop {
            let socket = tokio::select! {
                socket = incoming.next() => socket,
                () = &mut stop => return,
            };
            let socket = match socket {
                Some(Ok(socket)) => socket,
                Some(Err(error)) => {
                    tracing::warn!(%error, "a connection was not accepted");
                    tokio::time::sleep(PAUSE).await;
                    continue;
                }
                None => return,
            };
            let acceptor = TlsAcceptor::from(tls.borrow().clone());
            let sender = sender.clone();
            tokio::spawn(async move {
                match tokio::time::timeout(handshake, acceptor.accept(socket)).await {
                    Ok(Ok(connection)) => drop(sender.send(Ok(connection)).await),
                    Ok(Err(error)) => tracing::debug!(%error, "handshake failed"),
                    Err(_) => tracing::debug!("handshake took too long"),
                }
            });
        }
    });
    ReceiverStream::new(receiver)
}
