"""RAFT-small (Teed and Deng 2020) from the published architecture, exported to ONNX for a comparison in the dark.

The graph takes two images, NCHW, RGB, 0...255, sides multiples of 64, and gives the flow [1, 2, H, W] after a fixed
number of iterations.

    python raft_small.py raft-small.pth raft_small.onnx --iterations 12
"""

import argparse
import sys
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[2] / "training"))
from raft import RaftSmall  # noqa: E402

EIGHTH = 8


class Published(RaftSmall):
    """The trainer's network without what was added to it: images of 0...255, and a flow enlarged bilinearly."""

    def forward(self, older: Tensor, newer: Tensor) -> Tensor:
        (features, context), (others, _) = (self.frame(image / 255) for image in (older, newer))
        *_, (flow, _) = self.steps(features, others, context)
        return EIGHTH * F.interpolate(flow, scale_factor=EIGHTH, mode="bilinear", align_corners=True)


def load(weights: str, iterations: int) -> Published:
    """The published weights; every one of them must fit."""
    network = Published(iterations).eval()
    network.published(weights)
    return network


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="raft-small.pth of the authors")
    parser.add_argument("target", help="the ONNX file to write")
    parser.add_argument("--iterations", type=int, default=12, help="12 or 20; the authors train with 12")
    arguments = parser.parse_args()
    network = load(arguments.weights, arguments.iterations)
    images = (torch.rand(1, 3, 128, 192) * 255, torch.rand(1, 3, 128, 192) * 255)
    free = {2: "height", 3: "width"}
    torch.onnx.export(
        network, images, arguments.target, input_names=["older", "newer"], output_names=["flow"], opset_version=17,
        dynamic_axes={"older": free, "newer": free, "flow": free}, dynamo=False,
    )
    print(f"{arguments.target}: {arguments.iterations} iterations")


if __name__ == "__main__":
    main()
