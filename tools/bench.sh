#!/usr/bin/env bash
# Every benchmark, each beside its peers in one run: a table (work, ours, peer, ratio, bar) on the terminal and
# target/bench/<name>.json. Called by `make bench`, which has built the programs and the peers' .venv-peers.
set -euo pipefail
cd "$(dirname "$0")/.."
export ACTRM_PEER_PYTHON="$PWD/.venv-peers/bin/python"
examples=target/release/examples

for name in ${*:-puzzles data act trm control evaluation}; do
    printf '\n== %s\n' "$name"
    case $name in
    puzzles | data) "$examples/bench_$name" ;;
    act | trm) "$examples/bench_$name" --peer "$ACTRM_PEER_PYTHON" ;;
    control | evaluation) .venv/bin/python "benches/$name.py" ;;
    *)
        echo "error: no benchmark $name; there are: puzzles data act trm control evaluation" >&2
        exit 2
        ;;
    esac
done
