//! Connections as they come, those of gRPC with TLS or without. Handshakes run beside one another, each with the certificates that are in force when it begins.

use std::io::ErrorKind;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, watch};
use tokio::time::Sleep;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::server::TlsStream;
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt as _};
use tonic::transport::server::TcpIncoming;

use crate::access::{Refusal, Refusals};
use crate::connection::{Closing, Connection};
use crate::grpc::stopped;

/// Connections that wait to be served.
const WAITING: usize = 64;
/// Pause after a connection could not be accepted, for want of file descriptors for instance.
const PAUSE: Duration = Duration::from_millis(50);

/// Connections without TLS.
pub(crate) fn accept(listener: TcpListener, closing: Closing) -> impl Stream<Item = std::io::Result<Connection<TcpStream>>> {
    Sockets::of(listener).map(move |socket| Ok(Connection::new(socket, &closing)))
}

/// Connections whose handshake has succeeded in the time that they have to begin; the others are closed and counted.
pub(crate) fn accept_tls(
    listener: TcpListener,
    tls: watch::Receiver<Arc<ServerConfig>>,
    refusals: Refusals,
    closing: Closing,
) -> ReceiverStream<std::io::Result<Connection<TlsStream<TcpStream>>>> {
    let (sender, receiver) = mpsc::channel(WAITING);
    tokio::spawn(async move {
        let mut sockets = Sockets::of(listener);
        let stop = stopped(closing.stopping.clone());
        tokio::pin!(stop);
        loop {
            let socket = tokio::select! {
                socket = sockets.next() => socket,
                () = &mut stop => return,
            };
            let Some(socket) = socket else { return };
            let acceptor = TlsAcceptor::from(tls.borrow().clone());
            let (sender, refusals, closing) = (sender.clone(), refusals.clone(), closing.clone());
            tokio::spawn(async move {
                let peer = socket.peer_addr().map(|address| address.to_string()).unwrap_or_default();
                let reason = match tokio::time::timeout(closing.begins_within, acceptor.accept(socket)).await {
                    Ok(Ok(connection)) => return drop(sender.send(Ok(Connection::new(connection, &closing))).await),
                    // A proxy that looks whether the port is open.
                    Ok(Err(error)) if error.kind() == ErrorKind::UnexpectedEof => return,
                    Ok(Err(error)) => error.to_string(),
                    Err(_) => "it took too long".into(),
                };
                refusals.count(Refusal::Handshake);
                tracing::info!(target: "nesam::audit", peer, reason, "refused: no handshake");
            });
        }
    });
    ReceiverStream::new(receiver)
}

/// The sockets of a listener. Where none can be had, it is tried again after a pause, and said once.
pub(crate) struct Sockets {
    incoming: TcpIncoming,
    pause: Option<Pin<Box<Sleep>>>,
    is_failing: bool,
}

impl Sockets {
    /// Of a listener.
    pub fn of(listener: TcpListener) -> Self {
        Self { incoming: TcpIncoming::from(listener).with_nodelay(Some(true)), pause: None, is_failing: false }
    }
}

impl Stream for Sockets {
    type Item = TcpStream;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<TcpStream>> {
        loop {
            if let Some(pause) = &mut self.pause {
                ready!(pause.as_mut().poll(context));
                self.pause = None;
            }
            match ready!(Pin::new(&mut self.incoming).poll_next(context)) {
                Some(Ok(socket)) => {
                    self.is_failing = false;
                    return Poll::Ready(Some(socket));
                }
                Some(Err(error)) => {
                    if !self.is_failing {
                        tracing::warn!(%error, "connections are not accepted; tried again");
                    }
                    self.is_failing = true;
                    self.pause = Some(Box::pin(tokio::time::sleep(PAUSE)));
                }
                None => return Poll::Ready(None),
            }
        }
    }
}
