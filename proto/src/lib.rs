//! Protobuf and gRPC types of `nesam.v1`, and those of etcd that the store of a fleet speaks.
//!
//! The sources are `nesam/v1/*.proto` and `etcd/*.proto` beside this crate; units, frames and array shapes are stated there. `src/gen` is generated and committed, so that
//! building needs no protobuf compiler. `cargo test --release -p nesam-proto` fails when it is stale;
//! `cargo test --release -p nesam-proto -- --ignored regenerate` makes it again.

pub mod packed;
pub mod pieces;

pub use prost::Message;

/// Largest HTTP/2 frame that both sides take, bytes: a reply of two megabytes is then eight frames and not 128, each with a call of the system on either side.
pub const FRAME_BYTES_MAX: u32 = 256 << 10;
/// What may be on its way on one stream before the other side has taken it, bytes.
pub const STREAM_WINDOW_BYTES: u32 = 4 << 20;
/// The same of a connection.
pub const CONNECTION_WINDOW_BYTES: u32 = 8 << 20;

/// Version 1 of the interface.
#[allow(missing_docs, clippy::all, unused_qualifications)]
pub mod v1 {
    include!("gen/nesam.v1.rs");

    impl PredictReply {
        /// Number of the field `states`.
        pub const STATES: u32 = 5;
    }

    impl PredictRequest {
        /// Number of the field `controls`.
        pub const CONTROLS: u32 = 6;
    }

    /// Encoded `FileDescriptorSet` of all files of the package, for server reflection.
    pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!("gen/nesam.v1.descriptor.bin");
}

/// The part of etcd's v3 interface that is used; a client only.
#[allow(missing_docs, clippy::all, unused_qualifications)]
pub mod etcd {
    include!("gen/etcdserverpb.rs");
}
