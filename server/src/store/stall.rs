//! A store that neither takes a change nor says why: a disk that hangs.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;

use super::Keeper;
use crate::grpc::stopped;
use crate::web::{Feed, Raised};

/// Time between two looks.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// Time beyond `store.interval_s` after which a store hangs (chosen: a commit takes milliseconds, on a slow disk a second).
const LATE: Duration = Duration::from_secs(5);

/// Tells the log and the live page when the store hangs, once, and when it goes on, until the server stops.
pub(crate) async fn tell_stalls(keeper: Arc<Keeper>, interval: Duration, page: Feed, stopping: watch::Receiver<bool>) {
    let stop = stopped(stopping);
    tokio::pin!(stop);
    let mut stall = Stall { after: interval.saturating_add(LATE), said: false };
    loop {
        tokio::select! {
            () = tokio::time::sleep(LOOK_EVERY) => {}
            () = &mut stop => return,
        }
        match stall.look(keeper.oldest()) {
            Some(Told::Hangs(oldest)) => {
                let (oldest_s, waiting) = (oldest.as_secs_f64(), keeper.counts().waiting);
                tracing::error!(oldest_s, waiting, "the store hangs: what has changed since is received and not durable");
                page.alarm(Raised::by_store(Some(oldest_s)));
            }
            Some(Told::GoesOn) => {
                tracing::info!("the store goes on");
                page.alarm(Raised::by_store(None));
            }
            None => {}
        }
    }
}

/// Whether it was said that the store hangs.
struct Stall {
    after: Duration,
    said: bool,
}

/// What there is to tell.
#[derive(Debug, PartialEq)]
enum Told {
    Hangs(Duration),
    GoesOn,
}

impl Stall {
    /// Looks at the age of the oldest change that waits.
    fn look(&mut self, oldest: Option<Duration>) -> Option<Told> {
        let hangs = oldest.filter(|oldest| *oldest > self.after);
        let told = match (hangs, self.said) {
            (Some(oldest), false) => Some(Told::Hangs(oldest)),
            (None, true) => Some(Told::GoesOn),
            _ => None,
        };
        self.said = hangs.is_some();
        told
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regress_a_store_that_hangs_is_told_once() {
        let seconds = Duration::from_secs;
        let mut stall = Stall { after: seconds(6), said: false };
        let looks = [None, Some(1), Some(6), Some(7), Some(8), Some(2), None, Some(9)].map(|oldest| stall.look(oldest.map(seconds)));
        let hangs = |after| Some(Told::Hangs(seconds(after)));
        assert_eq!(looks, [None, None, None, hangs(7), None, Some(Told::GoesOn), None, hangs(9)]);
    }
}
