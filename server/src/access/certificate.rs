//! The server's own certificates: that of its listeners, and that which it shows etcd. One that nobody would accept is not put in force: it would lock everybody out.

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
    let expires_s = expiry_for(certificate, now, KeyUsage::server_auth(), "servers: its extended key usage has no serverAuth")?;
    match Identity::of_certificate(certificate) {
        Ok(Identity::Server(_)) | Err(_) => Ok(expires_s),
        Ok(other) => Err(format!("is that of {other}, not of a server")),
    }
}

/// When a certificate that is shown to servers expires, s since 1970.
///
/// # Errors
/// Why servers refuse it at the time `now`.
pub fn client_expiry_s(certificate: &CertificateDer<'_>, now: UnixTime) -> Result<u64, String> {
    expiry_for(certificate, now, KeyUsage::client_auth(), "clients: its extended key usage has no clientAuth")
}

/// When a certificate expires, s since 1970; an error where it does not hold now, or is not for this usage.
fn expiry_for(certificate: &CertificateDer<'_>, now: UnixTime, usage: KeyUsage, whose: &str) -> Result<u64, String> {
    let days = |from: UnixTime, to: UnixTime| to.as_secs().saturating_sub(from.as_secs()) as f64 / DAY_S;
    match verify_for(usage, certificate, &[], &[], now) {
        Err(Error::CertExpired { not_after, .. }) => return Err(format!("expired {:.1} days ago", days(not_after, now))),
        Err(Error::CertNotValidYet { not_before, .. }) => {
            return Err(format!("is not valid before {:.1} days from now", days(now, not_before)));
        }
        Err(Error::RequiredEkuNotFoundContext(_)) => return Err(format!("is not for {whose}")),
        _ => {}
    }
    // At the end of time every certificate has expired, and the verifier says when.
    match verify_for(usage, certificate, &[], &[], UnixTime::since_unix_epoch(Duration::MAX)) {
        Err(Error::CertExpired { not_after, .. }) => Ok(not_after.as_secs()),
        Err(error) => Err(format!("is not readable: {error}")),
        Ok(()) => Ok(u64::MAX),
    }
}

/// The common name of a certificate, by which Zenoh knows whose it is; `None` = it has none, or one of more than 127 bytes.
pub fn common_name(certificate: &CertificateDer<'_>) -> Option<String> {
    // An object identifier, 2.5.4.3; behind it a text: tag, length, bytes.
    const COMMON_NAME: [u8; 5] = [0x06, 0x03, 0x55, 0x04, 0x03];
    let certificate = EndEntityCert::try_from(certificate).ok()?;
    let subject = certificate.subject();
    let at = subject.windows(COMMON_NAME.len()).position(|bytes| bytes == COMMON_NAME)? + COMMON_NAME.len();
    let length = usize::from(*subject.get(at + 1)?);
    String::from_utf8(subject.get(at + 2..at + 2 + length)?.to_vec()).ok()
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
    verify_for(KeyUsage::server_auth(), certificate, intermediates, authorities, time)
}

fn verify_for(
    usage: KeyUsage,
    certificate: &CertificateDer<'_>,
    intermediates: &[CertificateDer<'_>],
    authorities: &[TrustAnchor<'_>],
    time: UnixTime,
) -> Result<(), Error> {
    let algorithms = ring::default_provider().signature_verification_algorithms.all;
    let certificate = EndEntityCert::try_from(certificate)?;
    certificate.verify_for_usage(algorithms, authorities, intermediates, time, usage, None, None).map(drop)
}
