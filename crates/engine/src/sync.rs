//! Locks, channels and threads: of the standard library, or of shuttle where the schedules of threads are tried. Who works beside
//! the engine takes them from here too.

#[cfg(not(feature = "shuttle"))]
pub use std::{
    sync::{Condvar, Mutex, MutexGuard, mpsc},
    thread,
};

#[cfg(feature = "shuttle")]
pub use shuttle::{
    sync::{Condvar, Mutex, MutexGuard, mpsc},
    thread,
};
