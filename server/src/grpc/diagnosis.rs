//! nesam.v1.Diagnosis.

use std::time::Duration;

use nesam_engine::EngineError;
use nesam_proto::v1 as pb;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};

use super::{Edge, ReplyStream, deadline, stopped};
use crate::access::{Caller, Wish};
use crate::diagnosis::{Told, Work};
use crate::telemetry::Transport;

/// Events that wait for the caller.
const WAITING: usize = 16;

/// Diagnoses what was recorded.
pub struct Service(pub Edge);

#[tonic::async_trait]
impl pb::diagnosis_server::Diagnosis for Service {
    type StartStream = ReplyStream<pb::DiagnosisEvent>;

    async fn start(&self, request: Request<pb::StartDiagnosisRequest>) -> Result<Response<Self::StartStream>, Status> {
        let edge = &self.0;
        edge.engine.metrics().request(Transport::Grpc, "start_diagnosis");
        let caller = edge.access.caller(&request)?;
        caller.may(Wish::Diagnose(&request.get_ref().session_id))?;
        let Some(diagnoses) = &edge.diagnoses else {
            return Err(Status::failed_precondition("this server starts no diagnoses"));
        };
        let budget = deadline::budget(request.metadata(), diagnoses.longest());
        let asked = request.into_inner();
        let session = asked.session_id.clone();
        let work = diagnoses.prepare(asked)?;
        let (sender, receiver) = mpsc::channel(WAITING);
        tokio::spawn(follow(edge.clone(), caller, session, work, budget, sender));
        Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
    }
}

/// Lets a diagnosis run until it has ended, or until nobody may or wants to hear it any more; tells last why it ended otherwise.
async fn follow(edge: Edge, caller: Caller, session: String, work: Work, budget: Duration, sender: Told) {
    let ended = tokio::select! {
        ended = work.run(&sender) => ended,
        () = sender.closed() => {
            tracing::info!(session, "diagnosis ended by its caller");
            return;
        }
        status = caller.loses(Wish::Diagnose(&session)) => Err(status),
        () = stopped(edge.stopping.clone()) => Err(Status::unavailable(EngineError::Stopped.to_string())),
        () = tokio::time::sleep(budget) => Err(late(budget)),
    };
    if let Err(status) = ended {
        tracing::warn!(session, code = ?status.code(), reason = status.message(), "diagnosis failed");
        let _ = sender.send(Err(status)).await;
    }
}

fn late(budget: Duration) -> Status {
    let seconds = budget.as_secs_f64();
    Status::deadline_exceeded(format!(
        "the diagnosis did not end within {seconds:.0} s (`diagnosis.limit_s`, or the caller's deadline); choose a shorter window"
    ))
}
