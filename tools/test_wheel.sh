#!/usr/bin/env bash
# The wheel in clean environments of the oldest and the newest Python that are there: the tests in the oldest, README's
# example in the newest.
# Called by `make test`.
set -euo pipefail
cd "$(dirname "$0")/.."
built=$(realpath "${CARGO_TARGET_DIR:-target}")
wheel=$(echo "$built"/wheels/actrm-*.whl)
versions=()
for version in 3.11 3.12 3.13; do
    [[ -z $(tools/find-python "$version" "$version") ]] || versions+=("$version")
done
[[ ${#versions[@]} -gt 0 ]] || { echo "error: no Python 3.11, 3.12 or 3.13 found" >&2; exit 1; }
for version in $(printf '%s\n' "${versions[0]}" "${versions[-1]}" | uniq); do
    python=$(tools/find-python "$version" "$version")
    venv=$built/wheel-venvs/$version
    if [[ ! -e $venv/.complete || crates/python/tests/requirements.lock -nt $venv/.complete ]]; then
        rm -rf "$venv"
        "$python" -m venv "$venv"
        "$venv/bin/python" -m pip install --disable-pip-version-check --no-input --quiet --require-hashes --no-deps \
            -r crates/python/tests/requirements.lock
        touch "$venv/.complete"
    fi
    if [[ $version = "${versions[0]}" ]]; then
        # as `pip install .` in a clone: what cargo has built is there
        "$venv/bin/python" -m pip install --disable-pip-version-check --quiet --no-deps --force-reinstall .
        tests=(.)
    else
        "$venv/bin/python" -m pip install --disable-pip-version-check --quiet --no-index --no-deps --force-reinstall "$wheel"
        tests=(test_readme.py::test_readme_s_example_runs)
    fi
    echo "Python $version: ${tests[*]}"
    # from the tests' folder, so that nothing of the repository is imported by accident
    (cd crates/python/tests && "$venv/bin/python" -m pytest -q -p no:cacheprovider "${tests[@]}" --rootdir .)
done
