//! How soon whoever asks in vain learns it.

use std::sync::Arc;
use std::time::Instant;

use axum::extract::Request;
use axum::middleware::{Next, from_fn};
use nesam_proto::v1::prediction_server::SERVICE_NAME;
use tonic::service::Routes;
use tonic::{Code, Status};

use crate::telemetry::Metrics;

/// The same services, with the refusals of predictions for want of room (RESOURCE_EXHAUSTED) timed, from the head of a request to the refusal that is given to the connection: reading
/// and decoding the request are part of it, the network is not.
pub(crate) fn time_refusals(routes: Routes, metrics: Arc<Metrics>) -> Routes {
    let router = routes.into_axum_router().layer(from_fn(move |request: Request, next: Next| {
        let timed = request.uri().path().trim_start_matches('/').starts_with(SERVICE_NAME).then(|| (Instant::now(), metrics.clone()));
        async move {
            let response = next.run(request).await;
            if let Some((begun, metrics)) = timed
                && Status::from_header_map(response.headers()).is_some_and(|status| status.code() == Code::ResourceExhausted)
            {
                metrics.refused(begun.elapsed());
            }
            response
        }
    }));
    Routes::from(router)
}
