#!/usr/bin/env bash
# Trains the network for the dark and its clean twin side by side on one GPU for so many minutes:
#   ./both.sh MINUTES [PYTHON]
# Called again it goes on from the checkpoints; the schedule of each run says when it is done.
set -euo pipefail
cd "$(dirname "$0")"
minutes=$1 python=${2:-python3}
for run in fcdn clean; do
  "$python" train.py "pixels_$run.toml" --minutes "$minutes" --every 1 --resume --threads 4 &
  runs+=($!)
done
for run in "${runs[@]}"; do wait "$run"; done
