//! Connections as they come, those of gRPC with TLS or without. Handshakes run beside one another, each with the certificates that are in force when it begins.

use std::io::ErrorKind;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, watch};
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

/// Connections of gRPC, `tls` says with which certificates; `places` of them at a time.
pub(crate) struct Entrance {
    pub listener: TcpListener,
    pub places: usize,
    pub closing: Closing,
}

impl Entrance {
    /// Connections without TLS.
    pub fn open(self) -> ReceiverStream<std::io::Result<Connection<TcpStream>>> {
        self.admit(|socket, place, closing, sender| async move {
            let _ = sender.send(Ok(Connection::new(socket, place, &closing))).await;
        })
    }

    /// Connections whose handshake has succeeded in the time that they have to begin; the others are closed and counted.
    pub fn with_tls(
        self,
        tls: watch::Receiver<Arc<ServerConfig>>,
        refusals: Refusals,
    ) -> ReceiverStream<std::io::Result<Connection<TlsStream<TcpStream>>>> {
        self.admit(move |socket, place, closing, sender| {
            let acceptor = TlsAcceptor::from(tls.borrow().clone());
            let refusals = refusals.clone();
            async move {
                let peer = socket.peer_addr().map(|address| address.to_string()).unwrap_or_default();
                let reason = match tokio::time::timeout(closing.begins_within, acceptor.accept(socket)).await {
                    Ok(Ok(connection)) => return drop(sender.send(Ok(Connection::new(connection, place, &closing))).await),
                    // A proxy that looks whether the port is open.
                    Ok(Err(error)) if error.kind() == ErrorKind::UnexpectedEof => return,
                    Ok(Err(error)) => error.to_string(),
                    Err(_) => "it took too long".into(),
                };
                refusals.count(Refusal::Handshake);
                tracing::info!(target: "nesam::audit", peer, reason, "refused: no handshake");
            }
        })
    }

    /// Begins each connection beside the others, until the server stops.
    fn admit<C, F>(
        self,
        begin: impl Fn(TcpStream, Place, Closing, mpsc::Sender<std::io::Result<C>>) -> F + Send + 'static,
    ) -> ReceiverStream<std::io::Result<C>>
    where
        C: Send + 'static,
        F: Future<Output = ()> + Send + 'static,
    {
        let (sender, receiver) = mpsc::channel(WAITING);
        tokio::spawn(async move {
            let mut sockets = PlacedSockets::of(self.listener, self.places, self.closing.stopping.clone());
            while let Some((place, socket)) = sockets.next().await {
                tokio::spawn(begin(socket, place, self.closing.clone(), sender.clone()));
            }
        });
        ReceiverStream::new(receiver)
    }
}

/// One of the connections that may be open at a time.
pub(crate) type Place = OwnedSemaphorePermit;

/// The sockets of a listener until the server stops, each with a place; while there is none they wait in the system.
pub(crate) struct PlacedSockets {
    sockets: Sockets,
    places: Arc<Semaphore>,
    stopping: watch::Receiver<bool>,
}

impl PlacedSockets {
    /// Of a listener, so many at a time.
    pub fn of(listener: TcpListener, places: usize, stopping: watch::Receiver<bool>) -> Self {
        Self { sockets: Sockets::of(listener), places: Arc::new(Semaphore::new(places)), stopping }
    }

    /// The next one; `None` where none comes any more, or none is wanted.
    pub async fn next(&mut self) -> Option<(Place, TcpStream)> {
        let placed = async {
            // First a place: what nobody can serve yet takes no file descriptor.
            let place = Arc::clone(&self.places).acquire_owned().await.expect("nobody closes it; this is a bug");
            Some((place, self.sockets.next().await?))
        };
        tokio::select! {
            placed = placed => placed,
            () = stopped(self.stopping.clone()) => None,
        }
    }
}

/// The sockets of a listener. Where none can be had, it is tried again after a pause, and said once.
struct Sockets {
    incoming: TcpIncoming,
    pause: Option<Pin<Box<Sleep>>>,
    is_failing: bool,
}

impl Sockets {
    /// Of a listener.
    fn of(listener: TcpListener) -> Self {
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
