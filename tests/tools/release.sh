#!/usr/bin/env bash
# Makes a release of the commit that is checked out, into target/release-files: a tarball with the program, the shipped bundles, the deployment files, the licences
# of everything that is linked in and a list of it (SBOM, CycloneDX), and its SHA-256. The tarball runs where it is unpacked: bin/nesam finds deploy/bundles.
#   tests/tools/release.sh              builds (minutes) and packs
#   tests/tools/release.sh --no-build   packs target/release/nesam, to try this script out; not a release, and called so
# The same commit, Rust and C compiler give the same bytes wherever it is done: sources come from git and not from the working tree, paths of the machine are mapped away,
# all times are that of the commit, tar sorts.
# Needs git, cargo, a C compiler, Python 3.9 and GNU tar; installs cargo-cyclonedx into target/release-tools (four minutes on one core, once).
set -euo pipefail
export LC_ALL=C TZ=UTC
umask 022
cd "$(dirname "$0")/../.."
root=$PWD
die() { printf '%s\n' "$*" >&2; exit 1; }
case ${1:-} in
  "") build=yes ;;
  --no-build) build=no ;;
  *) die "usage: $0 [--no-build]" ;;
esac

SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}
export SOURCE_DATE_EPOCH
commit=$(git rev-parse --short=10 HEAD)
target=$(rustc -vV | sed -n 's/^host: //p')
version=$(sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' Cargo.toml)
# Only what is tagged so is a version; all else is a commit after some version.
git describe --tags --exact-match --match "v$version" HEAD > /dev/null 2>&1 || version=$version-g$commit
[ "$build" = yes ] || version=$version-not-a-release
name=nesam-$version-$target
out=$root/target/release-files
source=$out/source
stage=$out/$name
tool=$root/target/release-tools
rm -rf "$out"
mkdir -p "$source" "$stage/bin"

git archive HEAD | tar -x -C "$source"
[ -f "$source/LICENSE" ] || die "the commit has no LICENSE: whoever gets a program under Apache-2.0 has to get its text, too"
[ -z "$(git status --porcelain --untracked-files=no)" ] || printf 'note: what is not committed is not in the release\n' >&2

if [ "$build" = yes ]; then
  cargo_home=${CARGO_HOME:-$HOME/.cargo} made=$root/target/release-build
  # Given on the command line, flags are added to those of .cargo/config.toml; RUSTFLAGS would replace them. The last one that fits holds.
  flags=$(printf '"--remap-path-prefix=%s",' "$(rustc --print sysroot)=/rust" "$cargo_home=/cargo" "$made=/made" "$source=/nesam")
  export CFLAGS="${CFLAGS:-} -ffile-prefix-map=$cargo_home=/cargo -ffile-prefix-map=$made=/made"
  (cd "$source" && CARGO_INCREMENTAL=0 CARGO_TARGET_DIR=$made cargo build --release --locked --bin nesam --target "$target" \
    --config "target.$target.rustflags=[${flags%,}]")
  program=$made/$target/release/nesam
else
  program=$root/target/release/nesam
fi
strip -o "$stage/bin/nesam" "$program"
for path in "$root" "${CARGO_HOME:-$HOME/.cargo}" "$HOME/"; do
  if grep -qaF "$path" "$stage/bin/nesam"; then
    [ "$build" = no ] || die "the program has paths of this machine in it: $path"
    printf 'note: target/release/nesam has %s in it, as it was not built for a release\n' "$path" >&2
  fi
done

# Baselines are for research, and docker needs the sources.
(cd "$source" && cp -R --parents README.md CHANGELOG.md LICENSE deploy "$stage/")
rm -rf "$stage/deploy/baselines" "$stage/deploy/docker"
printf 'commit %s\n%s\n%s\n' "$(git rev-parse HEAD)" "$(rustc --version)" "$(cc --version | head -1)" > "$stage/BUILD"

# Licence texts of every package that is linked in, with those of the C code inside. A package that brings no text is listed with what it names.
(cd "$source" && cargo metadata --locked --format-version 1 --filter-platform "$target") > "$out/metadata.json"
python3 - "$out/metadata.json" "$stage/licences" <<'END'
import collections, json, pathlib, re, shutil, sys

metadata, folder = json.loads(pathlib.Path(sys.argv[1]).read_text()), pathlib.Path(sys.argv[2])
packages, nodes = ({p["id"]: p for p in metadata["packages"]}, {n["id"]: n for n in metadata["resolve"]["nodes"]})
linked, next_ones = set(), collections.deque(p["id"] for p in packages.values() if p["name"] == "nesam")
while next_ones:
    one = next_ones.popleft()
    if one not in linked:
        linked.add(one)
        next_ones.extend(d["pkg"] for d in nodes[one]["deps"] if any(kind["kind"] is None for kind in d["dep_kinds"]))
# Texts are called so, alone or with an ending; sources called license.rs are not.
called = re.compile(r"(licen[sc]e|copying|copyright|notice|unlicense)([-_.].*)?", re.IGNORECASE)
rows = []
for package in sorted((packages[i] for i in linked if packages[i]["source"]), key=lambda p: (p["name"], p["version"])):
    home, texts = pathlib.Path(package["manifest_path"]).parent, 0
    for file in sorted(home.rglob("*")):
        if file.is_file() and called.fullmatch(file.name) and file.suffix.lower() in ("", ".txt", ".md", ".rst") or file.name in (package["license_file"],):
            to = folder / f"{package['name']}-{package['version']}" / file.relative_to(home)
            to.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, to)
            texts += 1
    rows.append(f"{package['name']} {package['version']}: {package['license'] or package['license_file']}" + ("" if texts else "; brings no text"))
(folder / "README").write_text("\n".join(rows) + "\n")
assert len(rows) > 100, f"only {len(rows)} packages: cargo metadata has changed"
END

if [ ! -x "$tool/bin/cargo-cyclonedx" ]; then
  CARGO_BUILD_JOBS=1 nice -n 19 cargo install --quiet --locked --root "$tool" --target-dir "$tool/build" --version 0.5.9 cargo-cyclonedx
  rm -rf "$tool/build"
fi
(cd "$source" && "$tool/bin/cargo-cyclonedx" cyclonedx --quiet --manifest-path crates/cli/Cargo.toml --format json --spec-version 1.5 --target "$target" --no-build-deps)
sed "s#file://$source#file:///nesam#g" "$source/crates/cli/nesam.cdx.json" > "$stage/sbom.cdx.json"
python3 - "$stage/sbom.cdx.json" "$stage/licences/README" "$out" <<'END'
import json, pathlib, sys

text = pathlib.Path(sys.argv[1]).read_text()
listed = {f"{c['name']} {c['version']}" for c in json.loads(text)["components"]}
linked = {line.split(":")[0] for line in pathlib.Path(sys.argv[2]).read_text().splitlines()}
assert linked <= listed, f"in the program and not in the list: {sorted(linked - listed)}"
assert sys.argv[3] not in text, "the list has paths of this machine in it"
END

tar --sort=name --mtime="@$SOURCE_DATE_EPOCH" --owner=0 --group=0 --numeric-owner --mode='u=rwX,go=rX' --format=gnu -C "$out" -cf - "$name" | gzip -9n > "$out/$name.tar.gz"
(cd "$out" && sha256sum "$name.tar.gz" > "$name.tar.gz.sha256")
"$stage/bin/nesam" --version
rm -rf "$source" "$stage" "$out/metadata.json"
ls -l "$out"
