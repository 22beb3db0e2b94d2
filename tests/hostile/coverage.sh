#!/usr/bin/env bash
# The compiler for what libFuzzer runs (RUSTC_WORKSPACE_WRAPPER): this workspace's crates get counters on every edge and compared value, checks of integer
# arithmetic, and little optimisation, which compiles sooner. Crates from elsewhere stay as in every other build, so that they are built once.
set -euo pipefail
case " $* " in
  *" --crate-name build_script_"* | *" --crate-type proc-macro "* | *" --crate-name ___ "*) exec "$@" ;;
esac
exec "$@" --cfg fuzzing -Copt-level=1 -Cdebug-assertions=yes -Coverflow-checks=yes -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
  -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table -Cllvm-args=-sanitizer-coverage-trace-compares
