"""RAFT-small (Teed and Deng 2020) from the published architecture, exported to ONNX for a comparison in the dark.

The graph takes two images, NCHW, RGB, 0...255, sides multiples of 64, and gives the flow [1, 2, H, W] after a fixed
number of iterations.

    python raft_small.py raft-small.pth raft_small.onnx --iterations 12
"""

import argparse

import torch
import torch.nn.functional as F
from torch import Tensor, nn

HIDDEN, CONTEXT, LEVELS, RADIUS = 96, 64, 4, 3
EIGHTH = 8


class Bottleneck(nn.Module):
    """A 1x1, 3x3, 1x1 residual unit; the names are those of the published state dict."""

    def __init__(self, entering: int, leaving: int, stride: int, normed: bool):
        super().__init__()
        inner = leaving // 4
        self.conv1 = nn.Conv2d(entering, inner, 1)
        self.conv2 = nn.Conv2d(inner, inner, 3, stride, 1)
        self.conv3 = nn.Conv2d(inner, leaving, 1)
        self.downsample = nn.ModuleList([nn.Conv2d(entering, leaving, 1, stride)]) if stride > 1 else None
        self.normed = normed

    def norm(self, x: Tensor) -> Tensor:
        """Instance normalisation in the feature encoder, none in the context encoder."""
        return F.instance_norm(x) if self.normed else x

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm(self.conv1(x)))
        y = F.relu(self.norm(self.conv2(y)))
        y = F.relu(self.norm(self.conv3(y)))
        return F.relu((self.norm(self.downsample[0](x)) if self.downsample is not None else x) + y)


class Encoder(nn.Module):
    """An eighth of the image's rows and columns."""

    def __init__(self, leaving: int, normed: bool):
        super().__init__()
        self.conv1 = nn.Conv2d(3, 32, 7, 2, 3)
        stages = ((32, 32, 1), (32, 64, 2), (64, 96, 2))
        for number, (entering, width, stride) in enumerate(stages, 1):
            units = [Bottleneck(entering, width, stride, normed), Bottleneck(width, width, 1, normed)]
            setattr(self, f"layer{number}", nn.Sequential(*units))
        self.conv2 = nn.Conv2d(96, leaving, 1)
        self.normed = normed

    def forward(self, image: Tensor) -> Tensor:
        x = self.conv1(image)
        x = F.relu(F.instance_norm(x) if self.normed else x)
        return self.conv2(self.layer3(self.layer2(self.layer1(x))))


class Motion(nn.Module):
    """Correlations and flow become the recurrent unit's input."""

    def __init__(self):
        super().__init__()
        self.convc1 = nn.Conv2d(LEVELS * (2 * RADIUS + 1) ** 2, 96, 1)
        self.convf1 = nn.Conv2d(2, 64, 7, padding=3)
        self.convf2 = nn.Conv2d(64, 32, 3, padding=1)
        self.conv = nn.Conv2d(128, 80, 3, padding=1)

    def forward(self, flow: Tensor, correlation: Tensor) -> Tensor:
        seen = F.relu(self.convc1(correlation))
        moved = F.relu(self.convf2(F.relu(self.convf1(flow))))
        return torch.cat([F.relu(self.conv(torch.cat([seen, moved], 1))), flow], 1)


class Gates(nn.Module):
    """A convolutional gated recurrent unit."""

    def __init__(self):
        super().__init__()
        entering = HIDDEN + CONTEXT + 82
        self.convz, self.convr, self.convq = (nn.Conv2d(entering, HIDDEN, 3, padding=1) for _ in range(3))

    def forward(self, state: Tensor, x: Tensor) -> Tensor:
        both = torch.cat([state, x], 1)
        keep, reset = torch.sigmoid(self.convz(both)), torch.sigmoid(self.convr(both))
        return (1 - keep) * state + keep * torch.tanh(self.convq(torch.cat([reset * state, x], 1)))


class Head(nn.Module):
    """From the state to a step of the flow."""

    def __init__(self):
        super().__init__()
        self.conv1 = nn.Conv2d(HIDDEN, 128, 3, padding=1)
        self.conv2 = nn.Conv2d(128, 2, 3, padding=1)

    def forward(self, state: Tensor) -> Tensor:
        return self.conv2(F.relu(self.conv1(state)))


class Update(nn.Module):
    """One iteration's layers."""

    def __init__(self):
        super().__init__()
        self.encoder, self.gru, self.flow_head = Motion(), Gates(), Head()


class RaftSmall(nn.Module):
    """The whole, with a fixed number of iterations."""

    def __init__(self, iterations: int):
        super().__init__()
        self.fnet, self.cnet = Encoder(128, normed=True), Encoder(HIDDEN + CONTEXT, normed=False)
        self.update_block = Update()
        self.iterations = iterations

    def look(self, volumes: list[Tensor], places: Tensor) -> Tensor:
        """Correlations around where each point went, [1, 196, h, w]; a volume is [h w, 1, rows, columns]."""
        side = 2 * RADIUS + 1
        steps = torch.arange(-RADIUS, RADIUS + 1, dtype=places.dtype)
        # The published lookup runs through x in its outer loop and through y in its inner one.
        offsets = torch.stack([steps.repeat_interleave(side), steps.repeat(side)], 1).view(1, side, side, 2)
        found = []
        for level, volume in enumerate(volumes):
            rows, columns = volume.shape[-2:]
            at = places.flatten(2).permute(2, 0, 1).unsqueeze(1) / 2**level + offsets
            # The last index as a value of the graph, or its sizes would be frozen to those of the export.
            span = torch.stack([torch.arange(n)[-1] for n in (columns, rows)]).to(places.dtype).clamp(min=1)
            read = F.grid_sample(volume, 2 * at / span - 1, align_corners=True)
            found.append(read.flatten(1).t().reshape(1, side * side, *places.shape[-2:]))
        return torch.cat(found, 1)

    def forward(self, older: Tensor, newer: Tensor) -> Tensor:
        older, newer = (2 * (image / 255) - 1 for image in (older, newer))
        features, others = self.fnet(older), self.fnet(newer)
        products = features.flatten(2).transpose(1, 2) @ others.flatten(2) / features.shape[1] ** 0.5
        volumes = [products.view(-1, 1, *others.shape[-2:])]
        for _ in range(LEVELS - 1):
            volumes.append(F.avg_pool2d(volumes[-1], 2))
        state, context = self.cnet(older).split([HIDDEN, CONTEXT], 1)
        state, context = torch.tanh(state), torch.relu(context)
        rows, columns = features.shape[-2:]
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        home = torch.stack([x, y]).to(features.dtype).unsqueeze(0)
        places = home
        for _ in range(self.iterations):
            correlation = self.look(volumes, places)
            moved = self.update_block.encoder(places - home, correlation)
            state = self.update_block.gru(state, torch.cat([context, moved], 1))
            places = places + self.update_block.flow_head(state)
        flow = places - home
        return EIGHTH * F.interpolate(flow, scale_factor=EIGHTH, mode="bilinear", align_corners=True)


def load(weights: str, iterations: int) -> RaftSmall:
    """The published weights; every one of them must fit."""
    network = RaftSmall(iterations).eval()
    state = torch.load(weights, map_location="cpu", weights_only=True)
    network.load_state_dict({name.removeprefix("module."): value for name, value in state.items()})
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
    print(f"{arguments.target}: {sum(p.numel() for p in network.parameters())} parameters, {arguments.iterations} iterations")


if __name__ == "__main__":
    main()
