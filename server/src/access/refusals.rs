//! What was refused for want of a right, counted; the log says who and what.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Why somebody was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The handshake of TLS failed, or took too long.
    Handshake,
    /// The certificate or the proxy names nobody of the fleet.
    Identity,
    /// The fleet file does not give the right.
    Right,
}

/// Refusals of one server by their reason. Clones share the counts.
#[derive(Clone, Debug, Default)]
pub struct Refusals(Arc<[AtomicU64; 3]>);

impl Refusals {
    /// Counts one.
    pub fn count(&self, refusal: Refusal) {
        self.0[refusal as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// How many there were of each reason.
    pub fn counts(&self) -> [(&'static str, u64); 3] {
        let of = |label, refusal: Refusal| (label, self.0[refusal as usize].load(Ordering::Relaxed));
        [of("handshake", Refusal::Handshake), of("identity", Refusal::Identity), of("right", Refusal::Right)]
    }
}
