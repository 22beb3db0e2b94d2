//! Ctrl-C while a command works.

use std::sync::atomic::{AtomicBool, Ordering};

use crate::output::note;

/// Ctrl-C was noted.
static NOTED: AtomicBool = AtomicBool::new(false);

/// Notes the first Ctrl-C, for work that comes to an end by itself then ([`is_noted`]), and says what happens; the second one ends the program with code 1.
pub fn note_ctrl_c(first: &'static str, second: &'static str) {
    std::thread::spawn(move || {
        let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_io().build() else { return };
        runtime.block_on(async {
            while tokio::signal::ctrl_c().await.is_ok() {
                if NOTED.swap(true, Ordering::SeqCst) {
                    note!("\n{second}");
                    std::process::exit(1);
                }
                note!("\n{first}");
            }
        });
    });
}

/// Whether Ctrl-C was noted.
pub fn is_noted() -> bool {
    NOTED.load(Ordering::SeqCst)
}

/// On Ctrl-C, says what was left undone and exits with code 1. Files are written whole at the end, so none is left half-written.
pub fn exit_on_ctrl_c(left_undone: &'static str) {
    exit_on_ctrl_c_after(left_undone, || {});
}

/// The same after removing what is not finished; removing may wait for ever where nothing is left to interrupt.
pub fn exit_on_ctrl_c_after(left_undone: &'static str, remove: impl FnOnce() + Send + 'static) {
    std::thread::spawn(move || {
        let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_io().build() else { return };
        if runtime.block_on(tokio::signal::ctrl_c()).is_ok() {
            remove();
            note!("\ninterrupted: {left_undone}");
            std::process::exit(1);
        }
    });
}
