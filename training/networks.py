"""PWC-Net "small" for dark raw frames, as a pyramid (once a frame) and a decoder (once a pair).

Layout as in Sun et al. 2018 without dense connections: cost volumes of +-4 from the coarsest level to level 2, a context
network at level 2. The coarsest level is a choice: 6 as published, or 4, which still reaches 64 px and is what a network
trained on small crops should have, since there levels 5 and 6 are a handful of cells. Three things differ, each because it lets a short training get somewhere:

* every level's features are normalised per frame (channel by channel, then pixel by pixel), so that the cost volume
  says something from the first step on;
* a level's flow is the coarser flow, doubled, plus a residual, in pixels of that level;
* the residual holds the soft arg-max of the cost volume, weighed by a gate: so the end-point loss reaches the features
  directly, not only through an untrained decoder.

A small head predicts the expected end-point error from the level-2 decoder features, which it may not disturb.
"""

import torch
import torch.nn.functional as F
from torch import nn

CHANNELS = (3, 16, 32, 64, 96, 128, 196)
DECODER_CHANNELS = (128, 128, 96, 64, 32)
CONTEXT = ((128, 1), (128, 2), (128, 4), (96, 8), (64, 16), (32, 1))
REACH = 4
SIDE = 2 * REACH + 1
# Columns a tile of the cost volume has; inputs are multiples of 64 wide, so these divide the levels' widths.
TILES = {2: 16, 3: 8}
IMAGE_MEAN = 0.4
LEVEL_WEIGHTS = {6: 0.25, 5: 0.25, 4: 0.4, 3: 0.5, 2: 1.0}


def conv(inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """A 3x3 convolution and a leaky ReLU of 0.1."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, padding=dilation, dilation=dilation),
        nn.LeakyReLU(0.1, inplace=True),
    )


def levels_from(coarsest: int) -> range:
    """Levels in the order of decoding, such as 6, 5, 4, 3, 2."""
    return range(coarsest, 1, -1)


def cost_volume_plain(older: torch.Tensor, newer: torch.Tensor) -> torch.Tensor:
    """Mean product of the features at every displacement of +-4: [B, 81, H, W], dy slow, dx fast. The definition."""
    height, width = older.shape[-2:]
    padded = F.pad(newer, [REACH] * 4)
    products = [
        (older * padded[:, :, dy : dy + height, dx : dx + width]).mean(1, keepdim=True)
        for dy in range(SIDE)
        for dx in range(SIDE)
    ]
    return torch.cat(products, 1)


def cost_volume(older: torch.Tensor, newer: torch.Tensor, tile: int | None) -> torch.Tensor:
    """The same in a dozen operations, for training and for the exported graph alike.

    Rows are cut into tiles of `tile` >= 8 columns (None: one tile, the whole row). Each tile is multiplied, as a
    matrix, with the nine rows around it and a halo of four columns; of the tile x (tile + 8) products the band of nine
    diagonals is wanted. Padding the flattened matrix by `tile` and folding it one column wider turns the diagonals
    into columns.
    """
    batch, channels, height, width = older.shape
    halo = 2 * REACH
    span = width if tile is None else tile
    rows = F.pad(newer, [REACH, REACH if tile is None else tile - REACH, REACH, REACH]).permute(0, 2, 3, 1)
    if tile is None:
        rows = rows.unsqueeze(2)
    else:
        chunks = rows.reshape(batch, height + halo, -1, tile, channels)
        rows = torch.cat([chunks[:, :, :-1], chunks[:, :, 1:, :halo]], 3)
    around = torch.stack([rows[:, dy : dy + height] for dy in range(SIDE)], 1)
    tiles = (older * (1.0 / channels)).permute(0, 2, 3, 1).reshape(batch, 1, height, -1, span, channels)
    products = torch.matmul(tiles, around.transpose(-1, -2))
    band = F.pad(products.flatten(-2), [0, span]).reshape(batch, SIDE, height, -1, span, span + halo + 1)[..., :SIDE]
    return band.permute(0, 1, 5, 2, 3, 4).reshape(batch, SIDE * SIDE, height, width)


def warp(features: torch.Tensor, flow: torch.Tensor) -> torch.Tensor:
    """Newer features [B, C, H, W] fetched to where the flow [B, 2, H, W] (pixels of this level) says they went."""
    height, width = features.shape[-2:]
    x = torch.arange(width, dtype=flow.dtype, device=flow.device).view(1, 1, width)
    y = torch.arange(height, dtype=flow.dtype, device=flow.device).view(1, height, 1)
    grid = torch.stack([(x + flow[:, 0] + 0.5) * (2.0 / width) - 1, (y + flow[:, 1] + 0.5) * (2.0 / height) - 1], -1)
    return F.grid_sample(features, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def normalised(features: torch.Tensor) -> torch.Tensor:
    """Each channel centred and scaled over the frame, then each pixel's vector brought to a deviation of one, in fp32.

    So the cost volume is close to a cosine. The 0.05 lets a flat neighbourhood keep a short vector.
    """
    wide = features.float()
    centred = wide - wide.mean((2, 3), keepdim=True)
    scaled = centred * torch.rsqrt(centred.square().mean((2, 3), keepdim=True) + 1e-6)
    return (scaled * torch.rsqrt(scaled.square().mean(1, keepdim=True) + 0.05)).to(features.dtype)


class Pyramid(nn.Module):
    """Image [B, 3, H, W] (linear RGB, mean about 0.4) to normalised features of level 2 to the coarsest."""

    def __init__(self, coarsest: int):
        super().__init__()
        channels = CHANNELS[: coarsest + 1]
        self.levels = nn.ModuleList(
            nn.Sequential(conv(i, o, stride=2), conv(o, o), conv(o, o)) for i, o in zip(channels, channels[1:])
        )

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        features, x = [], image - IMAGE_MEAN
        for level in self.levels:
            x = level(x)
            features.append(x)
        return tuple(normalised(f) for f in features[1:])


class LevelDecoder(nn.Module):
    """One level: cost volume, five convolutions, a residual flow in pixels of this level."""

    def __init__(self, level: int, coarsest: int):
        super().__init__()
        self.tile = TILES.get(level)
        above = 0 if level == coarsest else 2 + 2
        widths = (SIDE * SIDE + 2 + CHANNELS[level] + above, *DECODER_CHANNELS)
        self.body = nn.Sequential(*(conv(i, o) for i, o in zip(widths, widths[1:])))
        self.predict = nn.Conv2d(widths[-1], 3, 3, padding=1)
        self.up_features = nn.ConvTranspose2d(widths[-1], 2, 4, 2, 1) if level > 2 else None
        self.sharpness = nn.Parameter(torch.tensor(3.0))
        offsets = torch.arange(-REACH, REACH + 1, dtype=torch.float32)
        dy, dx = torch.meshgrid(offsets, offsets, indexing="ij")
        self.register_buffer("offsets", torch.stack([dx.flatten(), dy.flatten()])[:, :, None, None], persistent=False)

    def forward(self, older, newer, above):
        """Flow [B, 2, H, W] and body features; `above` is None or (flow, features) already at this level's size."""
        fetched = newer if above is None else warp(newer.float(), above[0]).to(newer.dtype)
        volume = cost_volume(older, fetched, self.tile)
        pooled = F.avg_pool2d(volume.float(), 3, 1, 1, count_include_pad=False)
        weights = torch.softmax(pooled * self.sharpness.exp(), 1)
        argmax = F.conv2d(weights, self.offsets)
        parts = [F.leaky_relu(volume, 0.1), argmax.to(volume.dtype), older]
        if above is not None:
            parts += [above[0].to(volume.dtype), above[1]]
        features = self.body(torch.cat(parts, 1))
        residual = self.predict(features).float()
        flow = residual[:, :2] + torch.sigmoid(residual[:, 2:]) * argmax
        return (flow if above is None else flow + above[0]), features


class Decoder(nn.Module):
    """Two frames' features to the flow from the older to the newer frame, and its expected error.

    Returns the flows from the coarsest level to level 2, each in pixels of its level, and the expected end-point error [B, 1, H/4, W/4] in
    pixels of the network's input.
    """

    def __init__(self, coarsest: int):
        super().__init__()
        self.coarsest = coarsest
        self.levels = nn.ModuleList(LevelDecoder(level, coarsest) for level in levels_from(coarsest))
        widths = (DECODER_CHANNELS[-1], *(c for c, _ in CONTEXT))
        self.context = nn.Sequential(
            *(conv(i, o, dilation=d) for i, (o, d) in zip(widths, CONTEXT)), nn.Conv2d(widths[-1], 2, 3, padding=1)
        )
        self.error = nn.Sequential(conv(DECODER_CHANNELS[-1], 32), nn.Conv2d(32, 1, 3, padding=1))

    def forward(self, older, newer):
        flows, above = [], None
        for level, decoder in zip(levels_from(self.coarsest), self.levels):
            flow, features = decoder(older[level - 2], newer[level - 2], above)
            if level > 2:
                up = 2.0 * F.interpolate(flow, scale_factor=2, mode="bilinear", align_corners=False)
                above = (up, decoder.up_features(features))
            else:
                flow = flow + self.context(features).float()
            flows.append(flow)
        expected = F.softplus(self.error(features.detach()).float()) + 0.01
        return flows, expected


class PwcNet(nn.Module):
    """Pyramid and decoder together, as they are trained."""

    # Scalars that have a long way to go.
    FAST = ("sharpness",)

    def __init__(self, coarsest: int = 6):
        super().__init__()
        self.pyramid, self.decoder = Pyramid(coarsest), Decoder(coarsest)
        for module in self.modules():
            if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
                nn.init.kaiming_normal_(module.weight, a=0.1)
                nn.init.zeros_(module.bias)
        with torch.no_grad():  # The residuals begin small, so that the soft arg-max leads.
            for last in [*(d.predict for d in self.decoder.levels), self.decoder.context[-1], self.decoder.error[-1]]:
                last.weight.mul_(0.1)
            for decoder in self.decoder.levels:
                decoder.predict.bias[2] = -1.5

    @staticmethod
    def weighed(flows: list[torch.Tensor]) -> list[tuple[torch.Tensor, float]]:
        """Flows in pixels of the image, from the coarsest level to level 2, with their weights in the loss."""
        levels = levels_from(len(flows) + 1)
        return [(flow * 2**level, LEVEL_WEIGHTS[level]) for level, flow in zip(levels, flows)]

    def forward(self, older: torch.Tensor, newer: torch.Tensor):
        """One shared pyramid call for both frames, then the decoder."""
        half = older.shape[0]
        features = self.pyramid(torch.cat([older, newer]))
        return self.decoder([f[:half] for f in features], [f[half:] for f in features])
