//! One connection of gRPC: it does not stay open if its client says nothing, and does not close before a slow client has read its answers.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::watch;
use tokio::time::{Instant, Sleep};
use tonic::transport::server::Connected;

use crate::grpc::stopped;
use crate::listener::Place;

/// Bytes with which every client begins HTTP/2.
const PREFACE_BYTES: usize = 24;
/// Largest write that is no answer worth waiting for, bytes: pings, settings and the like. Chosen.
const SMALL_WRITE: usize = 1 << 10;

/// When connections are closed.
#[derive(Clone)]
pub(crate) struct Closing {
    /// Longest time until a client has begun; keep-alive watches over it from then on.
    pub begins_within: Duration,
    /// Longest time for which a client may read what was written before the connection was closed.
    pub reads_within: Duration,
    /// Whether the server stops: it does not wait for who has not begun.
    pub stopping: watch::Receiver<bool>,
}

/// A connection over `io`.
pub(crate) struct Connection<IO> {
    /// Goes with it.
    _place: Place,
    io: IO,
    /// Bytes of the preface that have not come yet.
    preface_left: usize,
    /// Resolves when they come too late.
    too_late: Pin<Box<dyn Future<Output = ()> + Send>>,
    /// When an answer was last written.
    answered: Option<Instant>,
    reads_within: Duration,
    /// Resolves when a client that still reads is waited for no longer; `None` until the connection is closed.
    read_by: Option<Pin<Box<Sleep>>>,
}

impl<IO> Connection<IO> {
    /// A connection that has just been made.
    pub fn new(io: IO, place: Place, closing: &Closing) -> Self {
        let in_time = tokio::time::timeout(closing.begins_within, stopped(closing.stopping.clone()));
        let too_late = Box::pin(async move {
            let _ = in_time.await;
        });
        Self { _place: place, io, preface_left: PREFACE_BYTES, too_late, answered: None, reads_within: closing.reads_within, read_by: None }
    }

    /// Notes what was written.
    fn wrote(&mut self, written: &Poll<io::Result<usize>>) {
        if matches!(written, Poll::Ready(Ok(bytes)) if *bytes > SMALL_WRITE) {
            self.answered = Some(Instant::now());
        }
    }
}

impl<IO: AsyncRead + Unpin> Connection<IO> {
    /// Resolves when the client has read everything, which it tells by closing its side, or was waited for long enough. What it sends meanwhile is read and
    /// dropped: unread bytes make the system reset the connection, and what is on its way to the client would be lost.
    fn poll_read_by_client(&mut self, context: &mut Context<'_>) -> Poll<()> {
        let Some(read_by) = &mut self.read_by else { return Poll::Ready(()) };
        // First: reads that never pend use up the task's budget, and a timer does not tell without it.
        if read_by.as_mut().poll(context).is_ready() {
            return Poll::Ready(());
        }
        let mut dropped = [0; 4096];
        loop {
            let mut buffer = ReadBuf::new(&mut dropped);
            match Pin::new(&mut self.io).poll_read(context, &mut buffer) {
                Poll::Ready(Ok(())) if !buffer.filled().is_empty() => {}
                Poll::Ready(_) => return Poll::Ready(()),
                Poll::Pending => return Poll::Pending,
            }
        }
    }
}

impl<IO: Connected> Connected for Connection<IO> {
    type ConnectInfo = IO::ConnectInfo;

    fn connect_info(&self) -> IO::ConnectInfo {
        self.io.connect_info()
    }
}

impl<IO: AsyncRead + Unpin> AsyncRead for Connection<IO> {
    fn poll_read(mut self: Pin<&mut Self>, context: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        if let Poll::Ready(read) = Pin::new(&mut self.io).poll_read(context, buffer) {
            self.preface_left = self.preface_left.saturating_sub(buffer.filled().len() - before);
            return Poll::Ready(read);
        }
        if self.preface_left > 0 && self.too_late.as_mut().poll(context).is_ready() {
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        Poll::Pending
    }
}

impl<IO: AsyncRead + AsyncWrite + Unpin> AsyncWrite for Connection<IO> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.io).poll_write(context, bytes);
        self.wrote(&written);
        written
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        if self.read_by.is_none() {
            ready!(Pin::new(&mut self.io).poll_shutdown(context))?;
            // A client that has gone without a word is not waited for, unless it was just answered.
            if self.answered.is_some_and(|at| at.elapsed() < self.reads_within) {
                self.read_by = Some(Box::pin(tokio::time::sleep(self.reads_within)));
            }
        }
        self.poll_read_by_client(context).map(Ok)
    }

    fn poll_write_vectored(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[io::IoSlice<'_>]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.io).poll_write_vectored(context, bytes);
        self.wrote(&written);
        written
    }

    fn is_write_vectored(&self) -> bool {
        self.io.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::{TcpSocket, TcpStream};

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(60);

    /// A client with a small buffer, and the server's side of its connection.
    async fn connected() -> (TcpStream, Connection<TcpStream>, watch::Sender<bool>) {
        let listening = TcpSocket::new_v4().unwrap();
        listening.bind("127.0.0.1:0".parse().unwrap()).unwrap();
        let listener = listening.listen(1).unwrap();
        let slow = TcpSocket::new_v4().unwrap();
        slow.set_recv_buffer_size(4 << 10).unwrap();
        let client = slow.connect(listener.local_addr().unwrap()).await.unwrap();
        let (socket, _) = listener.accept().await.unwrap();
        let (stop, stopping) = watch::channel(false);
        let place = std::sync::Arc::new(tokio::sync::Semaphore::new(1)).try_acquire_owned().unwrap();
        (client, Connection::new(socket, place, &Closing { begins_within: PATIENCE, reads_within: PATIENCE, stopping }), stop)
    }

    /// Goal: a slow client gets all of an answer although the server has closed the connection, and may send on meanwhile. Method: an answer of many times the
    /// client's buffer, a client that sends a byte after each part, as window updates come; a closed socket would be reset by it.
    #[tokio::test]
    async fn regress_a_slow_client_reads_to_the_end() {
        const BYTES: usize = 256 << 10;
        let (mut client, mut connection, _stop) = connected().await;
        let server = tokio::spawn(async move {
            connection.write_all(&vec![7_u8; BYTES]).await.unwrap();
            connection.shutdown().await.unwrap();
        });
        let (mut read, mut part) = (0, [0; 2048]);
        loop {
            let bytes = client.read(&mut part).await.unwrap();
            if bytes == 0 {
                break;
            }
            read += bytes;
            client.write_all(&[1]).await.unwrap();
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        assert_eq!(read, BYTES);
        drop(client);
        tokio::time::timeout(PATIENCE / 2, server).await.expect("it waits no longer than for the client").unwrap();
    }

    #[tokio::test]
    async fn regress_a_client_that_was_not_answered_is_not_waited_for() {
        let (_client, mut connection, _stop) = connected().await;
        connection.write_all(&[7_u8; 64]).await.unwrap();
        tokio::time::timeout(PATIENCE / 2, connection.shutdown()).await.expect("nothing is on its way").unwrap();
    }

    #[tokio::test]
    async fn regress_a_client_that_has_not_begun_ends_with_the_server() {
        let (_client, mut connection, stop) = connected().await;
        let silent = tokio::spawn(async move { connection.read(&mut [0; 8]).await.map_err(|error| error.kind()) });
        stop.send(true).unwrap();
        let ended = tokio::time::timeout(PATIENCE / 2, silent).await.expect("it is not waited for").unwrap();
        assert_eq!(ended, Err(io::ErrorKind::TimedOut));
    }
}
