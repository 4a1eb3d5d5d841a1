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
step "1/9 What is in the demonstrations" "$bin/actrm-data" inspect "$data"
step "2/9 HDF5 to a LeRobot data set" "$bin/actrm-data" convert "$data" "$out/lift"
step "3/9 Train ACT" "$bin/actrm-zoo" train act_lift --data "$out/lift" --zoo "$out/zoo" --runs "$out/runs"
step "4/9 Train ACTRM, which refines its actions" "$bin/actrm-zoo" train actrm_lift --data "$out/lift" --zoo "$out/zoo" --runs "$out/runs"
step "5/9 Evaluate both in robosuite" "$bin/actrm-zoo" eval --all --episodes 20 --video 1 --zoo "$out/zoo"

# the same from images: two cameras and the robot's own state, without the position of the cube
seen=$SECONDS
step "6/9 Demonstrations seen by two cameras" "$bin/actrm-data" collect --task Lift --episodes 40 --seed 7 \
    --cameras agentview,robot0_eye_in_hand --image-size 84 --fast-render --no-next-obs --out "$out/lift_image.hdf5"
step "7/9 Train ACT on images" "$bin/actrm-zoo" train act_lift_image --data "$out/lift_image.hdf5" --zoo "$out/zoo" --runs "$out/runs" train.steps=500
step "8/9 Evaluate it" "$bin/actrm-zoo" eval lift-act-image --episodes 20 --video-failed 1 --zoo "$out/zoo"
printf '\nFrom cameras to success took %d s.\n' $((SECONDS - seen))

step "9/9 Leaderboard" "$bin/actrm-zoo" leaderboard --zoo "$out/zoo"
printf '\nThe whole line took %d s. Open %s/zoo/report.html in a browser; it has films of the first episodes.\n' $((SECONDS - begin)) "$out"
printf 'Next: export PATH="$PWD/%s:$PATH"\n      actrm-zoo list\n      actrm-zoo rerun lift-act-s1 --protocol lift-v1 --collect\n' "$bin"
