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

/// Only these packages depend on crates whose names begin so, and at least one does.
fn only(who_may: &[&str], family: &str) {
    let of_family = |name: &String| name == family || name.starts_with(&format!("{family}-"));
    let who: Vec<String> = direct().into_iter().filter(|(_, d)| d.iter().any(of_family)).map(|(package, _)| package).collect();
    assert!(!who.is_empty(), "nobody depends on `{family}`: has it another name now?");
    for package in &who {
        assert!(who_may.contains(&package.as_str()), "`{package}` depends on `{family}`; only {who_may:?} may");
    }
}

#[test]
fn property_physics_has_no_io_tensors_or_async() {
    let reached = reached("nesam-physics");
    for forbidden in ["serde", "tokio", "candle-core", "tonic", "zenoh", "rayon", "png", "parquet"] {
        assert!(!reached.contains(forbidden), "physics reaches `{forbidden}`");
    }
    for_each_source("crates/physics/src", |path, text| {
        for forbidden in ["fs", "io", "net", "time", "thread", "env", "process"] {
            assert!(!uses_std(text, forbidden), "{} uses std::{forbidden}", path.display());
        }
        assert!(!text.contains("println!"), "{} prints", path.display());
    });
}

/// The table of folders in ARCHITECTURE.md: what the crate in each may import, by folder; `None` = anything.
fn arrows() -> BTreeMap<String, Option<Vec<String>>> {
    let text = std::fs::read_to_string(repository().join("ARCHITECTURE.md")).expect("ARCHITECTURE.md");
    let table = text.lines().skip_while(|line| !line.starts_with("| folder |")).skip(2).take_while(|line| line.starts_with('|'));
    let mut arrows = BTreeMap::new();
    for line in table {
        let cells: Vec<&str> = line.trim_matches('|').split(" | ").map(str::trim).collect();
        let [folders, _, imports] = cells[..] else { panic!("not a row of three: {line}") };
        let imports = match imports {
            "anything" => None,
            "nothing of ours" => Some(Vec::new()),
            list => Some(list.split(", ").map(str::to_string).collect()),
        };
        for folder in folders.split(", ").map(|folder| folder.trim_matches('`')) {
            arrows.insert(folder.replace("{rust,python,cpp}", "rust"), imports.clone());
        }
    }
    arrows
}

/// Folder of every workspace package, below the root.
fn folders() -> BTreeMap<String, String> {
    let metadata = MetadataCommand::new().manifest_path(repository().join("Cargo.toml")).no_deps().exec().expect("cargo metadata runs");
    let root = repository().canonicalize().expect("the repository");
    let folder = |manifest: &Path| {
        let folder = manifest.parent().expect("a folder").canonicalize().expect("a folder");
        folder.strip_prefix(&root).expect("below the root").display().to_string()
    };
    metadata.packages.iter().map(|p| (p.name.to_string(), folder(p.manifest_path.as_std_path()))).collect()
}

/// The crates that a row names and all that their rows name, by the last part of their folders.
fn may_reach(arrows: &BTreeMap<String, Option<Vec<String>>>, named: &[String]) -> BTreeSet<String> {
    let row_of = |name: &str| arrows.iter().find(|(folder, _)| folder.rsplit('/').next() == Some(name));
    let mut reached: BTreeSet<String> = named.iter().map(|name| if name == "client" { "rust".into() } else { name.clone() }).collect();
    let mut open: Vec<String> = reached.iter().cloned().collect();
    while let Some(name) = open.pop() {
        let (_, imports) = row_of(&name).unwrap_or_else(|| panic!("a row names `{name}`, which has no row"));
        open.extend(imports.iter().flatten().filter(|import| reached.insert((*import).clone())).cloned());
    }
    reached
}

/// Goal: no crate imports what ARCHITECTURE.md does not let it. Method: each direct dependency of ours must be named in its row, or in a row of one that is.
#[test]
fn property_crates_import_what_the_table_of_architecture_says() {
    let (arrows, folder_of) = (arrows(), folders());
    for (package, dependencies) in direct() {
        let folder = &folder_of[&package];
        let Some(Some(named)) = arrows.get(folder) else {
            let below = |allowed: &str| folder == allowed || folder.starts_with(&format!("{allowed}/"));
            assert!(arrows.iter().any(|(row, imports)| imports.is_none() && below(row)), "`{folder}` has no row");
            continue;
        };
        let reached = may_reach(&arrows, named);
        for dependency in dependencies.iter().filter_map(|name| folder_of.get(name)) {
            let name = dependency.rsplit('/').next().unwrap_or_default();
            assert!(reached.contains(name), "`{folder}` imports `{dependency}`; the table of ARCHITECTURE.md lets it import {named:?}");
        }
    }
}

#[test]
fn property_candle_stays_in_model_and_learning() {
    only(&["nesam-model", "nesam-learning"], "candle");
}

/// Crates that know no network, nor does what they may import.
fn without_wire() -> Vec<String> {
    const EDGE: [&str; 3] = ["proto", "server", "rust"];
    let arrows = arrows();
    let knows_none = |folder: &str| {
        let is_edge = EDGE.contains(&folder.rsplit('/').next().unwrap_or_default());
        let named = arrows.get(folder).and_then(Option::as_ref).filter(|_| !is_edge);
        named.is_some_and(|named| EDGE.iter().all(|edge| !may_reach(&arrows, named).contains(*edge)))
    };
    folders().into_iter().filter(|(_, folder)| knows_none(folder)).map(|(package, _)| package).collect()
}

#[test]
fn property_the_wire_stays_at_the_edge() {
    for family in ["tonic", "prost", "zenoh"] {
        only(&["nesam-proto", "nesam-server", "nesam-client"], family);
    }
    let without_wire = without_wire();
    assert!(["nesam-physics", "nesam-engine", "nesam-discovery"].iter().all(|name| without_wire.iter().any(|other| other == name)));
    for crate_name in &without_wire {
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
        for forbidden in ["Instant::now", "SystemTime"] {
            assert!(!text.contains(forbidden), "{} uses {forbidden}", path.display());
        }
        assert!(!uses_std(text, "net"), "{} uses std::net", path.display());
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
    let mut found = 0;
    for root in ["crates", "server", "clients/rust", "tests", "benches"] {
        for_each_source(root, |path, text| {
            let lint = ["unsafe", "_code"].concat();
            let attribute = |line: &&str| line.contains(&lint) && line.trim_start().starts_with('#') && !line.contains("forbid(");
            if text.lines().any(|line| attribute(&line)) {
                assert!(path.ends_with("crates/model/src/fused/vector.rs"), "{} allows unsafe code", path.display());
                found += 1;
            }
        });
    }
    assert_eq!(found, 1, "the module with unsafe code has another name now");
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

/// Whether a source names a module of the standard library, also as one of several in braces.
fn uses_std(text: &str, module: &str) -> bool {
    let named = |list: &str| list.split([',', '{', '}', ' ', '\n']).any(|part| part == module || part.starts_with(&format!("{module}::")));
    text.contains(&format!("std::{module}")) || text.split("std::{").skip(1).any(|rest| named(rest.split("};").next().unwrap_or_default()))
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
