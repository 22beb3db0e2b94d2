#!/usr/bin/env bash
# Runs the unsafe module (crates/model/src/fused/vector.rs and x86.rs) under miri, which sees each access to memory: out of bounds, misaligned, uninitialised, aliased.
#   tests/hostile/miri.sh        some ten minutes on two cores, most of it to compile
# Miri knows the arithmetic of AVX2 and, of AVX-512, what reads and writes memory; `vmaxps` and some others of AVX-512, bf16 and tiles are beyond it.
# Needs rustup and its nightly toolchain with miri, which it installs; exit 2 where they cannot be had.
set -euo pipefail
cd "$(dirname "$0")/../.."
rustup toolchain install nightly --profile minimal --component miri,rust-src > /dev/null 2>&1 || true
cargo +nightly miri --version || { echo "no miri here"; exit 2; }
under_miri() { cargo +nightly miri test --locked --target-dir "target/miri-$1" -p nesam-model --lib "$2"; }

export MIRIFLAGS="-Zmiri-disable-isolation"
echo "== all of it, on the instructions of the build"
under_miri build fused::vector
echo "== what touches memory, in AVX-512"
RUSTFLAGS="-C target-cpu=x86-64-v3 -C target-feature=+avx512f,+avx512dq,+avx512vl,+avx512bw,+avx512bf16" under_miri avx512 property_memory
