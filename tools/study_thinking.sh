#!/usr/bin/env bash
# Does thinking help, and from how few demonstrations? ACT, ACTRM, and ACTRM that may not think (one supervision step
# instead of three: the same parameters), all trained and evaluated alike. Called by `make study-thinking`; TASKS, DEMOS,
# POLICIES, SEEDS (of the training), EPISODES, SEED_START and STEPS change the sizes.
#
# Everything lies in out/thinking. Killed at any moment, it goes on where it was; what is there is not made again. It
# ends with a leaderboard, as Markdown in out/thinking/results.md.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=${BIN:-${CARGO_TARGET_DIR:-target}/release}
out=${OUT_DIR:-out/thinking}
mkdir -p "$out"
common=("train.steps=${STEPS:-4000}" train.batch_size=32 train.ema_decay=0.99 policy.use_vae=false)

source tools/robot_tasks.sh
# experiment, then what is changed in it
declare -A policies=([act]=act [actrm]=actrm [unthinking]="actrm policy.reasoning.supervision_steps=1")

for task in ${TASKS:-stack pickplacecan}; do
    name=${names[$task]:?no such task; there are: ${!names[*]}}
    for demos in ${DEMOS:-25 50 200}; do
        file=$out/$task-$demos.hdf5
        if [[ ! -e $file ]]; then
            # the first of the same seeds: a smaller set is a part of a larger one
            "$bin/actrm-data" collect --task "$name" --episodes "$demos" --seed 1 --out "$file"
        fi
        for policy in ${POLICIES:-act unthinking actrm}; do
            read -ra changes <<<"${policies[$policy]:?no such policy; there are: ${!policies[*]}}"
            for seed in ${SEEDS:-1 2 3}; do
                entry=$task-$policy-$demos-seed$seed run=$out/runs/$task-$policy-$demos-seed$seed
                printf '\n\033[1m%s\033[0m\n' "$entry"
                if [[ ! -e $out/zoo/$entry/1 ]]; then
                    arguments=(train "${changes[0]}_$task" --data "$file" --zoo "$out/zoo" --run "$run" "entry=$entry")
                    if [[ -e $run/config.toml ]]; then arguments+=(--resume); fi
                    "$bin/actrm-zoo" "${arguments[@]}" "train.seed=$seed" "${common[@]}" "${changes[@]:1}"
                fi
                "$bin/actrm-zoo" eval "$entry" --episodes "${EPISODES:-100}" --seed-start "${SEED_START:-10000}" \
                    --zoo "$out/zoo"
            done
        done
    done
done
"$bin/actrm-zoo" leaderboard --zoo "$out/zoo" --markdown "$out/results.md"
