//! Signals that end a server, and one that must not.

use tokio::signal::unix::{SignalKind, signal};

/// Resolves on SIGINT (ctrl-c), SIGTERM and SIGHUP, which a terminal sends when it is closed. SIGHUP goes on being ignored where `nohup` asked for that.
pub async fn termination() {
    let hangup = async {
        match is_ignored(SignalKind::hangup()) {
            true => std::future::pending().await,
            false => received(SignalKind::hangup(), 1).await,
        }
    };
    tokio::select! {
        () = received(SignalKind::interrupt(), 1) => {}
        () = received(SignalKind::terminate(), 1) => {}
        () = hangup => {}
    }
}

/// Resolves on the second ctrl-c: who asks again does not want to wait. Other signals may come twice by themselves, as SIGHUP does from the shell and the system.
pub async fn second_interrupt() {
    received(SignalKind::interrupt(), 2).await;
}

/// Makes a write beyond the limit on the size of files (`ulimit -f`) an error of that write, as on a full disk, for the rest of the process: the signal would
/// end it. Needs a tokio runtime.
///
/// # Errors
/// When the system does not let the signal be caught.
pub fn outlive_file_limit() -> std::io::Result<()> {
    drop(signal(SignalKind::from_raw(libc::SIGXFSZ))?);
    Ok(())
}

/// Resolves when the process has got this signal so many times.
async fn received(kind: SignalKind, times: usize) {
    match signal(kind) {
        Ok(mut signals) => {
            for _ in 0..times {
                let _ = signals.recv().await;
            }
        }
        Err(_) => std::future::pending().await,
    }
}

/// Whether whoever started the process asked it to ignore this signal; not known outside Linux.
fn is_ignored(kind: SignalKind) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    ignored.is_some_and(|mask| (mask >> (kind.as_raw_value() - 1)) & 1 == 1)
}
