//! How soon whoever asks in vain learns it.

use std::convert::Infallible;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Instant;

use tonic::body::Body;
use tonic::codegen::{BoxFuture, Service, http};
use tonic::server::NamedService;
use tonic::{Code, Status};

use crate::telemetry::Metrics;

/// A service whose refusals for want of room (RESOURCE_EXHAUSTED) are timed, from the head of a request to the refusal that is given to the connection: reading and decoding the
/// request are part of it, the network is not.
#[derive(Clone)]
pub(crate) struct RefusalsTimed<S> {
    pub service: S,
    pub metrics: Arc<Metrics>,
}

impl<S: NamedService> NamedService for RefusalsTimed<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<http::Request<Body>> for RefusalsTimed<S>
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
        let (begun, metrics) = (Instant::now(), self.metrics.clone());
        let reply = self.service.call(request);
        Box::pin(async move {
            let response = reply.await?;
            if Status::from_header_map(response.headers()).is_some_and(|status| status.code() == Code::ResourceExhausted) {
                metrics.refused(begun.elapsed());
            }
            Ok(response)
        })
    }
}
