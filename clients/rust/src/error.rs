//! What can go wrong between a client and the service.

/// Failure of a call.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The service cannot be reached.
    #[error("cannot reach {address}: {source}")]
    Connect {
        /// Address asked for.
        address: String,
        /// What the transport said.
        source: tonic::transport::Error,
    },
    /// The service refused.
    #[error("{code:?}: {message}")]
    Refused {
        /// gRPC code.
        code: tonic::Code,
        /// Path of the field at fault; empty when none is.
        field: String,
        /// What was wrong and what is allowed.
        message: String,
    },
    /// The service answered something that the protocol does not allow.
    #[error("unexpected answer: {reason}")]
    Protocol {
        /// What was unexpected.
        reason: String,
    },
    /// Zenoh reported an error.
    #[error("zenoh: {reason}")]
    Zenoh {
        /// What Zenoh said.
        reason: String,
    },
}

impl ClientError {
    /// gRPC code of a refusal.
    pub fn code(&self) -> Option<tonic::Code> {
        match self {
            Self::Refused { code, .. } => Some(*code),
            _ => None,
        }
    }

    /// Path of the field at fault; empty when none is.
    pub fn field(&self) -> &str {
        match self {
            Self::Refused { field, .. } => field,
            _ => "",
        }
    }

    pub(crate) fn protocol(reason: impl Into<String>) -> Self {
        Self::Protocol { reason: reason.into() }
    }
}

impl From<tonic::Status> for ClientError {
    fn from(status: tonic::Status) -> Self {
        let field = status.metadata().get("nesam-field").and_then(|v| v.to_str().ok()).unwrap_or_default().into();
        Self::Refused { code: status.code(), field, message: status.message().into() }
    }
}
