#!/usr/bin/env bash
# An evaluation as a Slurm job array: one shard a task, then one job that merges them.
#
#   tools/cluster/slurm_eval.sh SHARDS ACTRM_ZOO_EVAL_ARGUMENTS...
#   tools/cluster/slurm_eval.sh 8 lift-act@1 --episodes 400 --zoo /shared/zoo
#
# The zoo must lie on a file system that all nodes see. SBATCH_OPTIONS holds further options for both jobs
# (partition, account, time); ACTRM_ZOO names the program if it is not on PATH. A shard that failed or was preempted
# goes on where it was when its task is submitted again: `scontrol requeue JOB_TASK`.
set -euo pipefail

if [[ $# -lt 2 || ! $1 =~ ^[1-9][0-9]*$ ]]; then
    sed -n '2,9s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
shards=$1
shift
program=${ACTRM_ZOO:-actrm-zoo}
# folders that `merge` takes too
places=()
arguments=("$@")
for ((i = 0; i < $#; i++)); do
    case ${arguments[i]} in
    --zoo | --results) places+=("${arguments[i]}" "${arguments[i + 1]:?${arguments[i]} needs a folder}") ;;
    --zoo=* | --results=*) places+=("${arguments[i]}") ;;
    esac
done
read -ra options <<<"${SBATCH_OPTIONS:-}"
quoted=$(printf '%q ' "$program" eval "$@")

# shellcheck disable=SC2016  # the node expands these, not this shell
array=$(sbatch --parsable --requeue --job-name=actrm-eval --array="1-$shards" --cpus-per-task=2 "${options[@]}" \
    --wrap="$quoted"'--workers "$SLURM_CPUS_PER_TASK" --shard "$SLURM_ARRAY_TASK_ID/'"$shards"'"')
merge=$(sbatch --parsable --job-name=actrm-merge --dependency="afterok:$array" --cpus-per-task=1 "${options[@]}" \
    --wrap="$(printf '%q ' "$program" merge "${places[@]}")")
echo "array $array ($shards shards), then merge $merge"
