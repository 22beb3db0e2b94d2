//! The server's own certificate. One that no client would accept is not put in force: it would lock everybody out.

use std::time::Duration;

use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::{CertificateDer, TrustAnchor, UnixTime};
use webpki::{EndEntityCert, Error, KeyUsage};

use super::identity::Identity;

const DAY_S: f64 = 86_400.0;

/// When the certificate of a server expires, s since 1970.
///
/// # Errors
/// Why clients refuse it at the time `now`.
pub fn expiry_s(certificate: &CertificateDer<'_>, now: UnixTime) -> Result<u64, String> {
    let days = |from: UnixTime, to: UnixTime| to.as_secs().saturating_sub(from.as_secs()) as f64 / DAY_S;
    match verify(certificate, &[], &[], now) {
        Err(Error::CertExpired { not_after, .. }) => return Err(format!("expired {:.1} days ago", days(not_after, now))),
        Err(Error::CertNotValidYet { not_before, .. }) => {
            return Err(format!("is not valid before {:.1} days from now", days(now, not_before)));
        }
        Err(Error::RequiredEkuNotFoundContext(_)) => return Err("is not for servers: its extended key usage has no serverAuth".into()),
        _ => {}
    }
    match Identity::of_certificate(certificate) {
        Ok(Identity::Server(_)) | Err(_) => {}
        Ok(other) => return Err(format!("is that of {other}, not of a server")),
    }
    // At the end of time every certificate has expired, and the verifier says when.
    match verify(certificate, &[], &[], UnixTime::since_unix_epoch(Duration::MAX)) {
        Err(Error::CertExpired { not_after, .. }) => Ok(not_after.as_secs()),
        Err(error) => Err(format!("is not readable: {error}")),
        Ok(()) => Ok(u64::MAX),
    }
}

/// Verifies the certificate of a server as clients that trust these authorities do; they check its name too.
///
/// # Errors
/// The first reason to refuse it: its own validity and usage come before its issuer.
pub fn verify(
    certificate: &CertificateDer<'_>,
    intermediates: &[CertificateDer<'_>],
    authorities: &[TrustAnchor<'_>],
    time: UnixTime,
) -> Result<(), Error> {
    let algorithms = ring::default_provider().signature_verification_algorithms.all;
    let certificate = EndEntityCert::try_from(certificate)?;
    certificate.verify_for_usage(algorithms, authorities, intermediates, time, KeyUsage::server_auth(), None, None).map(drop)
}
