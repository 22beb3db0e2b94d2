#!/usr/bin/env bash
# Builds the C++ client and tests it against a running server.
#
# Usage: run_tests.sh <nesam binary> [more arguments of `nesam serve`, for example --bundle DIR]
# Environment: NESAM_SANITIZE (for example address,undefined) builds with sanitizers, in a folder of its own; JOBS parallel compilers (default 2).
# Exit code: 0 passed, 1 failed, 2 wrong usage or missing packages.
set -euo pipefail

here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
root="$(cd "$here/../.." && pwd)"
build="$root/target/cpp-client${NESAM_SANITIZE:+-${NESAM_SANITIZE//,/-}}"

if [ $# -lt 1 ] || [ ! -x "$1" ]; then
  echo "usage: run_tests.sh <nesam binary> [arguments of nesam serve]" >&2
  exit 2
fi
binary="$(cd "$(dirname "$1")" && pwd)/$(basename "$1")"
shift

packages=(g++ cmake make openssl pkg-config protobuf-compiler protobuf-compiler-grpc libprotobuf-dev libgrpc++-dev)
tools_present() {
  local tool
  for tool in g++ cmake make openssl pkg-config protoc grpc_cpp_plugin; do
    command -v "$tool" > /dev/null || return 1
  done
  pkg-config --exists grpc++ protobuf
}
if ! tools_present; then
  if [ "$(id -u)" -eq 0 ] && command -v apt-get > /dev/null; then
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${packages[@]}" > /dev/null
  else
    echo "run_tests.sh: install these packages first: ${packages[*]}" >&2
    exit 2
  fi
fi

# The build yields to whatever else the machine does.
jobs="${JOBS:-2}"
cmake -S "$here" -B "$build" -DNESAM_SANITIZE="${NESAM_SANITIZE:-}" -DNESAM_BUILD_EXAMPLES=OFF -DCMAKE_INSTALL_LIBDIR=lib > /dev/null
nice -n 15 cmake --build "$build" -j "$jobs"
# The example is built as a stranger would: against the installed package.
cmake --install "$build" --prefix "$build/prefix" > /dev/null
cmake -S "$here/examples" -B "$build/examples" -DCMAKE_BUILD_TYPE=Release -DCMAKE_PREFIX_PATH="$build/prefix" > /dev/null
nice -n 15 cmake --build "$build/examples" -j "$jobs"

scratch="$(mktemp -d)"
server=""
stop_server() {
  [ -n "$server" ] || return 0
  kill -TERM "$server" 2> /dev/null || true
  local status=0
  wait "$server" || status=$?
  server=""
  return "$status"
}
clean_up() {
  stop_server || true
  rm -rf "$scratch"
}
trap clean_up EXIT

# Starts a server on a free port, which it says on its standard output; the file is there before the first look at it. Sets `address`.
start_server() {
  : > "$scratch/server.out"
  "$binary" serve --grpc 127.0.0.1:0 --no-http --no-zenoh "$@" > "$scratch/server.out" 2> "$scratch/server.log" &
  server=$!
  address=""
  for _ in $(seq 600); do
    address="$(sed -n 's/^grpc  *\([^ ]*\)$/\1/p' "$scratch/server.out")"
    [ -z "$address" ] || return 0
    kill -0 "$server" 2> /dev/null || break
    sleep 0.1
  done
  echo "run_tests.sh: the server did not start:" >&2
  cat "$scratch/server.out" "$scratch/server.log" >&2
  exit 1
}

# Stops the server; says its log and ends when a test has failed.
finish_server() {
  stop_server || {
    echo "run_tests.sh: the server did not stop cleanly" >&2
    failed=yes
  }
  [ "$failed" = yes ] || return 0
  echo "run_tests.sh: log of the server:" >&2
  tail -n 40 "$scratch/server.log" >&2
  exit 1
}

failed=no
"$build/known_states_test" || failed=yes
start_server "$@"
for test in client_test extras_test fallback_test predictions_test sessions_test streams_test; do
  timeout 300 "$build/$test" "$address" || failed=yes
done
# The example drives to its goal, and tells how it is called.
driven="$(timeout 120 "$build/examples/planner" "$address" 400)" || failed=yes
echo "example planner: ${driven##*$'\n'}"
[ "${driven##*$'\n'}" = arrived ] || failed=yes
"$build/examples/planner" --help | grep -q '^usage: ' || failed=yes
finish_server

# What the pages tell needs a store.
start_server --store "$scratch/store" "$@"
timeout 300 "$build/blocks_test" "$address" || failed=yes
finish_server

# The soil of a fleet is shared only where that is switched on.
printf '[fleet_soil]\nenabled = true\n' > "$scratch/fleet-soil.toml"
start_server --config "$scratch/fleet-soil.toml" "$@"
timeout 120 "$build/fleet_soil_test" "$address" || failed=yes
finish_server

# This test kills and restarts servers of its own.
mkdir "$scratch/durable"
timeout 300 "$build/durable_test" "$binary" "$scratch/durable" "$@" || {
  echo "run_tests.sh: log of the servers:" >&2
  tail -n 40 "$scratch/durable/durable.log" >&2
  exit 1
}

# Certificates of one authority for server and vehicle, and another authority.
(
  cd "$scratch"
  ec=(-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes)
  member() { # member FILE SUBJECT_ALTERNATIVE_NAME
    openssl req "${ec[@]}" -subj "/CN=$1" -keyout "$1.key" -out "$1.csr"
    printf 'subjectAltName=%s\n' "$2" > "$1.ext"
    openssl x509 -req -in "$1.csr" -CA ca.pem -CAkey ca.key -CAcreateserial -days 2 -extfile "$1.ext" -out "$1.pem"
  }
  openssl req -x509 "${ec[@]}" -days 2 -subj "/CN=authority" -keyout ca.key -out ca.pem
  openssl req -x509 "${ec[@]}" -days 2 -subj "/CN=other authority" -keyout other-ca.key -out other-ca.pem
  member server DNS:localhost
  member truck-7 URI:nesam:vehicle:truck-7
) 2> "$scratch/openssl.log" || {
  cat "$scratch/openssl.log" >&2
  exit 1
}
cp "$root/deploy/config/fleet.toml" "$scratch/fleet.toml"
printf '[tls]\ncertificate = "%s"\nkey = "%s"\nclient_ca = "%s"\nfleet = "%s"\n' "$scratch"/{server.pem,server.key,ca.pem,fleet.toml} > "$scratch/nesam.toml"
start_server --config "$scratch/nesam.toml" "$@"
timeout 120 "$build/tls_test" "$address" "$scratch" || failed=yes
finish_server
