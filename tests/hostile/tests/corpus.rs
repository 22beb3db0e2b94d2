//! Goal: no file or text that comes from outside makes a reader panic or hang. Method: the corpus of each reader, then seeded mutations of it: bits, bytes,
//! numbers at the edge of their range, pieces left out, doubled and moved.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nesam_hostile::READERS;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Mutations of each reader.
const MUTATIONS: u64 = 1500;
/// Longest that one input may take, on a busy machine.
const PATIENCE: Duration = Duration::from_secs(20);

fn corpus(name: &str) -> Vec<(PathBuf, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(name);
    let mut files: Vec<_> = std::fs::read_dir(&folder)
        .unwrap_or_else(|error| panic!("{}: {error}", folder.display()))
        .map(|entry| entry.expect("readable").path())
        .map(|path| (path.clone(), std::fs::read(path).expect("readable")))
        .collect();
    files.sort();
    assert!(!files.is_empty(), "no corpus for {name}");
    files
}

/// Changes bytes in one to four places.
fn mutated(bytes: &[u8], rng: &mut ChaCha8Rng) -> Vec<u8> {
    const EDGES: [&[u8]; 8] = [b"0", b"-1", b"1e999", b"NaN", &[0; 8], &[0xff; 8], &[0xff, 0xff, 0xff, 0x7f], b"18446744073709551615"];
    let mut bytes = bytes.to_vec();
    for _ in 0..rng.random_range(1..5) {
        if bytes.is_empty() {
            return bytes;
        }
        let at = rng.random_range(0..bytes.len());
        let end = (at + rng.random_range(1..64)).min(bytes.len());
        match rng.random_range(0..7) {
            0 => bytes[at] ^= 1 << rng.random_range(0..8),
            1 => bytes[at] = rng.random(),
            2 => {
                let edge = EDGES[rng.random_range(0..EDGES.len())];
                let end = (at + edge.len()).min(bytes.len());
                bytes.splice(at..end, edge.iter().copied());
            }
            3 => drop(bytes.drain(at..end)),
            4 => {
                let piece = bytes[at..end].to_vec();
                let to = rng.random_range(0..=bytes.len());
                bytes.splice(to..to, piece);
            }
            5 => bytes.truncate(at),
            _ => {
                let other = rng.random_range(0..bytes.len());
                bytes.swap(at, other);
            }
        }
    }
    bytes
}

/// Reads; what makes a reader fail is kept, and the test says where.
fn read(name: &str, reader: fn(&[u8]), bytes: &[u8], what: &str) {
    let start = Instant::now();
    let outcome = std::panic::catch_unwind(|| reader(bytes));
    let took = start.elapsed();
    if outcome.is_err() || took > PATIENCE {
        let kept = std::env::temp_dir().join(format!("hostile-{name}-{}", what.replace(['/', ' '], "_")));
        std::fs::write(&kept, bytes).expect("a file can be written");
        panic!("{name}, {what}: panicked or took {took:?}; the input is in {}", kept.display());
    }
}

#[test]
fn property_no_bytes_make_a_reader_panic() {
    let threads: Vec<_> = READERS
        .into_iter()
        .map(|(name, reader)| {
            std::thread::spawn(move || {
                let files = corpus(name);
                for (path, bytes) in &files {
                    read(name, reader, bytes, &path.file_name().unwrap_or_default().to_string_lossy());
                }
                for seed in 0..MUTATIONS {
                    let mut rng = ChaCha8Rng::seed_from_u64(seed);
                    let (_, bytes) = &files[rng.random_range(0..files.len())];
                    read(name, reader, &mutated(bytes, &mut rng), &format!("seed {seed}"));
                }
            })
        })
        .collect();
    for thread in threads {
        thread.join().expect("no reader panics");
    }
}
