//! Services of libraries whose streams would go on for ever: health and reflection.

use std::convert::Infallible;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use http_body::Frame;
use nesam_engine::EngineError;
use tokio::sync::{oneshot, watch};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::{BoxFuture, Service, http};
use tonic::server::NamedService;

use super::stopped;

/// A service whose replies end with UNAVAILABLE when the server stops. Not for work that should be finished.
#[derive(Clone)]
pub(crate) struct UntilStopped<S> {
    pub service: S,
    pub stopping: watch::Receiver<bool>,
}

impl<S: NamedService> NamedService for UntilStopped<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<http::Request<Body>> for UntilStopped<S>
where
    S: Service<http::Request<Body>, Response = http::Response<Body>, Error = Infallible>,
    S::Future: Send + 'static,
{
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<http::Response<Body>, Infallible>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.service.poll_ready(context)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        // A service that waits for more to be asked would hold the stream. It hears of the end after the reply has ended: else it would end that itself, with OK.
        let (held, ended) = oneshot::channel::<()>();
        let ended = Box::pin(async move {
            let _ = ended.await;
        });
        let stopping = self.stopping.clone();
        let stop = Box::pin(async move {
            stopped(stopping).await;
            drop(held);
        });
        let asked = request.map(|body| Body::new(UntilThen { body, stop: ended, then: Then::End, is_over: false }));
        let reply = self.service.call(asked);
        Box::pin(async move { Ok(reply.await?.map(|body| Body::new(UntilThen { body, stop, then: Then::Unavailable, is_over: false }))) })
    }
}

/// What is sent until the server stops.
struct UntilThen {
    body: Body,
    stop: Pin<Box<dyn Future<Output = ()> + Send>>,
    then: Then,
    is_over: bool,
}

/// How a body ends when the server stops.
#[derive(Clone, Copy)]
enum Then {
    /// Nothing more comes.
    End,
    /// With the status UNAVAILABLE.
    Unavailable,
}

impl http_body::Body for UntilThen {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if self.is_over {
            return Poll::Ready(None);
        }
        // First what there is to say: a watch of health hears that nothing is served any more.
        if let Poll::Ready(frame) = Pin::new(&mut self.body).poll_frame(context) {
            return Poll::Ready(frame);
        }
        ready!(self.stop.as_mut().poll(context));
        self.is_over = true;
        if let Then::End = self.then {
            return Poll::Ready(None);
        }
        let mut trailers = http::HeaderMap::new();
        let ended = Status::unavailable(EngineError::Stopped.to_string()).add_header(&mut trailers);
        Poll::Ready(Some(ended.map(|()| Frame::trailers(trailers))))
    }

    fn is_end_stream(&self) -> bool {
        self.is_over || self.body.is_end_stream()
    }
}
