//! How far the work of a stage is whose parts come up as it goes: what is chosen decides what it is held against.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use crate::diagnose::OnProgress;

/// Counts the parts of a stage that are done and those known so far. By default nobody is told.
#[derive(Clone, Default)]
pub struct Work<'a> {
    told: Option<(&'static str, OnProgress<'a>)>,
    /// Done and known.
    parts: Arc<Mutex<[usize; 2]>>,
}

impl<'a> Work<'a> {
    /// Begins a stage, of which one part is known: its end.
    pub(crate) fn begin(stage: &'static str, progress: OnProgress<'a>) -> Self {
        progress(stage, 0, 1);
        Self { told: Some((stage, progress)), parts: Arc::new(Mutex::new([0, 1])) }
    }

    /// So many more parts came up.
    pub(crate) fn add(&self, more: usize) {
        self.count([0, more]);
    }

    /// A part is done.
    pub(crate) fn done(&self) {
        self.count([1, 0]);
    }

    fn count(&self, more: [usize; 2]) {
        let Some((stage, progress)) = self.told else { return };
        // Told in the order of the counts.
        let mut parts = self.parts.lock().unwrap_or_else(PoisonError::into_inner);
        *parts = core::array::from_fn(|i| parts[i] + more[i]);
        progress(stage, parts[0], parts[1]);
    }
}

impl fmt::Debug for Work<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Work").field("stage", &self.told.map(|(stage, _)| stage)).field("parts", &self.parts).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: what is told never goes back and is never more than all. Method: parts that come up as others are done, on clones, and one of whom nobody is told.
    #[test]
    fn analytic_parts_that_come_up_are_counted_once() {
        let told = Mutex::new(Vec::new());
        let progress = |stage: &str, done: usize, total: usize| told.lock().unwrap().push((stage.to_string(), done, total));
        let work = Work::begin("hypotheses", &progress);
        work.add(2);
        work.clone().done();
        work.add(1);
        work.done();
        Work::default().add(7);
        let told: Vec<(usize, usize)> = told.lock().unwrap().iter().map(|(_, done, total)| (*done, *total)).collect();
        assert_eq!(told, [(0, 1), (0, 3), (1, 3), (1, 4), (2, 4)]);
    }
}
