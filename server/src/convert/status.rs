//! Refusals as gRPC status.

use nesam_engine::EngineError;
use tonic::{Code, Status};

/// Trailing metadata that carries the path of the field at fault.
pub const FIELD_METADATA: &str = "nesam-field";

/// Code of a refusal.
pub fn code(error: &EngineError) -> Code {
    match error {
        EngineError::UnknownSession { .. } | EngineError::UnknownMap { .. } => Code::NotFound,
        EngineError::SessionExists { .. } | EngineError::MapExists { .. } => Code::AlreadyExists,
        EngineError::MapChanged { .. } => Code::Aborted,
        EngineError::MapInUse { .. } | EngineError::NotReady { .. } => Code::FailedPrecondition,
        EngineError::Invalid { .. } => Code::InvalidArgument,
        EngineError::Exhausted { .. } | EngineError::Overloaded { .. } => Code::ResourceExhausted,
        EngineError::Expired => Code::DeadlineExceeded,
        EngineError::Abandoned => Code::Cancelled,
        EngineError::Stopped => Code::Unavailable,
        EngineError::Internal { .. } => Code::Internal,
    }
}

/// A refusal as gRPC status: message, code, and the field in the metadata.
pub fn to_status(error: EngineError) -> Status {
    if matches!(error, EngineError::Internal { .. }) {
        tracing::error!(%error, "internal error");
    }
    let mut status = Status::new(code(&error), error.to_string());
    if let Ok(field) = error.field().parse() {
        status.metadata_mut().insert(FIELD_METADATA, field);
    }
    status
}
