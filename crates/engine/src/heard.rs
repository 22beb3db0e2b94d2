//! Executed commands on their way to a recording, in the order in which they were executed.

use std::collections::VecDeque;

use crate::handle::{Executed, Tap};
use crate::sync::{Mutex, MutexGuard};

/// Tells a tap what was executed. What was executed after a prediction that is still computed waits for it.
pub(crate) struct Heard {
    state: Mutex<State>,
}

struct State {
    tap: Option<Tap>,
    /// Place of the first entry of `waiting`.
    first: u64,
    /// By place: `None` = not done yet, `Some(None)` = nothing to tell.
    waiting: VecDeque<Option<Option<Executed>>>,
}

/// A place in the order of execution.
#[must_use]
pub(crate) struct HeardPlace(u64);

impl Heard {
    pub fn new(tap: Option<Tap>) -> Self {
        Self { state: Mutex::new(State { tap, first: 0, waiting: VecDeque::new() }) }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("a tap does not panic; this is a bug")
    }

    /// The next place in the order.
    pub fn reserve(&self) -> HeardPlace {
        let mut state = self.lock();
        state.waiting.push_back(None);
        HeardPlace(state.first + state.waiting.len() as u64 - 1)
    }

    /// Whether anybody listens.
    pub fn listens(&self) -> bool {
        self.lock().tap.is_some()
    }

    /// Tells what was executed there once everything before it was told; `None` = nothing to tell.
    pub fn tell(&self, place: HeardPlace, executed: Option<Executed>) {
        let mut state = self.lock();
        let State { tap, first, waiting } = &mut *state;
        let at = usize::try_from(place.0 - *first).expect("a place is told once; this is a bug");
        waiting[at] = Some(executed);
        while let Some(Some(_)) = waiting.front() {
            if let (Some(tap), Some(Some(Some(executed)))) = (tap.as_mut(), waiting.pop_front()) {
                tap(executed);
            }
            *first += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex as StdMutex};

    use super::*;
    use crate::command::Command;
    use crate::error::EngineError;

    /// Goal: a recording has commands in the order in which they were executed, whatever is done first, and nothing that is not to be told. Method: two
    /// predictions that end after what came behind them.
    #[test]
    fn analytic_what_is_done_early_is_told_in_its_place() {
        let told = Arc::new(StdMutex::new(Vec::new()));
        let sink = told.clone();
        let heard = Heard::new(Some(Box::new(move |executed: Executed| sink.lock().unwrap().push(executed.now_ns))));
        let at = |now_ns| Some(Executed { now_ns, command: Command::List, result: Err(EngineError::Stopped), queued_ns: 0, busy_ns: 0 });
        let places: Vec<HeardPlace> = (0..6).map(|_| heard.reserve()).collect();
        let mut places = places.into_iter().map(Some).collect::<Vec<_>>();
        let mut tell = |i: usize| heard.tell(places[i].take().unwrap(), at(i as u64));
        tell(1);
        tell(3);
        assert!(told.lock().unwrap().is_empty());
        tell(0);
        assert_eq!(*told.lock().unwrap(), [0, 1]);
        tell(2);
        assert_eq!(*told.lock().unwrap(), [0, 1, 2, 3]);
        tell(5);
        heard.tell(places[4].take().unwrap(), None);
        assert_eq!(*told.lock().unwrap(), [0, 1, 2, 3, 5]);
        let next = heard.reserve();
        heard.tell(next, at(6));
        assert_eq!(*told.lock().unwrap(), [0, 1, 2, 3, 5, 6]);
    }
}
