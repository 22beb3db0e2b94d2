//! Connections of HTTP: none stays open whose client says nothing or half of what it wants, and no more than a limit are open at a time.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::Request;
use axum::middleware::{Next, from_fn};
use bytes::Bytes;
use http_body::{Frame, SizeHint};
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto;
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;

use crate::grpc::stopped;
use crate::listener::PlacedSockets;

/// After a stop, time for which the end of an answer may be on its way where no request is unanswered any more (chosen: several round trips).
const LAST_WORDS: Duration = Duration::from_millis(500);

/// When connections are closed, and how many there may be.
#[derive(Clone)]
pub(crate) struct HttpLimits {
    /// Longest time from the begin of a connection, and from an answer, until a request has come with all its headers.
    pub asks_within: Duration,
    /// Connections at a time; more wait in the system until one ends.
    pub connections_max: usize,
}

/// Serves a router until the server stops, then until what was asked is answered.
pub(crate) async fn serve(listener: TcpListener, router: Router, limits: HttpLimits, stopping: watch::Receiver<bool>) {
    let unanswered = Unanswered::default();
    let router = unanswered.counts(router);
    let mut sockets = PlacedSockets::of(listener, limits.connections_max, stopping.clone());
    let mut connections = JoinSet::new();
    while let Some((place, socket)) = sockets.next().await {
        let served = serve_one(socket, router.clone(), limits.asks_within, unanswered.clone(), stopping.clone());
        connections.spawn(async move {
            served.await;
            drop(place);
        });
        while connections.try_join_next().is_some() {}
    }
    drop(sockets);
    while connections.join_next().await.is_some() {}
}

/// Serves one connection. After a stop it is left as soon as nothing is unanswered: half a request is none.
async fn serve_one(socket: TcpStream, router: Router, asks_within: Duration, unanswered: Unanswered, stopping: watch::Receiver<bool>) {
    let mut builder = auto::Builder::new(TokioExecutor::new()).http1_only();
    builder.http1().timer(TokioTimer::new()).header_read_timeout(asks_within);
    let connection = builder.serve_connection(TokioIo::new(socket), TowerToHyperService::new(router));
    tokio::pin!(connection);
    // How a connection ends says nothing that whoever ended it does not know.
    tokio::select! {
        _ = connection.as_mut() => return,
        () = stopped(stopping) => connection.as_mut().graceful_shutdown(),
    }
    loop {
        tokio::select! {
            _ = connection.as_mut() => return,
            () = tokio::time::sleep(LAST_WORDS) => if unanswered.is_empty() { return },
        }
    }
}

/// Requests of all connections whose answer is not written yet. Clones share it.
#[derive(Clone, Default)]
struct Unanswered(Arc<AtomicUsize>);

impl Unanswered {
    fn is_empty(&self) -> bool {
        self.0.load(Ordering::Relaxed) == 0
    }

    fn one_more(&self) -> Asked {
        self.0.fetch_add(1, Ordering::Relaxed);
        Asked(self.clone())
    }

    /// A router whose requests are counted until their answer is written.
    fn counts(&self, router: Router) -> Router {
        let unanswered = self.clone();
        router.layer(from_fn(move |request: Request, next: Next| {
            let asked = unanswered.one_more();
            async move { next.run(request).await.map(|body| Body::new(Answer { body, _asked: asked })) }
        }))
    }
}

/// One of them.
struct Asked(Unanswered);

impl Drop for Asked {
    fn drop(&mut self) {
        self.0.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// What is answered; dropped when it is written.
struct Answer {
    body: Body,
    _asked: Asked,
}

impl http_body::Body for Answer {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;

    use axum::routing::get;
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::sync::Notify;
    use tokio::task::JoinHandle;

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(60);
    const HALF: &[u8] = b"GET / HTTP/1.1\r\nhost:";
    const WHOLE: &[u8] = b"GET / HTTP/1.1\r\nhost: x\r\n\r\n";

    /// A server that answers `done` once it is told to, for each time that it is.
    struct Stage {
        address: SocketAddr,
        asked: Arc<Notify>,
        answers: Arc<Notify>,
        stop: watch::Sender<bool>,
        serving: JoinHandle<()>,
    }

    async fn stage(asks_within: Duration, connections_max: usize) -> Stage {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let (asked, answers) = (Arc::new(Notify::new()), Arc::new(Notify::new()));
        let (stop, stopping) = watch::channel(false);
        let answer = {
            let (asked, answers) = (asked.clone(), answers.clone());
            move || async move {
                asked.notify_one();
                answers.notified().await;
                "done"
            }
        };
        let serving =
            tokio::spawn(serve(listener, Router::new().route("/", get(answer)), HttpLimits { asks_within, connections_max }, stopping));
        Stage { address, asked, answers, stop, serving }
    }

    async fn says(address: SocketAddr, words: &[u8]) -> TcpStream {
        let mut socket = TcpStream::connect(address).await.unwrap();
        socket.write_all(words).await.unwrap();
        socket
    }

    /// What comes until the connection ends.
    async fn rest(mut socket: TcpStream) -> String {
        let mut heard = Vec::new();
        // A connection that is reset has ended too.
        let _ = tokio::time::timeout(PATIENCE / 2, socket.read_to_end(&mut heard)).await.expect("it ends");
        String::from_utf8(heard).unwrap()
    }

    #[tokio::test]
    async fn regress_who_says_nothing_half_or_nothing_more_is_not_kept() {
        let stage = stage(Duration::from_millis(200), 8).await;
        stage.answers.notify_one();
        for (words, answered) in [(&b""[..], false), (HALF, false), (WHOLE, true)] {
            let heard = rest(says(stage.address, words).await).await;
            assert_eq!(heard.ends_with("\r\n\r\ndone"), answered, "{heard}");
        }
    }

    #[tokio::test]
    async fn analytic_no_more_connections_are_served_than_there_are_places() {
        let stage = stage(PATIENCE, 2).await;
        let silent = [says(stage.address, b"").await, says(stage.address, HALF).await];
        let third = says(stage.address, WHOLE).await;
        stage.answers.notify_one();
        let early = tokio::time::timeout(Duration::from_millis(300), stage.asked.notified()).await;
        assert!(early.is_err(), "it has no place yet");
        drop(silent);
        tokio::time::timeout(PATIENCE / 2, stage.asked.notified()).await.expect("the places of the others are free");
        stage.stop.send(true).unwrap();
        assert!(rest(third).await.ends_with("\r\n\r\ndone"));
    }

    /// Goal: a stop waits for what was asked and not for what was not. Method: half a request, and a whole one whose answer is held back until long after the
    /// stop.
    #[tokio::test]
    async fn regress_a_stop_waits_for_answers_and_not_for_half_a_request() {
        let stage = stage(PATIENCE, 8).await;
        let _half = says(stage.address, HALF).await;
        let whole = says(stage.address, WHOLE).await;
        stage.asked.notified().await;
        stage.stop.send(true).unwrap();
        tokio::time::sleep(3 * LAST_WORDS).await;
        assert!(!stage.serving.is_finished(), "somebody waits for an answer");
        stage.answers.notify_one();
        assert!(rest(whole).await.ends_with("\r\n\r\ndone"));
        tokio::time::timeout(PATIENCE / 2, stage.serving).await.expect("half a request is not waited for").unwrap();
    }
}
