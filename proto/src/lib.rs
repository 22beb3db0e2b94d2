//! Protobuf and gRPC types of `nesam.v1`, and those of etcd that the store of a fleet speaks.
//!
//! The sources are `nesam/v1/*.proto` and `etcd/*.proto` beside this crate; units, frames and array shapes are stated there. `src/gen` is generated and committed, so that
//! building needs no protobuf compiler. `cargo test --release -p nesam-proto` fails when it is stale;
//! `cargo test --release -p nesam-proto -- --ignored regenerate` makes it again.

pub use prost::Message;

/// Version 1 of the interface.
#[allow(missing_docs, clippy::all, unused_qualifications)]
pub mod v1 {
    include!("gen/nesam.v1.rs");

    /// Encoded `FileDescriptorSet` of all files of the package, for server reflection.
    pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!("gen/nesam.v1.descriptor.bin");
}

/// The part of etcd's v3 interface that is used; a client only.
#[allow(missing_docs, clippy::all, unused_qualifications)]
pub mod etcd {
    include!("gen/etcdserverpb.rs");
}
