//! One reader under libFuzzer; the environment variable `NESAM_READER` says which.

use std::sync::OnceLock;

use libfuzzer_sys::fuzz_target;

static READER: OnceLock<fn(&[u8])> = OnceLock::new();

fn chosen() -> fn(&[u8]) {
    // libFuzzer's hook ends the process at every panic; one that a reader catches is none of its failures, and one that it does not ends the process all the same.
    drop(std::panic::take_hook());
    let name = std::env::var("NESAM_READER").unwrap_or_default();
    let found = nesam_hostile::READERS.iter().find(|(known, _)| *known == name);
    found.unwrap_or_else(|| panic!("NESAM_READER is `{name}`, it must name a reader of tests/hostile/src/lib.rs")).1
}

fuzz_target!(|bytes: &[u8]| READER.get_or_init(chosen)(bytes));
