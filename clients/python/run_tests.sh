#!/bin/sh
# Tests the Python client against a real server: run_tests.sh path/to/nesam [pytest arguments]
# Makes a virtual environment in target/python-client, installs the client there (which generates the stubs) and runs pytest.
set -eu
if [ $# -lt 1 ] || [ ! -x "$1" ]; then
    echo "usage: $0 path/to/nesam [pytest arguments]" >&2
    exit 2
fi
server=$(cd "$(dirname "$1")" && pwd)/$(basename "$1")
shift
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../.." && pwd)
venv=$root/target/python-client
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --upgrade "$here[test]"
# The tests run from their own folder, so that the installed package is tested and not the source folder.
cd "$here/tests"
exec "$venv/bin/python" -m pytest -q -p no:cacheprovider -c "$here/pyproject.toml" "$here/tests" --server "$server" "$@"
