//! The log on standard error.

use std::io::IsTerminal;

use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::LevelFilter;

use crate::output::note;

/// Names under which something logs: those of this program, then those of crates that it is made of.
const TARGETS: [&str; 24] = [
    "nesam",
    "nesam_server",
    "h2",
    "hyper_util",
    "iana_time_zone",
    "jiff",
    "rustls",
    "tokenizers",
    "tonic",
    "tower",
    "tracing",
    "uhlc",
    "zenoh",
    "zenoh_codec",
    "zenoh_config",
    "zenoh_link_commons",
    "zenoh_link_tcp",
    "zenoh_link_tls",
    "zenoh_plugin_trait",
    "zenoh_runtime",
    "zenoh_shm",
    "zenoh_task",
    "zenoh_transport",
    "zenoh_util",
];

/// Structured logs on standard error; `RUST_LOG` changes what is shown, and a value that is not understood is told and changes nothing. A line that standard
/// error does not take is lost: the subscriber would print of its own failure there, and panic in the call that logged.
pub fn log_to_stderr(default: &str) {
    let usual = format!("{default},zenoh=warn");
    let asked = std::env::var("RUST_LOG").ok().filter(|text| !text.is_empty());
    let filter = asked.and_then(|text| match filter(&text) {
        Ok(filter) => Some(filter),
        Err(reason) => {
            note!("RUST_LOG={text}: {reason}; `{usual}` is logged");
            None
        }
    });
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter.unwrap_or_else(|| EnvFilter::new(&usual)))
        .log_internal_errors(false)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .try_init();
}

/// What a text asks to be logged, or why that cannot be meant.
fn filter(text: &str) -> Result<EnvFilter, String> {
    let filter = EnvFilter::try_new(text).map_err(|error| error.to_string())?;
    match text.split(',').map(str::trim).find(|part| silences(part)) {
        Some(word) => {
            Err(format!("`{word}` is neither a level (error, warn, info, debug, trace, off) nor a part of the program that logs"))
        }
        None => Ok(filter),
    }
}

/// Whether a part of a filter is a word that is neither a level nor the name of something that logs. `EnvFilter` takes it for a name, and nothing else is logged.
fn silences(part: &str) -> bool {
    let bare = !part.is_empty() && !part.contains(['=', '[', ']', '{', '}']);
    let name = part.split("::").next().unwrap_or(part);
    bare && part.parse::<LevelFilter>().is_err() && !TARGETS.contains(&name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn property_a_word_that_would_silence_the_log_is_told() {
        // Goal: `RUST_LOG=warning` does not lose the warnings. Method: words of other programs, alone and beside levels; what is right is let be.
        for wrong in ["warning", "critical", "information", "info,critical", "nesam=warn, verbose", "nesam_engin"] {
            let reason = filter(wrong).unwrap_err();
            assert!(reason.contains("is neither a level"), "{wrong}: {reason}");
        }
        let right =
            ["info", "Warn", "off", "3", "warn,nesam_server=debug", "nesam", "nesam::audit", "zenoh_transport", "info, warn", "other=info"];
        for text in [&right[..], &["[span{a}]=info", "nesam_server[span]"]].concat() {
            assert!(filter(text).is_ok(), "{text}");
        }
        assert!(filter("nesam=loud").is_err());
    }

    #[test]
    fn property_the_names_that_log_are_those_of_crates_that_do() {
        // Goal: no name is forgotten or left over. Method: the packages of Cargo.lock that need `tracing` or `log`; of others than ours, which are in the program
        // is not told there, so that only names left over are found.
        let lock = include_str!("../../../Cargo.lock");
        let logging: Vec<String> = lock
            .split("[[package]]")
            .filter(|package| {
                ["\"tracing\"", "\"log\"", "\"tracing-core\""].iter().any(|needed| package.contains(&format!("\n {needed},")))
            })
            .filter_map(|package| Some(package.split_once("name = \"")?.1.split('"').next()?.replace('-', "_")))
            .collect();
        assert!(logging.len() > 20, "{logging:?}");
        for ours in logging.iter().filter(|name| name.starts_with("nesam_")) {
            assert!(TARGETS.contains(&ours.as_str()), "{ours}");
        }
        for name in TARGETS.iter().filter(|name| **name != "nesam") {
            assert!(logging.iter().any(|other| other == name), "{name} logs nothing");
        }
    }
}
