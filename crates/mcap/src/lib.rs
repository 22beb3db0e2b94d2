//! MCAP files (version 0 of the format, mcap.dev/spec): written without compression, read with chunks of zstd and lz4 too.
//!
//! MCAP is a container for messages of any kind with their schemas; viewers and tools of many makers read it. [`Writer`] writes chunks with their
//! checksums and, at the end, the index that viewers jump by. A file that was not ended, because its program was killed, has whole chunks only,
//! and [`Reader`] gives their records; it reads from the front, needs no index and checks every chunk before it gives anything of it.
//!
//! Compression, attachments and jumping are left out: arrays of floats hardly shrink, and a replay reads everything in order.
#![forbid(unsafe_code)]

mod reader;
mod record;
mod writer;

pub use reader::{ReadError, Reader};
pub use record::{MAGIC, Record};
pub use writer::Writer;
