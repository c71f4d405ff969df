#!/usr/bin/env bash
# Trains the network for the dark and its clean twin side by side on one GPU for so many minutes, then exports both:
#   ./both.sh MINUTES VERSION [PYTHON]
# Called again it goes on from the checkpoints; the schedule of each run says when it is done.
set -euo pipefail
cd "$(dirname "$0")"
minutes=$1 version=$2 python=${3:-python3}
for run in fcdn clean; do
  "$python" train.py "gpu_$run.toml" --minutes "$minutes" --every 2 --resume --threads 4 &
  runs+=($!)
done
for run in "${runs[@]}"; do wait "$run"; done
for run in fcdn clean; do
  "$python" export.py "runs/gpu_$run/checkpoint" --fast --name "pwcnet_$run" --version "$version" --models runs/models
done
