#!/usr/bin/env bash
# Whether a GPU gives what the CPU gives, and how fast it trains (docs/howto/gpu.md). It needs no network.
#
#   tools/gpu_check.sh [--device cuda|cpu] [--peer PYTHON] [--rounds N] [--train SET [KEY=VALUE...]]
#
# --train also trains act_lift from the images of a data set, into out/gpu; the other options are those of
# tools/actrm-zoo/examples/gpu_check.rs.
set -euo pipefail
cd "$(dirname "$0")/.."
device=cuda set='' keys=() options=()
while [ $# -gt 0 ]; do
    case $1 in
    --device) device=$2; shift 2 ;;
    --train) set=$2; shift 2 ;;
    --*) options+=("$1" "$2"); shift 2 ;;
    *) keys+=("$1"); shift ;;
    esac
done
programs=target/cuda/release
[ "$device" != cpu ] || [ ! -x target/release/examples/gpu_check ] || programs=target/release
for program in $programs/actrm-zoo $programs/examples/gpu_check; do
    [ -x "$program" ] || { echo "error: $program is not there: make cuda" >&2; exit 1; }
done
$programs/examples/gpu_check --device "$device" "${options[@]}"
if [ -n "$set" ]; then
    rm -rf out/gpu
    $programs/actrm-zoo train act_lift inputs=image --data "$set" --device "$device" --run out/gpu/run --zoo out/gpu/zoo "${keys[@]}"
fi
