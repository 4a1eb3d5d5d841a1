#!/usr/bin/env bash
# Other people's training code on our demonstrations, judged by our harness: docs/results/references.md. What is done is not done
# again; Ctrl-C at any moment, and the same command goes on (a training of robomimic's begins anew, LeRobot's goes on).
#
#   tools/references.sh [--data FOLDER] [--only WORD]... [--train-only]
#
# FOLDER holds lift-200-seed1.hdf5 and pickplacecan-200-seed1.hdf5; without it they are collected as studies/policies.toml says.
# Wants `make build`, .venv and .venv-peers (`make venv`, `make bench` make them). One thread; about an hour alone.
set -euo pipefail
cd "$(dirname "$0")/.."
work=out/references
for need in "${CARGO_TARGET_DIR:-target}/release/actrm-zoo" .venv/bin/python .venv-peers/bin/python; do
    [[ -x $need ]] || { echo "error: $need is not there; run make build, make .venv/.complete and make .venv-peers/.complete" >&2; exit 1; }
done

# what the packages need to train, beside what they bring along, in a folder of its own
lock=benches/peers/training.lock
if ! cmp -s "$lock" "$work/python/training.lock"; then
    rm -rf "$work/python" "$work/python.part"
    mkdir -p "$work"
    .venv-peers/bin/python -m pip install --disable-pip-version-check --no-input --quiet --require-hashes --no-deps \
        --target "$work/python.part" -r "$lock"
    cp "$lock" "$work/python.part/training.lock"
    mv "$work/python.part" "$work/python"
fi

args=("$@")
if [[ " $* " != *" --data "* ]]; then
    RAYON_NUM_THREADS=1 "${CARGO_TARGET_DIR:-target}/release/actrm-zoo" study studies/policies.toml --data-only \
        --only act-on-lift-seed1 --only act-on-pickplacecan-seed1
    args+=(--data out/study/zoo/data)
fi
export PYTHONPATH=$PWD/$work/python
.venv-peers/bin/python benches/peers/references.py "${args[@]}"
.venv-peers/bin/python benches/peers/references_page.py
