//! What the cross-crate tests share: where the repository and its committed sample of recorded drives lie.

use std::path::PathBuf;

/// Root of the repository.
pub fn repository() -> PathBuf {
    let tests = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    tests.parent().map(PathBuf::from).unwrap_or(tests)
}

/// The committed sample of Chrono drives, a data root.
pub fn sample_root() -> PathBuf {
    repository().join("tests/data/chrono_sample")
}

/// The bundle that is shipped for the vehicle of the sample.
pub fn shipped_bundle() -> PathBuf {
    repository().join("deploy/bundles/hmmwv-nominal")
}
