"""Brings PWC-Net's flow from its cells to every pixel, along the edges that the older frame shows.

A pixel's vector is a convex combination of those of the 5 x 5 cells around its own, as in RAFT (Teed and Deng 2020, 3.3, there 3 x 3);
but the weights are read from the frame, from how the cells' vectors differ and from the errors that they are expected to have, not
from the decoder's state, so that it is a graph of its own, which only those run who want a vector for every pixel. Bilinear
interpolation, which it begins as, draws every edge over two cells.
"""

import torch
import torch.nn.functional as F
from torch import nn

from networks import PwcNet, begin, conv

CELL = 4
REACH = 2
SIDE = 2 * REACH + 1
WIDTHS = (64, 64, 64)
# What the weights of bilinear interpolation are taken to be where they are zero, so that they can be learned.
LEAST = 3e-3
# Of pixels of 0 to 1 with a mean of about 0.4, for the convolutions.
FACTOR, OFFSET = 4.0, -1.6


def around(values: torch.Tensor, reach: int) -> torch.Tensor:
    """[B, C, H, W] to [B, side^2, C, H, W]: of every cell those around it, dy slow, dx fast; the edge is repeated."""
    height, width = values.shape[-2:]
    padded, side = F.pad(values, [reach] * 4, mode="replicate"), range(2 * reach + 1)
    return torch.stack([padded[:, :, dy : dy + height, dx : dx + width] for dy in side for dx in side], 1)


def bilinear() -> torch.Tensor:
    """[SIDE^2, CELL^2]: weights of the cells around a cell for its pixels, row by row."""
    centre = (torch.arange(CELL) + 0.5) / CELL - 0.5
    near = (1 - (centre[:, None] - torch.arange(-REACH, REACH + 1)).abs()).clamp(min=0)
    return torch.einsum("yk,xl->klyx", near, near).reshape(SIDE**2, CELL**2)


def asinh(values: torch.Tensor) -> torch.Tensor:
    """As `torch.asinh`, which does not become an ONNX operator."""
    size = values.abs()
    return values.sign() * torch.log(size + torch.sqrt(size * size + 1))


class Upsampler(nn.Module):
    """The older frame [B, 3, H, W], flow [B, 2, H/4, W/4] and its expected error [B, 1, H/4, W/4], both in pixels, to both at every
    pixel, [B, 2, H, W] and [B, 1, H, W]."""

    def __init__(self):
        super().__init__()
        # A cell's pixels, how its neighbours' vectors differ from its own, and its expected error.
        widths = (3 * CELL**2 + 2 * 8 + 1, *WIDTHS)
        dilations = (1, 1, 2)
        self.body = nn.Sequential(*(conv(i, o, d) for i, o, d in zip(widths, WIDTHS, dilations)))
        self.weights = nn.Conv2d(WIDTHS[-1], SIDE**2 * CELL**2, 1)
        begin(self.body)
        with torch.no_grad():
            self.weights.weight.normal_(0, 0.01)
            self.weights.bias.copy_((bilinear() + LEAST).log().flatten())

    def forward(self, image: torch.Tensor, flow: torch.Tensor, expected: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        near = around(flow, 1)
        others = torch.cat([near[:, :4], near[:, 5:]], 1) - flow[:, None]
        seen = [FACTOR * F.pixel_unshuffle(image, CELL) + OFFSET, asinh(others.flatten(1, 2)), torch.log(expected)]
        scores = self.weights(self.body(torch.cat(seen, 1))).float().unflatten(1, (SIDE**2, CELL**2))
        # A softmax in parts, which a runtime need not turn round for an axis that is not the last.
        weights = torch.exp(scores - scores.amax(1, keepdim=True))

        def mixed(values: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
            each = [(weights * of).sum(1) / weights.sum(1) for of in around(values, REACH).split(1, 2)]
            return F.pixel_shuffle(torch.cat(each, 1), CELL)

        # What is expected to be wrong shall not move the weights.
        return mixed(flow, weights), mixed(expected, weights.detach())


class Upsampled(PwcNet):
    """A PWC-Net that is as it is, and its upsampler, which is trained."""

    def __init__(self):
        super().__init__()
        self.upsampler = Upsampler()

    @staticmethod
    def weighed(flows: list[torch.Tensor]) -> list[tuple[torch.Tensor, float]]:
        """The one flow, in pixels of the image."""
        return [(flows[-1], 1.0)]

    def forward(self, older: torch.Tensor, newer: torch.Tensor):
        """The flow at every pixel and its expected error."""
        with torch.no_grad():
            flows, expected = super().forward(older, newer)
            flow, expected = CELL * flows[-1], (expected[-1] if self.training else expected).float()
        full, expected = self.upsampler(older, flow, expected)
        return [full], expected
