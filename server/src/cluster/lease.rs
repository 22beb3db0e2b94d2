//! The lease of this server: for how long nobody else can have its sessions.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::time::Instant;
use tonic::Status;

use super::etcd::Etcd;

/// Share of a lease after which it is extended; three failures in a row still leave time.
const EXTEND_AFTER: f64 = 0.25;
/// Share of a lease that one extension may take.
const PATIENCE: f64 = 0.25;
/// Pause after a failure.
const RETRY: Duration = Duration::from_millis(50);

#[derive(Clone, Copy, Debug)]
struct Term {
    id: i64,
    until: Instant,
}

/// The lease as this server knows it; clones share it.
///
/// etcd ends a lease at the earliest its length after it heard of us, and we reckon from before we spoke: by our own clock a lease is over here before
/// etcd gives its keys away. A process that was stopped and goes on sees at its first look that its time is over. (The clock is the machine's monotonic
/// one; it stands still while the whole machine sleeps. What such a server still answers is old, but it can write nothing: each write names its epoch.)
#[derive(Clone, Debug)]
pub(crate) struct Lease {
    term: Arc<Mutex<Option<Term>>>,
    /// Why it was not had or extended when that was last tried.
    trouble: Arc<Mutex<Option<String>>>,
    length: Duration,
}

impl Lease {
    /// None yet.
    pub fn new(length_s: f64) -> Self {
        Self { term: Arc::default(), trouble: Arc::default(), length: Duration::from_secs_f64(length_s) }
    }

    /// Number of the lease while it lasts.
    pub fn id(&self) -> Option<i64> {
        let term = (*self.term.lock().ok()?)?;
        (Instant::now() < term.until).then_some(term.id)
    }

    /// Number of the lease until it is known to have ended: what stands under it in etcd may be there as long.
    pub fn number(&self) -> Option<i64> {
        self.held().map(|term| term.id)
    }

    /// Why it was not had or extended when that was last tried; `None` = it was, or nobody knows yet.
    pub fn trouble(&self) -> Option<String> {
        self.trouble.lock().ok()?.clone()
    }

    /// Length of a lease.
    pub fn length(&self) -> Duration {
        self.length
    }

    /// Keeps a lease for ever. Whenever one has ended `lost` is awaited, and another one is asked for.
    pub async fn keep<F: Future<Output = ()>>(self, etcd: Etcd, lost: impl Fn() -> F) {
        loop {
            let extended = self.extended(&etcd).await;
            if let Ok(mut trouble) = self.trouble.lock() {
                *trouble = extended.as_ref().err().map(|status| status.message().into());
            }
            match extended {
                Ok(true) => tokio::time::sleep(self.length.mul_f64(EXTEND_AFTER)).await,
                Ok(false) => self.end(&lost, "etcd has ended it").await,
                Err(status) => {
                    tracing::debug!(reason = status.message(), "lease not extended; tried again");
                    if self.held().is_some_and(|term| Instant::now() >= term.until) {
                        self.end(&lost, status.message()).await;
                    }
                    tokio::time::sleep(RETRY).await;
                }
            }
        }
    }

    /// Ends the lease of a server that stops.
    pub async fn give_back(&self, etcd: &Etcd) {
        let term = self.term.lock().ok().and_then(|mut term| term.take());
        if let Some(term) = term
            && let Err(status) = etcd.revoke(term.id).await
        {
            tracing::warn!(reason = status.message(), "lease not given back; its sessions are free when it ends by itself");
        }
    }

    fn held(&self) -> Option<Term> {
        *self.term.lock().ok()?
    }

    /// Asks for a lease or for more of it; false = it has ended.
    async fn extended(&self, etcd: &Etcd) -> Result<bool, Status> {
        let asked = Instant::now();
        let (id, seconds) = match self.held() {
            None => etcd.grant(self.length.as_secs_f64().ceil() as i64).await?,
            Some(term) => (term.id, etcd.keep_alive(term.id, self.length.mul_f64(PATIENCE)).await?),
        };
        if seconds <= 0 {
            return Ok(false);
        }
        // Not longer than asked for, although etcd may give more.
        let until = asked + self.length.min(Duration::from_secs(seconds.unsigned_abs()));
        if let Ok(mut term) = self.term.lock() {
            *term = Some(Term { id, until });
        }
        Ok(true)
    }

    async fn end<F: Future<Output = ()>>(&self, lost: &impl Fn() -> F, reason: &str) {
        if let Ok(mut term) = self.term.lock() {
            *term = None;
        }
        tracing::error!(reason, "lease lost: the sessions of this server are free for others");
        lost().await;
    }
}
