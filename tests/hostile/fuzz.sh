#!/usr/bin/env bash
# Fuzzes every reader of files, texts and messages with libFuzzer, from the corpora here, as many at a time as there are processors.
#   tests/hostile/fuzz.sh [--sanitizer] [SECONDS_EACH [READER…]]     default: 60 s each, all readers
# By default only this workspace's crates are built for it, with counters on their edges and checks of integer arithmetic (coverage.sh): minutes, part of tests/run.
# With --sanitizer everything is, by cargo-fuzz with the address sanitizer, which takes all dependencies anew; it installs cargo-fuzz.
# What is new in coverage goes to target/hostile/corpus, what makes a reader fail to target/hostile/failures: copy that into tests/hostile/corpus.
# Needs a C++ compiler. The compiler of the repository is used; the sanitizer needs its unstable options let through.
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"
root="$(cd "$here/../.." && pwd)"
cd "$root"
sanitizer=
if [ "${1:-}" = "--sanitizer" ]; then
  sanitizer=1
  shift
fi
seconds="${1:-60}"
[ $# -eq 0 ] || shift
readers=("$@")
[ ${#readers[@]} -gt 0 ] || mapfile -t readers < <(ls "$here/corpus")
kept="$root/target/hostile"
mkdir -p "$kept"

if [ -n "$sanitizer" ]; then
  command -v cargo-fuzz > /dev/null || cargo install cargo-fuzz --locked
  RUSTC_BOOTSTRAP=1 CARGO_TARGET_DIR="$kept/sanitizer" cargo fuzz build --fuzz-dir "$here/fuzz" reader
  built=$(ls -t "$kept"/sanitizer/*/release/reader | head -1)
else
  RUSTC_WORKSPACE_WRAPPER="$here/coverage.sh" cargo build --release --workspace --test counted_reader --locked
  built=$(ls -t target/release/deps/counted_reader-* | grep -v '\.d$' | head -1)
fi
# A build does not take away what runs.
cp "$built" "$kept/reader"

# Of a reader: a line that tells inputs, coverage at first and in the end, and how it ended.
fuzz() {
  local reader=$1 failures="$kept/failures/$1/" log="$kept/$1.log" outcome=holds
  # The database of a store takes 4 GiB for a page whose damaged number says so, before it refuses it.
  local memory_mb=2048; [ "$reader" != store ] || memory_mb=6144
  mkdir -p "$kept/corpus/$reader" "$failures"
  NESAM_READER="$reader" "$kept/reader" "$kept/corpus/$reader" "$here/corpus/$reader" \
    -max_total_time="$seconds" -timeout=20 -rss_limit_mb="$memory_mb" -max_len=65536 -artifact_prefix="$failures" -print_final_stats=1 > "$log" 2>&1 || outcome=FAILS
  printf '%-20s %9s inputs, edges %5s -> %-5s %s\n' "$reader" "$(sed -n 's/^stat::number_of_executed_units: *//p' "$log")" \
    "$(grep -oE 'cov: [0-9]+' "$log" | head -1 | cut -c6-)" "$(grep -oE 'cov: [0-9]+' "$log" | tail -1 | cut -c6-)" "$outcome"
  [ $outcome = holds ] || { grep -E '^(SUMMARY|==[0-9]+|thread)|panicked|Test unit' "$log"; return 1; }
}
export -f fuzz
export kept here seconds
printf '%s\n' "${readers[@]}" | xargs -P "$(nproc)" -I{} bash -c 'set -euo pipefail; fuzz {}' || { echo "some fail: see $kept/failures" >&2; exit 1; }
