#!/usr/bin/env bash
# Every benchmark, each beside its peers in one run: a table (work, ours, peer, ratio, bar) on the terminal and
# target/bench/<name>.json; one table of all rows at the end. A missed bar stops nothing; the exit code then is 1.
# Called by `make bench`, which has built the programs and the peers' .venv-peers.
set -euo pipefail
cd "$(dirname "$0")/.."
export ACTRM_PEER_PYTHON="$PWD/.venv-peers/bin/python"
examples=target/release/examples
names=(data act policies trm control evaluation vision python external report)

for name in "${@:-}"; do
    if [[ -n $name && " ${names[*]} " != *" $name "* ]]; then
        echo "error: no benchmark $name; there are: ${names[*]}" >&2
        exit 2
    fi
done

ended=()
for name in ${*:-${names[*]}}; do
    printf '\n== %s\n' "$name"
    rm -f "target/bench/$name.json"
    code=0
    if [[ $name == vision ]]; then
        # three parts: networks, data, drawing
        rm -f target/bench/pictures.json target/bench/rendering.json
        "$examples/bench_data" --pictures || ended+=("pictures=$?")
        .venv/bin/python benches/rendering.py || ended+=("rendering=$?")
        for part in pictures rendering; do
            [[ " ${ended[*]} " == *" $part="* ]] || ended+=("$part=0")
        done
    fi
    case $name in
    data | report) "$examples/bench_$name" || code=$? ;;
    act | trm | vision) "$examples/bench_$name" --peer "$ACTRM_PEER_PYTHON" || code=$? ;;
    policies) RAYON_NUM_THREADS=1 "$examples/bench_policies" --peer "$ACTRM_PEER_PYTHON" || code=$? ;;
    control | evaluation) .venv/bin/python "benches/$name.py" || code=$? ;;
    python | external)
        # the peers' environment, with the wheel beside it
        site=target/bench/python
        rm -rf "$site"
        "$ACTRM_PEER_PYTHON" -m pip install --quiet --no-index --no-deps --target "$site" target/wheels/actrm-*.whl
        PYTHONPATH="$PWD/$site" "$ACTRM_PEER_PYTHON" "benches/$name.py" || code=$?
        ;;
    esac
    ended+=("$name=$code")
done
printf '\n== all\n'
.venv/bin/python benches/summary.py "${ended[@]}"
