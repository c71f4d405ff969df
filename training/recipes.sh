#!/usr/bin/env bash
# The runs behind the table of recipes: `recipes.sh flownets` (or flownetc, pwcnet) trains a network's legs one after the
# other, on one core; called again it goes on.
set -euo pipefail
cd "$(dirname "$0")"
network=$1
python=${PYTHON:-.venv/bin/python}
run() {
  "$python" train.py "$@" --minutes 100000 --resume --threads 1
}
case $network in
  pwcnet) recipes="paper authors-2021 unprocess" ;;
  flownets | flownetc)
    recipes="paper clean authors-2021 unprocess"
    run "$network.toml"
    ;;
  *)
    echo "expected flownets, flownetc or pwcnet, found $network" >&2
    exit 2
    ;;
esac
for recipe in $recipes; do
  run "${network}_leg.toml" --recipe "$recipe"
done
