#!/usr/bin/env bash
# A conversion as Slurm jobs: one plans it, an array converts one shard a task, one merges them.
#
#   tools/cluster/slurm_convert.sh SHARDS SOURCE OUT ACTRM_DATA_CONVERT_ARGUMENTS...
#   tools/cluster/slurm_convert.sh 8 s3://lab/aloha s3://lab/set --video
#
# SOURCE and OUT are plain paths that all nodes see, or addresses that fsspec knows (s3://, gs://); then a node needs disk for
# a shard only, and the one that merges for the data set. This folder must lie on a file system that all nodes see.
# SBATCH_OPTIONS holds further options for all jobs (partition, account, time); ACTRM_DATA names the program if it is not on
# PATH, ACTRM_CLUSTER_PYTHON the interpreter (python3) with fsspec, s3fs or gcsfs, and h5py. What is staged lies in $TMPDIR. A shard
# that failed or was preempted is converted again when its task is submitted again: `scontrol requeue JOB_TASK`.
set -euo pipefail

if [[ $# -lt 3 || ! $1 =~ ^[1-9][0-9]*$ ]]; then
    sed -n '2,12s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
shards=$1 source=$2 out=$3
shift 3
stages=("${ACTRM_CLUSTER_PYTHON:-python3}" "$(realpath "$(dirname "$0")")/convert_stages.py")
read -ra options <<<"${SBATCH_OPTIONS:-}"
quoted() { printf '%q ' "${stages[@]}" "$@"; }

plan=$(sbatch --parsable --job-name=actrm-plan --cpus-per-task=1 "${options[@]}" --wrap="$(quoted plan "$source" "$out")")
# shellcheck disable=SC2016  # the node expands these, not this shell
array=$(sbatch --parsable --requeue --job-name=actrm-convert --array="1-$shards" --dependency="afterok:$plan" --cpus-per-task=2 \
    "${options[@]}" --wrap="$(quoted shard "$source" "$out")"'"$SLURM_ARRAY_TASK_ID/'"$shards"'" -- --jobs "$SLURM_CPUS_PER_TASK" '"$( (($#)) && printf '%q ' "$@" || true)")
merge=$(sbatch --parsable --job-name=actrm-merge --dependency="afterok:$array" --cpus-per-task=1 "${options[@]}" \
    --wrap="$(quoted merge "$out" "$shards")")
echo "plan $plan, array $array ($shards shards), then merge $merge; shards in ${out%/}.shards"
