#!/usr/bin/env bash
# The whole line on the shipped demonstrations, ending with a leaderboard. Called by `make demo`.
# Everything it makes lies in out/demo, which is made afresh on every run.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=target/release
out=out/demo
data=data/lift.hdf5
rm -rf "$out"
mkdir -p "$out"

step() { # step TEXT COMMAND...: say what is done, show the command, do it, say how long it took
    local text=$1 start=$SECONDS
    shift
    printf '\n\033[1m%s\033[0m\n$ %s\n' "$text" "${*//$bin\//}"
    "$@"
    printf '\033[2m%s: %d s\033[0m\n' "$text" $((SECONDS - start))
}

begin=$SECONDS
step "1/6 What is in the demonstrations" "$bin/actrm-data" inspect "$data"
step "2/6 HDF5 to a LeRobot data set" "$bin/actrm-data" convert "$data" "$out/lift"
step "3/6 Train ACT" "$bin/actrm-zoo" train act_lift --data "$out/lift" --zoo "$out/zoo" --runs "$out/runs"
step "4/6 Train ACTRM, which reasons first" "$bin/actrm-zoo" train actrm_lift --data "$out/lift" --zoo "$out/zoo" --runs "$out/runs"
step "5/6 Evaluate every entry in robosuite" "$bin/actrm-zoo" eval --all --episodes 20 --zoo "$out/zoo"
step "6/6 Leaderboard" "$bin/actrm-zoo" leaderboard --zoo "$out/zoo"
printf '\nThe whole line took %d s. Open %s/zoo/report.html in a browser.\n' $((SECONDS - begin)) "$out"
