#!/usr/bin/env bash
# A study of robot policies as Slurm jobs: one collects the demonstrations, an array trains and tests one cell a task, one
# writes the page.
#
#   tools/cluster/slurm_study.sh STUDY ACTRM_ZOO_STUDY_ARGUMENTS...
#   tools/cluster/slurm_study.sh studies/policies.toml --work /shared/study
#
# The folders that the study names, and that of --work, must lie on a file system that all nodes see. SBATCH_OPTIONS holds
# further options for all jobs (partition, account, time); ACTRM_ZOO names the program if it is not on PATH. What has a
# result is not run again; a task that failed or was preempted goes on where it was: `scontrol requeue JOB_TASK`.
set -euo pipefail

if [[ $# -lt 1 || ! -f $1 ]]; then
    sed -n '2,11s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
study=$1
shift
program=${ACTRM_ZOO:-actrm-zoo}
read -ra options <<<"${SBATCH_OPTIONS:-}"
quoted() { printf '%q ' "$program" study "$study" "$@"; }
cells=$(quoted "$@" --list)
count=$("$program" study "$study" "$@" --list | wc -l)

data=$(sbatch --parsable --requeue --job-name=actrm-data --cpus-per-task=2 "${options[@]}" --wrap="$(quoted "$@" --data-only)")
# shellcheck disable=SC2016  # the node expands these, not this shell
array=$(sbatch --parsable --requeue --job-name=actrm-study --array="1-$count" --dependency="afterok:$data" \
    --cpus-per-task=2 "${options[@]}" --wrap='cell=$('"$cells"'| sed -n "${SLURM_ARRAY_TASK_ID}s/: .*//p"); '"$(quoted "$@")"'--cell "$cell"')
page=$(sbatch --parsable --job-name=actrm-page --dependency="afterany:$array" --cpus-per-task=1 "${options[@]}" \
    --wrap="$(quoted "$@" --page-only)")
echo "demonstrations $data, array $array ($count cells), page $page"
