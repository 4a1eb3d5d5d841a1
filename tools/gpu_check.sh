#!/usr/bin/env bash
# Whether a GPU gives what the CPU gives, and how fast it trains: docs/howto/gpu.md. Options are those of
# tools/actrm-zoo/examples/gpu_check.rs. It needs no network.
set -euo pipefail
cd "$(dirname "$0")/.."
check=target/cuda/release/examples/gpu_check
case " $* " in *" --device cpu "*) [ -x "$check" ] || check=target/release/examples/gpu_check ;; esac
[ -x "$check" ] || { echo "error: $check is not there: make cuda" >&2; exit 1; }
case " $* " in *" --device "*) exec "$check" "$@" ;; *) exec "$check" --device cuda "$@" ;; esac
