#!/usr/bin/env bash
# Makes the figures of docs/results anew, hours on two cores: benches/results.sh PROGRAM DATA OUT [NAME...]
#
# PROGRAM is a built nesam, DATA the folder with `chrono` and `real`, OUT takes what each command prints (NAME.txt) and its JSON. What is there is not made
# again, so an interrupted run goes on; NAMEs make these alone. Times are told by `speed` and `wire` alone, which want an idle machine and are made only where named.
set -euo pipefail
program=$(realpath "$1") data=$(realpath "$2") out=$(realpath -m "$3")
shift 3
only=("$@")
mkdir -p "$out"
cd "$(dirname "$0")/.."
chrono=$data/chrono husky=$data/real/husky

asked() { [ ${#only[@]} -eq 0 ] || printf '%s\n' "${only[@]}" | grep -qx "$1"; }

# make NAME ARGUMENTS...: runs the program; `@` before a name stands for the folder of results.
make() {
  local name=$1
  shift
  asked "$name" && [ ! -e "$out/$name.txt" ] || return 0
  echo "$(date +%H:%M:%S) $name: nesam $*" >&2
  if "$program" "${@//@/$out/}" > "$out/$name.part" 2> "$out/$name.log"; then
    mv "$out/$name.part" "$out/$name.txt"
  else
    echo "$name failed, see $out/$name.log" >&2
  fi
}

worlds=w01,w02,w03,w04,w05,w06,w07,w08
make open-steering diagnose --data "$chrono" --set effect_open/steer_offset --out @open-steering
make open-drag diagnose --data "$chrono" --set effect_open/wheel_drag --out @open-drag
make open-payload diagnose --data "$chrono" --set effect_open/payload --out @open-payload
make open-null diagnose --data "$chrono" --set effect_open/null_open --out @open-null
make nominal evaluate --data "$chrono" --set nominal --split test --json @nominal.json --html @nominal.html --markdown @nominal.md
make nominal-gt evaluate --data "$chrono" --set nominal --split test --models nesam --truth gt --out @nominal-gt
make nominal-gt-start evaluate --data "$chrono" --set nominal --split test --models nesam --start gt --out @nominal-gt-start
make inside inside --data "$chrono" --set nominal --split test --json @inside.json
make coverage evaluate --coverage --data "$chrono" --set nominal --split test --json @coverage.json
make coverage-ood evaluate --coverage --data "$chrono" --set ood_soil --json @coverage-ood.json
make ood evaluate --data "$chrono" --set ood_soil --models nesam,transformer,kinematic_residual,rigid_residual,kinematic --json @ood.json --html @ood.html
make adapt-ood adapt --data "$chrono" --set ood_soil --also literal,oracle-soil,best-constant,best-by-class,constant-elsewhere \
  --apart o07,o08,o09,o10 --reference ood_reference --json @adapt-ood.json --html @adapt-ood.html
make adapt-reference adapt --data "$chrono" --set ood_reference --out @adapt-reference
make adapt-nominal adapt --data "$chrono" --set nominal --split test --also oracle-soil --json @adapt-nominal.json --html @adapt-nominal.html
make fleet-ood fleet --data "$chrono" --set ood_soil --json @fleet-ood.json
make fleet-nominal fleet --data "$chrono" --set nominal --split test --json @fleet-nominal.json
for seed in 1 2 3; do
  make "consistency-$seed" bench consistency --seed $seed --json "@consistency-$seed.json"
  make "consistency-border-$seed" bench consistency --border 15 --seed $seed --json "@consistency-border-$seed.json"
done
make consistency-literal bench consistency --literal --json @consistency-literal.json
make husky evaluate --data "$husky" --set drive --split test --horizon 19 --history 1 --out @husky
make husky-wheels evaluate --data "$husky" --set drive --split test --horizon 19 --history 1 --inputs wheels --out @husky-wheels
make husky-sheet diagnose --data "$husky" --set drive --reference physics --fit-on train --bundle deploy/bundles/hmmwv-nominal --out @husky-sheet
make husky-trained diagnose --data "$husky" --set drive --reference physics --fit-on train --out @husky-trained
make alarms-train bench alarms --data "$chrono" --set nominal --split train --hide --json @alarms-train.json
make alarms-test bench alarms --data "$chrono" --set nominal --split test --json @alarms-test.json
make alarms-ood bench alarms --data "$chrono" --set ood_soil --json @alarms-ood.json
make physics diagnose --data "$chrono" --reference physics --set nominal --split train --out @physics \
  --trajectories n0009,n0025,n0039,n0052,n0067,n0081,n0095,n0109,n0122,n0137,n0148,n0162,n0178,n0194,n0207
make hidden bench discovery --data "$chrono" --set nominal --split train --json @hidden.json \
  --sets sensor,two,map,map_large,actuator,onset,left_out,outside,force_twin,force_twin_large,other_twin,onset_twin
make hidden-null bench discovery --data "$chrono" --set nominal --split train --sets null --nulls 64 --json @hidden-null.json
make hidden-noise bench discovery --data "$chrono" --set nominal --split train --sets null_noise --json @hidden-noise.json
make rivals bench discovery --data "$chrono" --set nominal --split train --sets actuator,sensor,map,two --comparators --json @rivals.json
make rivals-null bench discovery --data "$chrono" --set nominal --split train --sets null,null_noise --comparators --json @rivals-null.json
make plant-check plant check --data "$chrono" --set nominal --split train --trajectories n0009,n0081,n0148,n0220,n0284,n0354
make laps navigate --data "$chrono" --runs 30 --candidates 64 --plan-every 3 --json @laps.json --html @laps.html
make plant bench plant --data "$chrono" --worlds $worlds --json @plant.json
degradations=(--degrade jitter=10ms --degrade loss=0.05 --degrade reorder=0.1 --degrade clock-step=0.5s --degrade imu=200hz --degrade imu=200hz,loss=0.05 --degrade)
make link-nominal replay --data "$chrono" --set nominal --split test --every 9 "${degradations[@]}"
make link-ood replay --data "$chrono" --set ood_soil "${degradations[@]}"
make link-husky replay --data "$husky" --split test "${degradations[@]}"
make nominal-train evaluate --data "$chrono" --set nominal --split train --models nesam,transformer --out @nominal-train
for seed in 2 3; do
  make "nominal-seed$seed" evaluate --data "$chrono" --set nominal --split test --models nesam,transformer --out "@nominal-seed$seed" \
    --bundle "deploy/candidates/hmmwv-nominal-seed$seed" --baselines "deploy/candidates/baselines-seed$seed"
done

# Times: nothing else may run.
quiet() { [ ${#only[@]} -ne 0 ] && make "$@"; return 0; }
quiet speed bench predict --data "$chrono" --set nominal --split train --queries 30 --parts --json @speed.json
quiet speed-sweep bench predict --data "$chrono" --set nominal --split train --queries 30 --sweep --json @speed-sweep.json
quiet speed-bf16 bench predict --data "$chrono" --set nominal --split train --queries 30 --parts --path avx512-bf16 --json @speed-bf16.json
quiet wire bench wire --queries 30 --json @wire.json
quiet serve-load bench serve --seconds 6 --json @serve-load.json
