#!/usr/bin/env bash
# Fuzzes the readers of files one after another with libFuzzer and the address sanitizer, from the corpora here.
#   tests/hostile/fuzz.sh [SECONDS_EACH [READER…]]     default: 60 s each, all readers
# What is new in coverage goes to target/hostile/corpus, what makes a reader fail to target/hostile/failures: copy that into tests/hostile/corpus.
# Needs a C++ compiler; installs cargo-fuzz. The compiler of the repository is used, with its unstable options let through.
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"
root="$(cd "$here/../.." && pwd)"
seconds="${1:-60}"
[ $# -eq 0 ] || shift
readers=("$@")
[ ${#readers[@]} -gt 0 ] || mapfile -t readers < <(ls "$here/corpus")

command -v cargo-fuzz > /dev/null || cargo install cargo-fuzz --locked
export RUSTC_BOOTSTRAP=1 CARGO_TARGET_DIR="$root/target/hostile"
failed=()
for reader in "${readers[@]}"; do
  found="$root/target/hostile/corpus/$reader"
  failures="$root/target/hostile/failures/$reader/"
  mkdir -p "$found" "$failures"
  printf '== %s\n' "$reader"
  NESAM_READER="$reader" cargo fuzz run --fuzz-dir "$here/fuzz" reader "$found" "$here/corpus/$reader" -- \
    -max_total_time="$seconds" -timeout=20 -rss_limit_mb=2048 -max_len=65536 -artifact_prefix="$failures" -print_final_stats=1 2>&1 |
    grep -E "^(#[0-9]+.*DONE|stat::|SUMMARY|==[0-9]+|thread)|panicked|Test unit" || true
  [ -z "$(ls -A "$failures")" ] || failed+=("$reader")
done
if [ ${#failed[@]} -gt 0 ]; then
  echo "failures: ${failed[*]} (see target/hostile/failures)" >&2
  exit 1
fi
