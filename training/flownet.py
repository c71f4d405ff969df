"""FlowNetS and FlowNetC (Dosovitskiy et al. 2015) for dark raw frames, as a pyramid (once a frame) and a decoder (once
a pair).

Layers, strides, skips and predictions are the published ones, with a share `width` of their channels. FlowNetS's first
layer looks at both frames at once, which is the sum of what each frame adds to it: so a frame's part is known before
its partner. FlowNetC's first three layers look at each frame alone. For few minutes of training five things differ:

* a frame is brought to a mean of zero and a deviation of one, and what FlowNetC correlates is normalised;
* FlowNetC correlates +-10 cells one by one, where the published one takes every second of +-20: as many channels, and
  motion of a few pixels is seen by more of them;
* what a level predicts begins as the enlarged flow of the level before, so that all levels refine from the first step;
* every level's truth is taken where its cells look, as in `networks.py`;
* a small head predicts the expected end-point error, which may not disturb the rest.
"""

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from networks import GAIN, cost_volume, normalised

# Predictions are in units of so many pixels. The published 20 makes a step of eight times the published rate too long.
UNIT = 5.0
REACH = 10
FINEST, COARSEST = 2, 6
# Of the mean error of levels 6...2: the published weights are of sums over cells, and say the same.
LEVEL_WEIGHTS = (0.25, 0.25, 0.25, 0.5, 1.0)
# Strides leave cell i of level n at pixel 2^n i; with the frame moved by so many pixels, at 2^n i + SHIFT.
SHIFT = 2
ERROR_CHANNELS = 32


def slim(width: float, published: int) -> int:
    """Channels for so many published ones: a multiple of 8, since a CPU takes eight at a time, and at least 16."""
    return max(16, 8 * round(published * width / 8))


def conv(inputs: int, outputs: int, stride: int = 1, size: int = 3) -> nn.Sequential:
    """A convolution and a leaky ReLU of 0.1."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, size, stride, size // 2), nn.LeakyReLU(0.1, inplace=True))


def even(image: Tensor) -> Tensor:
    """A frame [B, 3, H, W] with each colour at a mean of zero and all at a deviation of one, moved by SHIFT."""
    centred = image - image.mean((2, 3), keepdim=True)
    scaled = centred * torch.rsqrt(centred.square().mean((1, 2, 3), keepdim=True) + 1e-4)
    return F.pad(scaled, [-SHIFT, SHIFT] * 2)


class Decoder(nn.Module):
    """From level 3 down to level 6 and back up to level 2; the published networks have this part in common.

    Returns the flows of levels 6...2, all in pixels of the network's input, and the expected end-point error
    [B, 1, H/4, W/4], also in those.
    """

    def __init__(self, eighth: int, channels: Callable[[int], int]):
        super().__init__()
        skips = {2: channels(128), 3: channels(256), 4: channels(512), 5: channels(512), 6: channels(1024)}
        rising = {5: channels(512), 4: channels(256), 3: channels(128), 2: channels(64)}
        self.contract = nn.ModuleDict({"3": conv(eighth, skips[3])})
        for level in range(4, COARSEST + 1):
            above, here = skips[level - 1], skips[level]
            self.contract[str(level)] = nn.Sequential(conv(above, here, 2), conv(here, here))
        self.predict, self.deconv, self.enlarge = nn.ModuleDict(), nn.ModuleDict(), nn.ModuleDict()
        known = skips[COARSEST]
        for level in range(COARSEST, FINEST - 1, -1):
            if level < COARSEST:
                up = nn.ConvTranspose2d(known, rising[level], 4, 2, 1)
                self.deconv[str(level)] = nn.Sequential(up, nn.LeakyReLU(0.1, inplace=True))
                self.enlarge[str(level)] = nn.ConvTranspose2d(2, 2, 4, 2, 1)
                known = skips[level] + rising[level] + 2
            self.predict[str(level)] = nn.Conv2d(known, 2, 3, padding=1)
        self.error = nn.Sequential(conv(known, ERROR_CHANNELS), nn.Conv2d(ERROR_CHANNELS, 1, 3, padding=1))

    def begin(self) -> None:
        """Weights to begin with. Cell 2 i looks where cell i of the level before does, the next one between two."""
        for part in self.modules():
            if isinstance(part, nn.Conv2d):
                nn.init.kaiming_normal_(part.weight, a=0.1)
                nn.init.zeros_(part.bias)
            if isinstance(part, nn.ConvTranspose2d):  # Of 16 weights a cell sees four.
                nn.init.kaiming_normal_(part.weight, a=0.1, mode="fan_out")
                part.weight.data.mul_(2.0)
                nn.init.zeros_(part.bias)
        with torch.no_grad():
            self.error[-1].weight.mul_(0.1)
            for level, predict in self.predict.items():
                predict.weight.mul_(0.1)
                if level in self.enlarge:
                    predict.weight[:, -2:, 1, 1] = torch.eye(2)
                    along = torch.tensor([0.5, 1.0, 0.5, 0.0])
                    self.enlarge[level].weight.copy_(torch.eye(2)[..., None, None] * torch.outer(along, along))

    def refined(self, quarter: Tensor, eighth: Tensor) -> tuple[list[Tensor], Tensor]:
        """From the features of levels 2 and 3 to flows and expected error."""
        seen = {"2": quarter}
        for level, contract in self.contract.items():
            seen[level] = eighth = contract(eighth)
        known, flows = eighth, []
        for level, predict in self.predict.items():
            if flows:
                known = torch.cat([seen[level], self.deconv[level](known), self.enlarge[level](flow)], 1)
            flow = predict(known)
            flows.append(UNIT * flow.float())
        return flows, F.softplus(self.error(known.detach()).float()) + 0.01


class SumDecoder(Decoder):
    """FlowNetS: what both frames add to the first layer [B, channels, H/2, W/2] becomes flow."""

    def __init__(self, channels: Callable[[int], int]):
        super().__init__(channels(256), channels)
        self.conv2 = conv(channels(64), channels(128), 2, 5)
        self.conv3 = conv(channels(128), channels(256), 2, 5)
        self.begin()

    def forward(self, first: Tensor, second: Tensor):
        quarter = self.conv2(F.leaky_relu(first + second, 0.1))
        return self.refined(quarter, self.conv3(quarter))


class CorrelationDecoder(Decoder):
    """FlowNetC: level 2 of the older frame, and level 3 of both, normalised, become flow."""

    def __init__(self, channels: Callable[[int], int]):
        redirected = channels(32)
        super().__init__((2 * REACH + 1) ** 2 + redirected, channels)
        self.redirect = nn.Sequential(nn.Conv2d(channels(256), redirected, 1), nn.LeakyReLU(0.1, inplace=True))
        self.begin()

    def forward(self, quarter: Tensor, older: Tensor, newer: Tensor):
        correlation = F.leaky_relu(GAIN * cost_volume(older, newer, None, REACH), 0.1)
        return self.refined(quarter, torch.cat([self.redirect(older), correlation], 1))


class SumPyramid(nn.Module):
    """What a frame adds to FlowNetS's first layer as a pair's first and as its second, [B, channels, H/2, W/2] each."""

    def __init__(self, channels: Callable[[int], int]):
        super().__init__()
        self.first = nn.Conv2d(3, channels(64), 7, 2, 3)
        self.second = nn.Conv2d(3, channels(64), 7, 2, 3, bias=False)
        for half in (self.first, self.second):  # As one layer over six colours would begin.
            nn.init.kaiming_normal_(half.weight, a=0.1)
            half.weight.data.mul_(0.5**0.5)
        nn.init.zeros_(self.first.bias)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        image = even(image)
        return self.first(image), self.second(image)


class CorrelationPyramid(nn.Module):
    """FlowNetC's layers of one frame: level 2 [B, channels, H/4, W/4], normalised level 3 [B, channels, H/8, W/8]."""

    def __init__(self, channels: Callable[[int], int]):
        super().__init__()
        self.conv1 = conv(3, channels(64), 2, 7)
        self.conv2 = conv(channels(64), channels(128), 2, 5)
        self.conv3 = conv(channels(128), channels(256), 2, 5)
        for layer in (self.conv1, self.conv2, self.conv3):
            nn.init.kaiming_normal_(layer[0].weight, a=0.1)
            nn.init.zeros_(layer[0].bias)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        quarter = self.conv2(self.conv1(even(image)))
        return quarter, normalised(self.conv3(quarter))


class FlowNet(nn.Module):
    """What training asks of both."""

    FAST = SLOW = ()

    def published(self, path) -> None:
        """There is nothing to take."""
        raise ValueError(
            f"{path}: the published weights of {type(self).__name__} are for research alone and not taken; "
            "leave `start` out, or name graphs of such a network"
        )

    @staticmethod
    def weighed(flows: list[Tensor]) -> list[tuple[Tensor, float]]:
        """Flows in pixels of the image, from level 6 to level 2, with their weights in the loss."""
        return list(zip(flows, LEVEL_WEIGHTS))

    @staticmethod
    def truth(flow: Tensor, cell: int) -> Tensor:
        """The true flow's mean over as many pixels around where a cell looks, at level 2 over the raster's own cell."""
        before = cell // 2 - SHIFT
        return F.avg_pool2d(F.pad(flow, [before, 0, before, 0], mode="replicate"), cell)


class FlowNetS(FlowNet):
    """Both frames side by side, and what to do with them is learned."""

    # Of a frame, and what of which frame goes on; names are those of the graphs.
    features = ["first_level1", "second_level1"]
    reads = ["older_first_level1", "newer_second_level1"]

    def __init__(self, width: float = 0.25):
        super().__init__()
        channels = partial(slim, width)
        self.pyramid, self.decoder = SumPyramid(channels), SumDecoder(channels)

    def forward(self, older: Tensor, newer: Tensor):
        """Each frame's own half of the first layer alone, then the rest."""
        return self.decoder(self.pyramid.first(even(older)), self.pyramid.second(even(newer)))


class FlowNetC(FlowNet):
    """Each frame alone up to level 3, whose features are correlated."""

    features = ["skip_level2", "match_level3"]
    reads = ["older_skip_level2", "older_match_level3", "newer_match_level3"]

    def __init__(self, width: float = 0.25):
        super().__init__()
        channels = partial(slim, width)
        self.pyramid, self.decoder = CorrelationPyramid(channels), CorrelationDecoder(channels)

    def forward(self, older: Tensor, newer: Tensor):
        """Both frames in one call of the pyramid, then the decoder."""
        quarter, eighth = self.pyramid(torch.cat([older, newer]))
        return self.decoder(quarter.chunk(2)[0], *eighth.chunk(2))


KINDS = {"flownets": FlowNetS, "flownetc": FlowNetC}
