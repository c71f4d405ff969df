#!/bin/sh
# The whole comparison in the dark: ours, RAFT-small, DIS, Farnebäck and no motion, on one folder of pairs with truth.
#
#   benches/rivals/ladder.sh PAIRS OUT [RAFT_SMALL.pth]
#
# PYTHON names a Python with numpy and opencv-python-headless (and torch and onnx for RAFT-small). NIGHTFLOW names the
# program, where it is not target/release/nightflow; LADDER holds more of its options, as --camera or --only.
set -eu
pairs=$1 out=$2 raft=${3:-}
here=$(dirname "$0")
nightflow=${NIGHTFLOW:-"$here/../../target/release/nightflow"}
python=${PYTHON:-python3}
enhancers=none,nlm,gaussian:2
mkdir -p "$out"
# The program ends with 3 where a pair was left out; it has named it, and the rest is worth judging.
judge() { "$nightflow" eval ladder "$pairs" "$@" ${LADDER:-} || [ $? -eq 3 ]; }

judge --models zero --enhancers "$enhancers" --write "$out/dark" > "$out/zero.md"
"$python" "$here/flow.py" "$out/dark" "$out/rivals" --methods dis,farneback
models="${MODELS:-pwcnet_fcdn}"
if [ -n "$raft" ]; then
    "$python" "$here/raft_small.py" "$raft" "$out/raft_small.onnx"
    models="$models,raft_small=$out/raft_small.onnx"
fi
models="$models,dis=$out/rivals/dis,farneback=$out/rivals/farneback,zero"
judge --models "$models" --enhancers "$enhancers" --out "$out"
