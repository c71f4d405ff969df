#!/usr/bin/env bash
# The trainer's tests with the very versions that pyproject.toml pins, set up under target/trainer the first time:
#   training/check.sh [PYTEST ARGUMENTS]
# As many tests at a time as there are cores, each on one thread: threads would wait for each other at every operation.
set -euo pipefail
cd "$(dirname "$0")"
home=../target/trainer
stamp=$home/$(sha256sum pyproject.toml | cut -c1-16)
if [ ! -f "$stamp" ]; then
  rm -rf "$home"
  python3 -m venv "$home" || python3 -m pip --version >/dev/null || {
    echo "the trainer's tests need python3 (3.11 or newer) with venv or pip (on Debian and Ubuntu: apt install python3-venv)" >&2
    exit 1
  }
  echo "installing PyTorch and what else the trainer needs under target/trainer (once, some minutes)"
  "$home/bin/python" -m pip install --quiet -e '.[test]'
  touch "$stamp"
fi
OMP_NUM_THREADS=${OMP_NUM_THREADS:-1} "$home/bin/python" -m pytest -q -n auto "$@"
