//! Progress of long work: a bar on a terminal, plain lines otherwise.

use std::io::IsTerminal;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use crate::output::note;

/// Seconds between plain lines.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// Progress of one task with a known number of parts.
pub struct Progress {
    label: String,
    total: AtomicUsize,
    bar: Option<ProgressBar>,
    started: Instant,
    last_line: Mutex<Instant>,
}

impl Progress {
    /// Starts a task of `total` parts.
    pub fn start(label: &str, total: usize) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(total as u64);
            if let Ok(style) = ProgressStyle::with_template("{msg:24} {bar:32} {pos}/{len} {elapsed} (about {eta} left)") {
                bar.set_style(style);
            }
            bar.set_message(label.to_string());
            bar
        });
        let now = Instant::now();
        Self { label: label.into(), total: AtomicUsize::new(total), bar, started: now, last_line: Mutex::new(now) }
    }

    /// Says that there are `total` parts, as far as is known by now.
    pub fn set_total(&self, total: usize) {
        self.total.store(total, Ordering::Relaxed);
        if let Some(bar) = &self.bar {
            bar.set_length(total as u64);
        }
    }

    /// Says that `done` parts are finished.
    pub fn set(&self, done: usize) {
        if let Some(bar) = &self.bar {
            bar.set_position(done as u64);
            return;
        }
        let Ok(mut last) = self.last_line.lock() else { return };
        if last.elapsed() >= LINE_EVERY {
            *last = Instant::now();
            note!("{}: {done}/{} after {:.0} s", self.label, self.total(), self.started.elapsed().as_secs_f64());
        }
    }

    fn total(&self) -> usize {
        self.total.load(Ordering::Relaxed)
    }

    /// Says that `done` parts are finished, with a remark.
    pub fn set_with(&self, done: usize, remark: &str) {
        if let Some(bar) = &self.bar {
            bar.set_message(format!("{}: {remark}", self.label));
        }
        self.set(done);
    }

    /// Ends the task with a line that says how long it took.
    pub fn finish(self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
        note!("{}: {} in {:.1} s", self.label, self.total(), self.started.elapsed().as_secs_f64());
    }
}
