//! The same for `fuzz.sh`: as a test its dependencies have the features that those of all tests have, and need not be built again.
#![no_main]

#[path = "../fuzz_targets/one_reader.rs"]
mod one_reader;
