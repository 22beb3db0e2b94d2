//! Requests of one message that begin and do not end.

use std::collections::HashSet;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::body::Body;
use axum::extract::Request;
use axum::middleware::{Next, from_fn};
use bytes::Bytes;
use http_body::Frame;
use nesam_proto::v1 as pb;
use prost::Message;
use tokio::time::{Instant, Sleep, sleep_until};
use tonic::Status;
use tonic::service::Routes;

/// The same services, whose requests of one message have to be there in time, `longest` after their head; streams may be silent for as long as their connection lives. DEADLINE_EXCEEDED is what
/// comes too late: keep-alive does not see it, as such a client answers pings.
pub(crate) fn arrive_in_time(routes: Routes, longest: Duration) -> Routes {
    let single = Arc::new(single_requests());
    let router = routes.into_axum_router().layer(from_fn(move |request: Request, next: Next| {
        let in_time = single.contains(request.uri().path()).then(|| Instant::now() + longest);
        async move {
            match in_time {
                None => next.run(request).await,
                Some(until) => {
                    let timed = |body| Body::new(Timed { body, longest, until: Box::pin(sleep_until(until)) });
                    next.run(request.map(timed)).await
                }
            }
        }
    }));
    Routes::from(router)
}

/// Paths of our methods whose request is one message.
fn single_requests() -> HashSet<String> {
    let described =
        prost_types::FileDescriptorSet::decode(pb::FILE_DESCRIPTOR_SET).expect("the committed descriptor set decodes; this is a bug");
    let services = described.file.iter().flat_map(|file| file.service.iter().map(move |service| (file.package(), service)));
    let methods = services.flat_map(|(package, service)| service.method.iter().map(move |method| (package, service.name(), method)));
    methods
        .filter(|(.., method)| !method.client_streaming())
        .map(|(package, service, method)| format!("/{package}.{service}/{}", method.name()))
        .collect()
}

/// What a client sends, until it is too late.
struct Timed {
    body: Body,
    longest: Duration,
    until: Pin<Box<Sleep>>,
}

impl http_body::Body for Timed {
    type Data = Bytes;
    type Error = axum::BoxError;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::BoxError>>> {
        if let Poll::Ready(frame) = Pin::new(&mut self.body).poll_frame(context) {
            return Poll::Ready(frame.map(|frame| frame.map_err(Into::into)));
        }
        ready!(self.until.as_mut().poll(context));
        let late = Status::deadline_exceeded(format!("the request was not there within {} s", self.longest.as_secs_f64()));
        Poll::Ready(Some(Err(late.into())))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> http_body::SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_streams_of_clients_may_be_silent() {
        let single = single_requests();
        for path in ["/nesam.v1.Sessions/Get", "/nesam.v1.Prediction/Predict", "/nesam.v1.Soil/Watch"] {
            assert!(single.contains(path), "{path} is not in {single:?}");
        }
        for path in ["/nesam.v1.Prediction/PredictStream", "/nesam.v1.Measurements/Stream", "/nesam.v1.Terrain/UploadMap"] {
            assert!(!single.contains(path), "{path} is in {single:?}");
        }
    }
}
