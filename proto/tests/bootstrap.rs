//! Goal: the committed code in `src/gen` is what the `.proto` files say. Method: compile them again with protox (no protoc) and compare the bytes.

use std::fs;
use std::path::{Path, PathBuf};

use prost::Message as _;

/// Folder of the sources and stem of what is made of them.
const PACKAGES: [(&str, &str); 2] = [("nesam/v1", "nesam.v1"), ("etcd", "etcdserverpb")];
/// The package that servers describe by reflection.
const DESCRIBED: &str = "nesam.v1";

fn manifest_dir() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn descriptor_file() -> String {
    format!("{DESCRIBED}.descriptor.bin")
}

/// Writes the generated files into `out`.
fn generate(out: &Path) {
    fs::create_dir_all(out).expect("the output folder can be made");
    for (folder, stem) in PACKAGES {
        let mut sources: Vec<PathBuf> = fs::read_dir(manifest_dir().join(folder))
            .expect("the folder of the .proto files is readable")
            .map(|entry| entry.expect("a readable entry").path())
            .filter(|path| path.extension().is_some_and(|extension| extension == "proto"))
            .collect();
        sources.sort();
        let descriptors = protox::compile(&sources, [manifest_dir()]).unwrap_or_else(|error| panic!("{error}"));
        if stem == DESCRIBED {
            fs::write(out.join(descriptor_file()), descriptors.encode_to_vec()).expect("the descriptor set can be written");
        }
        tonic_prost_build::configure()
            .bytes(".")
            .build_transport(false)
            .emit_rerun_if_changed(false)
            .out_dir(out)
            .compile_fds(descriptors)
            .expect("the files compile");
    }
}

#[test]
fn regress_generated_code_is_fresh() {
    let fresh = Path::new(env!("CARGO_TARGET_TMPDIR")).join("nesam-proto-gen");
    generate(&fresh);
    let generated = PACKAGES.map(|(_, stem)| format!("{stem}.rs")).into_iter().chain([descriptor_file()]);
    for name in generated {
        let expected = fs::read(fresh.join(&name)).expect("just written");
        let committed = fs::read(manifest_dir().join("src/gen").join(&name)).unwrap_or_default();
        assert!(
            committed == expected,
            "src/gen/{name} is stale; run `cargo test --release -p nesam-proto -- --ignored regenerate` and commit the result"
        );
    }
}

/// Not a test: writes `src/gen`.
#[test]
#[ignore = "writes src/gen"]
fn regenerate() {
    generate(&manifest_dir().join("src/gen"));
}
