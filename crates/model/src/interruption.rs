//! What may happen to a rollout while it is computed.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, PoisonError};

use crate::rollout::is_raised;

/// What a rollout looks at before each of its steps. The default is that nothing happens to it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Interruption<'a> {
    /// Raised when nobody waits for the answer any more: it is given up within a step.
    pub abandoned: Option<&'a AtomicBool>,
    /// Closed while another one is more urgent: it waits within a step.
    pub gate: Option<&'a Gate>,
}

impl Interruption<'_> {
    /// Whether nobody waits for the answer any more.
    pub fn is_abandoned(&self) -> bool {
        is_raised(self.abandoned)
    }

    /// The same, once nothing is more urgent.
    pub fn ends(&self) -> bool {
        if let Some(gate) = self.gate {
            gate.pass();
        }
        self.is_abandoned()
    }
}

/// A gate that the threads of a rollout pass at each step of a block. Open it costs them a look; closed they wait there, and hold nothing that another rollout needs.
#[derive(Debug, Default)]
pub struct Gate {
    is_closed: AtomicBool,
    waiting: Mutex<()>,
    opened: Condvar,
}

impl Gate {
    /// From now on who comes waits.
    pub fn close(&self) {
        self.is_closed.store(true, Ordering::Relaxed);
    }

    /// Lets all go on.
    pub fn open(&self) {
        // Held, so that nobody who has looked and found it closed misses the call.
        let _waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        self.is_closed.store(false, Ordering::Relaxed);
        self.opened.notify_all();
    }

    /// Goes through, as soon as it is open.
    fn pass(&self) {
        if self.is_closed.load(Ordering::Relaxed) {
            let waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
            let _open =
                self.opened.wait_while(waiting, |()| self.is_closed.load(Ordering::Relaxed)).unwrap_or_else(PoisonError::into_inner);
        }
    }
}
