#!/usr/bin/env bash
# What ACT reaches on every robot task: 200 demonstrations of the scripted expert, one training, 100 episodes of unseen
# seeds. Called by `make study-robots`; TASKS="stack door" does some, POLICY=actrm trains the other policy, EPISODES and
# DEMOS change the sizes, and further arguments override settings of every training (train.steps=500).
#
# Everything lies in out/robots. Killed at any moment, it goes on where it was; what is there is not made again. It ends
# with a leaderboard, as Markdown in out/robots/results.md.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${BIN:-${CARGO_TARGET_DIR:-target}/release}
out=${OUT_DIR:-out/robots}
policy=${POLICY:-act}
demos=${DEMOS:-200}
episodes=${EPISODES:-100}
mkdir -p "$out"

source tools/robot_tasks.sh

step() { # step TEXT COMMAND...: say what is done, show the command, do it
    printf '\n\033[1m%s\033[0m\n$ %s\n' "$1" "${*:2}"
    "${@:2}"
}

for task in ${TASKS:-lift stack pickplacecan door stackthreecubes nutassemblysquare stackcolor}; do
    name=${names[$task]:?no such task; there are: ${!names[*]}}
    experiment=${policy}_$task
    file=$out/$task.hdf5 set=$out/$task
    if [[ ! -e $file ]]; then
        step "$name: demonstrations" "$bin/actrm-data" collect --task "$name" --episodes "$demos" --seed 1 --out "$file"
    fi
    if [[ ! -e $set ]]; then
        step "$name: data set" "$bin/actrm-data" convert "$file" "$set"
    fi
    entry=$task-$policy
    if [[ ! -e $out/zoo/$entry/1 ]]; then
        arguments=(train "$experiment" --data "$set" --zoo "$out/zoo" --run "$out/runs/$experiment" "$@")
        if [[ -e $out/runs/$experiment/config.toml ]]; then arguments+=(--resume); fi
        step "$name: training" "$bin/actrm-zoo" "${arguments[@]}"
    fi
    step "$name: evaluation" "$bin/actrm-zoo" eval "$entry" --episodes "$episodes" --zoo "$out/zoo"
done
"$bin/actrm-zoo" leaderboard --zoo "$out/zoo" --markdown "$out/results.md"
