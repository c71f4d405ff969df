"""Exports an untrained dense PWC-Net, as `pwcnet_dense`, into a folder with a manifest of its own: what its connections cost
in time does not depend on weights. `dense.py --to FOLDER`, then `nightflow bench --rivals --config` with
`[flow] models = "FOLDER"` and `network = "pwcnet_dense"`, says what it takes."""

import argparse
from pathlib import Path

import torch

from export import export
from networks import PwcNet

NAME, SEED = "pwcnet_dense", 1
# Residuals are so much smaller than those that training begins with, and the gate of the soft arg-max is so far closed: flow
# stays small, and near enough to itself in fewer bits.
TAME, GATE = 0.1, -3.5


def untrained() -> PwcNet:
    """A network of the same weights every time."""
    torch.manual_seed(SEED)
    network = PwcNet(dense=True)
    decoder = network.decoder
    with torch.no_grad():
        for last in (decoder.shared.predict, decoder.fine.predict, decoder.context[-1], decoder.error[-1]):
            last.weight.mul_(TAME)
        for level in (decoder.shared, decoder.fine):
            level.predict.bias[2] = GATE
    return network


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--to", metavar="FOLDER", type=Path, required=True, help="which must not hold a manifest yet")
    folder = parser.parse_args().to
    if (folder / "manifest.toml").exists():
        raise SystemExit(f"{folder}: expected a folder without a manifest.toml, which would be merged with")
    folder.mkdir(parents=True, exist_ok=True)
    network = untrained()
    # Without training there is no accuracy to be lost in fewer bits.
    settings = argparse.Namespace(name=NAME, models=folder, plain=False, version=f"untrained-{SEED}", precisions=["bf16"])
    export(settings, network, {"mean": network.state_dict()}, NAME)


if __name__ == "__main__":
    main()
