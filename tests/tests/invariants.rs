//! Goal: the arrows between crates stay those of ARCHITECTURE.md.
//! Method: `cargo metadata` for dependencies, a search through the sources for what must not appear.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use cargo_metadata::{DependencyKind, MetadataCommand};
use nesam_tests::repository;

/// Normal dependencies of every workspace package, direct ones.
fn direct() -> BTreeMap<String, BTreeSet<String>> {
    let metadata = MetadataCommand::new().manifest_path(repository().join("Cargo.toml")).no_deps().exec().expect("cargo metadata runs");
    metadata
        .packages
        .iter()
        .map(|p| {
            let normal = p.dependencies.iter().filter(|d| d.kind == DependencyKind::Normal).map(|d| d.name.clone()).collect();
            (p.name.to_string(), normal)
        })
        .collect()
}

/// Everything a package reaches through normal dependencies.
fn reached(package: &str) -> BTreeSet<String> {
    let metadata = MetadataCommand::new().manifest_path(repository().join("Cargo.toml")).exec().expect("cargo metadata runs");
    let resolve = metadata.resolve.expect("a resolved graph");
    let name =
        |id: &cargo_metadata::PackageId| metadata.packages.iter().find(|p| p.id == *id).map(|p| p.name.to_string()).unwrap_or_default();
    let root = metadata.packages.iter().find(|p| p.name.as_str() == package).expect("a workspace package").id.clone();
    let mut seen = BTreeSet::new();
    let mut open = vec![root];
    while let Some(id) = open.pop() {
        let node = resolve.nodes.iter().find(|n| n.id == id).expect("a node");
        for dependency in &node.deps {
            let normal = dependency.dep_kinds.iter().any(|k| k.kind == DependencyKind::Normal);
            if normal && seen.insert(name(&dependency.pkg)) {
                open.push(dependency.pkg.clone());
            }
        }
    }
    seen
}

fn only(who_may: &[&str], dependency: &str) {
    for (package, dependencies) in direct() {
        if dependencies.contains(dependency) {
            assert!(who_may.contains(&package.as_str()), "`{package}` depends on `{dependency}`; only {who_may:?} may");
        }
    }
}

#[test]
fn property_physics_has_no_io_tensors_or_async() {
    let reached = reached("nesam-physics");
    for forbidden in ["serde", "tokio", "candle-core", "tonic", "zenoh", "rayon", "png", "parquet"] {
        assert!(!reached.contains(forbidden), "physics reaches `{forbidden}`");
    }
    for_each_source("crates/physics/src", |path, text| {
        for forbidden in ["std::fs", "std::io", "std::net", "std::time", "std::thread", "println!"] {
            assert!(!text.contains(forbidden), "{} uses {forbidden}", path.display());
        }
    });
}

#[test]
fn property_candle_stays_in_model_and_learning() {
    only(&["nesam-model", "nesam-learning"], "candle-core");
}

#[test]
fn property_the_wire_stays_at_the_edge() {
    for dependency in ["tonic", "prost", "zenoh", "tonic-prost", "tonic-types", "prost-types"] {
        only(&["nesam-proto", "nesam-server", "nesam-client"], dependency);
    }
    for crate_name in ["nesam-engine", "nesam-model", "nesam-trajectories", "nesam-learning", "nesam-evaluation"] {
        let reached = reached(crate_name);
        for forbidden in ["tonic", "zenoh", "prost"] {
            assert!(!reached.contains(forbidden), "{crate_name} reaches `{forbidden}`");
        }
    }
}

#[test]
fn property_engine_has_no_network_and_no_wall_clock() {
    let reached = reached("nesam-engine");
    for forbidden in ["tokio", "hyper", "axum"] {
        assert!(!reached.contains(forbidden), "engine reaches `{forbidden}`");
    }
    for_each_source("crates/engine/src", |path, text| {
        for forbidden in ["Instant::now", "SystemTime", "std::net"] {
            assert!(!text.contains(forbidden), "{} uses {forbidden}", path.display());
        }
    });
}

/// The plant is a second opinion: whatever it shared with the model could be wrong in both.
#[test]
fn property_the_plant_shares_no_code_with_the_model() {
    let own: BTreeSet<String> = direct().into_keys().filter(|name| name != "nesam-plant").collect();
    let reached = reached("nesam-plant");
    let shared: Vec<&String> = reached.iter().filter(|name| own.contains(*name)).collect();
    assert!(shared.is_empty(), "the plant reaches {shared:?}");
    for_each_source("tests/plant", |path, text| {
        for forbidden in ["nesam_physics", "crates/physics", "include!"] {
            assert!(!text.contains(forbidden), "{} uses {forbidden}", path.display());
        }
    });
}

#[test]
fn property_nobody_imports_tests_benches_or_the_command_line() {
    for (package, dependencies) in direct() {
        for forbidden in ["nesam-tests", "nesam-benches", "nesam"] {
            assert!(!dependencies.contains(forbidden), "`{package}` depends on `{forbidden}`");
        }
    }
}

#[test]
fn property_terramechanics_is_written_once() {
    // The sinkage modulus enters a formula only inside `physics`.
    for root in ["crates", "server", "clients/rust"] {
        for_each_source(root, |path, text| {
            let ours = path.components().any(|c| c.as_os_str() == "src") && !path.starts_with(repository().join("crates/physics"));
            if ours {
                for formula in ["k_phi *", "* k_phi", "k_c /", ".k_phi +"] {
                    assert!(!text.contains(formula), "{} computes with the sinkage modulus: `{formula}`", path.display());
                }
            }
        });
    }
}

#[test]
fn property_unsafe_code_stands_in_one_module() {
    for root in ["crates", "server", "clients/rust", "tests", "benches"] {
        for_each_source(root, |path, text| {
            let allows = text.contains(&["allow(", "unsafe_code)"].concat());
            assert!(!allows || path.ends_with("crates/model/src/fused/vector.rs"), "{} allows unsafe code", path.display());
        });
    }
}

/// The macros of the standard library panic where the stream is full or closed: a server would cancel the call that logged, a command would lose its work.
#[test]
fn property_no_source_prints_with_macros_that_panic() {
    for root in ["crates", "server"] {
        for_each_source(root, |path, text| {
            let inside = path.strip_prefix(repository().join(root)).expect("a path below the root");
            let ours = inside.components().any(|c| c.as_os_str() == "src");
            // `println!`, `eprintln!` and those that end no line.
            for macro_name in ["println!(", "print!("] {
                assert!(!ours || !text.contains(macro_name), "{} uses {macro_name}; see crates/cli/src/output.rs", path.display());
            }
        });
    }
}

/// What `deny.toml` says why an advisory does not concern this program: the code it is about is not compiled.
#[test]
fn property_zenoh_is_built_without_compression() {
    let metadata = MetadataCommand::new().manifest_path(repository().join("Cargo.toml")).exec().expect("cargo metadata runs");
    let transport = metadata.packages.iter().find(|p| p.name.as_str() == "zenoh-transport").expect("Zenoh's transport is in the graph");
    assert!(transport.features.contains_key("transport_compression"), "the feature has another name now: see deny.toml");
    let resolve = metadata.resolve.expect("a resolved graph");
    let node = resolve.nodes.iter().find(|n| n.id == transport.id).expect("a node");
    assert!(node.features.iter().all(|feature| **feature != *"transport_compression"), "see deny.toml");
}

/// Calls `f` with every Rust source below a folder of the repository.
fn for_each_source(folder: &str, mut f: impl FnMut(&Path, &str)) {
    let mut open = vec![repository().join(folder)];
    let mut seen = 0;
    while let Some(dir) = open.pop() {
        for entry in std::fs::read_dir(&dir).expect("a readable folder").filter_map(Result::ok) {
            let path = entry.path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") {
                f(&path, &std::fs::read_to_string(&path).expect("readable source"));
                seen += 1;
            }
        }
    }
    assert!(seen > 0, "no source under {folder}");
}
