//! What cargo-fuzz builds.
#![no_main]

mod one_reader;
