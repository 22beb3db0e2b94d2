//! Ctrl-C while a command works.

use crate::output::note;

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
