//! Refusals as gRPC status.

use std::time::Duration;

use nesam_engine::EngineError;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt as _};

/// Trailing metadata that carries the path of the field at fault.
pub const FIELD_METADATA: &str = "nesam-field";

/// Characters of a message.
const MESSAGE_CHARACTERS_MAX: usize = 1000;

/// Code of a refusal.
pub fn code(error: &EngineError) -> Code {
    match error {
        EngineError::UnknownSession { .. } | EngineError::UnknownMap { .. } => Code::NotFound,
        EngineError::SessionExists { .. } | EngineError::MapExists { .. } => Code::AlreadyExists,
        EngineError::MapChanged { .. } => Code::Aborted,
        EngineError::MapInUse { .. } | EngineError::NotReady { .. } => Code::FailedPrecondition,
        EngineError::Invalid { .. } | EngineError::ForeignImage { .. } => Code::InvalidArgument,
        EngineError::Exhausted { .. } | EngineError::Overloaded { .. } => Code::ResourceExhausted,
        EngineError::Expired => Code::DeadlineExceeded,
        EngineError::Abandoned => Code::Cancelled,
        EngineError::Stopped => Code::Unavailable,
        EngineError::RefusedMeasurement { cause, .. } => code(cause),
        EngineError::Internal { .. } => Code::Internal,
    }
}

/// A refusal as gRPC status: message, code, the field in the metadata, and for an overload google.rpc.RetryInfo.
pub fn to_status(error: EngineError) -> Status {
    if matches!(error, EngineError::Internal { .. }) {
        tracing::error!(%error, "internal error");
    }
    let message = short(error.to_string());
    let status = match &error {
        EngineError::Overloaded { retry_after_ns, .. } => {
            let details = ErrorDetails::with_retry_info(Some(Duration::from_nanos(*retry_after_ns)));
            Status::with_error_details(code(&error), message, details)
        }
        _ => Status::new(code(&error), message),
    };
    at_field(status, error.field())
}

/// A message that fits into the trailers that every client takes (8 KiB with all else in them, each letter up to six bytes of them).
fn short(message: String) -> String {
    match message.char_indices().nth(MESSAGE_CHARACTERS_MAX) {
        Some((end, _)) => format!("{}…", &message[..end]),
        None => message,
    }
}

/// A refusal that names the field at fault, in its message and in the metadata.
pub(crate) fn refused(code: Code, field: &str, reason: impl core::fmt::Display) -> Status {
    at_field(Status::new(code, short(format!("`{field}`: {reason}"))), field)
}

fn at_field(mut status: Status, field: &str) -> Status {
    if let Ok(field) = field.parse() {
        status.metadata_mut().insert(FIELD_METADATA, field);
    }
    status
}
