//! Predictions over Zenoh: a queryable on `.../predict`.

use ::zenoh::bytes::ZBytes;
use nesam_engine::EngineError;
use nesam_proto::pieces::{Pieces, head};
use nesam_proto::v1 as pb;

use super::{decode, encode, keys};
use crate::cluster::{Brought, Standing};
use crate::convert::{predict_bytes_max, predict_error};
use crate::grpc::Edge;
use crate::grpc::predict as answer;
use crate::telemetry::Transport;

/// Answers `PredictRequest` payloads with `PredictReply` payloads, or with `PredictError` as an error reply.
pub async fn declare(session: &::zenoh::Session, fleet: &str, edge: Edge) -> Result<(), ::zenoh::Error> {
    let runtime = tokio::runtime::Handle::current();
    let queryable = session.declare_queryable(keys::all_vehicles(fleet, "predict")).callback(move |query| {
        edge.engine.metrics().request(Transport::Zenoh, "predict");
        runtime.spawn(reply(edge.clone(), query));
    });
    queryable.background().await
}

/// Why a session is not asked through the key of a vehicle: it belongs to another one. Routers give rights by key.
fn foreign(edge: &Edge, session: &str, vehicle: &str) -> Option<EngineError> {
    // Whose it is is not told: whoever asks may have no right to know.
    edge.access.directory.is_foreign(session, vehicle).then(|| {
        let reason = format!(
            "session `{session}` is of another vehicle than `{vehicle}`, through whose key it was asked; use the key of its vehicle"
        );
        EngineError::invalid("session_id", reason)
    })
}

/// Why a session cannot be asked here.
enum Absent {
    Elsewhere,
    Refused(EngineError),
}

/// Every server is asked; the one that has the session answers, and where there is none the first that gets it.
async fn absent(edge: &Edge, session: &str, vehicle: &str) -> Option<Absent> {
    let cluster = edge.cluster.as_ref()?;
    let brought = match cluster.standing(session) {
        Standing::Here => Some(Brought::Here),
        Standing::Elsewhere => None,
        Standing::Lost => cluster.search(session, vehicle, edge.stream_budget()).await,
    };
    match brought {
        Some(Brought::Here) => None,
        Some(Brought::Nowhere) => Some(Absent::Refused(EngineError::UnknownSession { session: session.into() })),
        None => Some(Absent::Elsewhere),
    }
}

/// The states behind the rest as they lie in the engine's answer: the network copies them once, to where they are read.
fn in_pieces(mut reply: pb::PredictReply) -> ZBytes {
    let states = std::mem::take(&mut reply.states);
    let mut message = ZBytes::writer();
    message.append(head(&reply, pb::PredictReply::STATES, states.len()).into());
    message.append(states.into());
    message.finish()
}

fn slice(payload: &ZBytes, at: usize) -> &[u8] {
    payload.slices().nth(at).unwrap_or_default()
}

async fn reply(edge: Edge, query: ::zenoh::query::Query) {
    let key = query.key_expr().clone();
    let decoded = {
        // Read where it lies: in shared memory that is the planner's own buffer.
        let payload = query.payload().map(|payload| Pieces::lent(payload, payload.slices().count(), slice)).unwrap_or_default();
        decode::<pb::PredictRequest>("nesam.v1.PredictRequest", payload, predict_bytes_max(edge.engine.handle().limits()))
    };
    let result = match decoded {
        Ok(mut request) => {
            if request.session_id.is_empty() {
                request.session_id = keys::vehicle(key.as_str()).into();
            }
            match absent(&edge, &request.session_id, keys::vehicle(key.as_str())).await {
                // The server that has the session answers.
                Some(Absent::Elsewhere) => return,
                Some(Absent::Refused(error)) => Err((request.tag, error)),
                None => match foreign(&edge, &request.session_id, keys::vehicle(key.as_str())) {
                    Some(error) => Err((request.tag, error)),
                    None => answer(&edge, &request, edge.stream_budget()).await.map_err(|error| (request.tag, error)),
                },
            }
        }
        Err(error) => Err((0, error)),
    };
    let sent = match result {
        Ok(prediction) => query.reply(key, in_pieces(prediction)).await,
        Err((tag, error)) => query.reply_err(encode(&predict_error(tag, &error))).await,
    };
    if let Err(error) = sent {
        tracing::warn!(%error, "prediction not delivered");
    }
}
