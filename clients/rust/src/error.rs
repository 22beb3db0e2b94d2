//! What can go wrong between a client and the service.

use std::error::Error as _;
use std::time::Duration;

use tonic_types::StatusExt as _;

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
    /// A file of certificates cannot be read.
    #[error("{}: {source}", path.display())]
    File {
        /// File at fault.
        path: std::path::PathBuf,
        /// What the system said.
        source: std::io::Error,
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
        /// As [`ClientError::retry_after`].
        retry_after: Option<Duration>,
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

    /// Pause after which the service may have room or be there again, as it says itself; `None` where it does not say. No call is tried again by itself: what a
    /// planner asked would be late then, and who has many questions asks fewer at a time (docs/planner.md).
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Refused { retry_after, .. } => *retry_after,
            _ => None,
        }
    }

    pub(crate) fn protocol(reason: impl Into<String>) -> Self {
        Self::Protocol { reason: reason.into() }
    }
}

impl From<tonic::Status> for ClientError {
    fn from(status: tonic::Status) -> Self {
        let field = status.metadata().get("nesam-field").and_then(|v| v.to_str().ok()).unwrap_or_default().into();
        let retry_after = status.get_details_retry_info().and_then(|info| info.retry_delay);
        // How the server's transport says that the time the client gave was over, where it notices before engine and client do.
        let late = status.code() == tonic::Code::Cancelled && status.message() == "Timeout expired";
        // A connection that broke under the call: the transport says how it broke, as the source, where an answer of the service has none.
        let how = [tonic::Code::Cancelled, tonic::Code::Unknown, tonic::Code::Internal];
        let broken = status.source().is_some() && how.contains(&status.code());
        let code = match (late, broken) {
            (true, _) => tonic::Code::DeadlineExceeded,
            (false, true) => tonic::Code::Unavailable,
            (false, false) => status.code(),
        };
        Self::Refused { code, field, message: with_causes(&status), retry_after }
    }
}

/// What a status says and, where the transport failed, what that came from: a certificate that was refused, for instance.
fn with_causes(status: &tonic::Status) -> String {
    let mut text = status.message().to_string();
    let mut cause = status.source();
    while let Some(error) = cause {
        let said = error.to_string();
        if !text.contains(&said) {
            text = format!("{text}: {said}");
        }
        cause = error.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regress_a_deadline_that_the_transport_notices_is_a_deadline() {
        let of = |message: &str| ClientError::from(tonic::Status::cancelled(message)).code();
        assert_eq!(of("Timeout expired"), Some(tonic::Code::DeadlineExceeded));
        assert_eq!(of("the server is gone"), Some(tonic::Code::Cancelled));
    }

    /// Goal: a server that dies under a call looks like one that is away, as in the other clients. Method: what tonic makes of an error of the transport, and
    /// the same code as an answer of the service.
    #[test]
    fn regress_a_connection_that_breaks_is_unavailable() {
        let broken = tonic::Status::from_error(Box::new(std::io::Error::other("broken pipe")));
        assert_eq!(broken.code(), tonic::Code::Unknown);
        assert_eq!(ClientError::from(broken).code(), Some(tonic::Code::Unavailable));
        assert_eq!(ClientError::from(tonic::Status::unknown("said by the service")).code(), Some(tonic::Code::Unknown));
    }

    #[test]
    fn regress_a_refused_certificate_is_told() {
        #[derive(Debug, thiserror::Error)]
        #[error("transport error")]
        struct Transport {
            source: std::io::Error,
        }
        let error = Transport { source: std::io::Error::other("received fatal alert: CertificateRequired") };
        let told = ClientError::from(tonic::Status::from_error(Box::new(error))).to_string();
        assert!(told.ends_with("transport error: received fatal alert: CertificateRequired"), "{told}");
    }
}
