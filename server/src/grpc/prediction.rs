//! nesam.v1.Prediction.

use std::time::Duration;

use nesam_engine::EngineError;
use nesam_proto::v1 as pb;
use tokio_stream::StreamExt as _;
use tonic::{Code, Request, Response, Status, Streaming};

use super::used::Used;
use super::{Edge, ReplyStream, stopped};
use crate::access::Wish;
use crate::cluster::moved;
use crate::convert::{predict_error, predict_query, predict_reply};
use crate::telemetry::Transport;

/// Answers planners.
pub struct Service(pub Edge);

/// One request, the same for the unary method, the stream and Zenoh. It may take as long as it says itself, `longest` at most.
pub(crate) async fn predict(edge: &Edge, request: &pb::PredictRequest, longest: Duration) -> Result<pb::PredictReply, EngineError> {
    let (query, output) = predict_query(request, edge.engine.handle().limits())?;
    let (prediction, timing) = edge.engine.predict(query, budget(request, longest)?).await?;
    tracing::debug!(
        session = request.session_id,
        samples = request.samples,
        horizon = request.horizon,
        compute_s = timing.compute_s,
        "predicted"
    );
    Ok(predict_reply(request.tag, &prediction, output, timing))
}

/// Time that a request may take.
fn budget(request: &pb::PredictRequest, longest: Duration) -> Result<Duration, EngineError> {
    match request.budget_s {
        None => Ok(longest),
        // What no duration holds is longer than any deadline.
        Some(budget_s) if budget_s > 0.0 => Ok(Duration::try_from_secs_f64(budget_s).map_or(longest, |asked| asked.min(longest))),
        Some(budget_s) => Err(EngineError::invalid("budget_s", format!("is {budget_s}, a number above 0 is needed"))),
    }
}

#[tonic::async_trait]
impl pb::prediction_server::Prediction for Service {
    async fn predict(&self, request: Request<pb::PredictRequest>) -> Result<Response<pb::PredictReply>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "predict");
        self.0.allow(&request, Wish::ReadSession(&request.get_ref().session_id)).await?;
        let budget = self.0.budget(&request);
        predict(&self.0, request.get_ref(), budget).await.map(Response::new).map_err(|error| self.0.status(error))
    }

    type PredictStreamStream = ReplyStream<pb::PredictStreamReply>;

    async fn predict_stream(&self, request: Request<Streaming<pb::PredictRequest>>) -> Result<Response<Self::PredictStreamStream>, Status> {
        let edge = self.0.clone();
        let caller = edge.access.caller(&request)?;
        let mut inbound = request.into_inner();
        let (sender, receiver) = tokio::sync::mpsc::channel(1);
        tokio::spawn(async move {
            let stop = stopped(edge.stopping.clone());
            tokio::pin!(stop);
            let mut used = Used::of(&edge);
            loop {
                let item = tokio::select! {
                    item = inbound.next() => item,
                    session = used.gone() => Some(Err(moved(&session))),
                    () = &mut stop => Some(Err(Status::unavailable(EngineError::Stopped.to_string()))),
                    () = sender.closed() => None,
                };
                let reply = match item {
                    Some(Ok(request)) => match used.enter(&edge, &caller, Wish::ReadSession(&request.session_id)).await {
                        Ok(_) => tokio::select! {
                            reply = answer(&edge, &request) => Ok(reply),
                            // Nobody waits for it any more.
                            () = sender.closed() => return,
                        },
                        // The session has moved, and the planner is to come after it.
                        Err(status) if status.code() == Code::Unavailable => Err(status),
                        Err(status) => Ok(refused(request.tag, &status)),
                    },
                    Some(Err(status)) => Err(status),
                    None => return,
                };
                let last = reply.is_err();
                if sender.send(reply).await.is_err() || last {
                    return;
                }
            }
        });
        Ok(Response::new(Box::pin(tokio_stream::wrappers::ReceiverStream::new(receiver))))
    }
}

/// A request of a stream that its sender has no right to; the stream goes on.
fn refused(tag: u64, status: &Status) -> pb::PredictStreamReply {
    let error = pb::PredictError { tag, code: status.code().into(), field: "session_id".into(), message: status.message().into() };
    pb::PredictStreamReply { outcome: Some(pb::predict_stream_reply::Outcome::Error(error)) }
}

async fn answer(edge: &Edge, request: &pb::PredictRequest) -> pb::PredictStreamReply {
    edge.engine.metrics().request(Transport::Grpc, "predict_stream");
    let outcome = match predict(edge, request, edge.stream_budget()).await {
        Err(error @ EngineError::UnknownSession { .. }) if edge.cluster.is_some() => return refused(request.tag, &edge.status(error)),
        Ok(reply) => pb::predict_stream_reply::Outcome::Reply(reply),
        Err(error) => pb::predict_stream_reply::Outcome::Error(predict_error(request.tag, &error)),
    };
    pb::PredictStreamReply { outcome: Some(outcome) }
}
