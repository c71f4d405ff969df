"""PWC-Net for dark raw frames, as a pyramid (once a frame) and a decoder (once a pair).

Pyramid, warping and cost volume of +-4 from coarse to fine as in Sun et al. 2018. It is made for few minutes of training, so
that four things differ:

* the frame's features are those of RAFT-small's encoder (Teed and Deng 2020), whose published weights it may start from: an
  eighth of the image is what is matched, averaged to a 16th and a 32nd, and a quarter is projected from the layer before;
* one decoder serves levels 5, 4 and 3, the last of them twice (Hur and Roth 2019), so that every step of training teaches it
  four times; level 2 has a narrow one of its own, which looks +-2 around;
* a level's flow is the coarser flow, doubled, plus a residual, in pixels of that level;
* the residual holds the soft arg-max of the cost volume, weighed by a gate: so the end-point loss reaches the features
  directly, not only through an untrained decoder.

Small heads predict the expected end-point error, which may not disturb the rest. `quality` "fast" ends at level 3.
"""

import itertools

import torch
import torch.nn.functional as F
from torch import nn

from raft import FEATURES, Encoder

COARSEST, FINEST_SHARED = 5, 3
# How often the shared decoder looks at each level.
LOOKS = {5: 1, 4: 1, 3: 2}
QUARTER, CONTEXT_CHANNELS = 32, 64
DECODER_CHANNELS = (128, 128, 96, 64, 32)
NARROW_CHANNELS = (64, 64, 32)
CONTEXT = ((64, 1), (64, 2), (64, 4), (64, 8), (32, 1))
REACH, NARROW_REACH = 4, 2
# The cost volume is a mean of products of unit deviation; the convolutions want it larger.
GAIN = 4.0
# Flow is of the size of a cost volume's reach, and larger at large motion only.
FLOW_GAIN = 0.25
# Inputs are multiples of this in both directions: the coarsest level has whole cells.
STRIDE = 2**COARSEST
# Columns a tile of the cost volume has. They divide the levels' widths where an input is a multiple of 64 wide; elsewhere a
# row is filled up.
TILES = {2: 16, 3: 8}
LEVEL_WEIGHTS = (0.2, 0.3, 0.4, 0.6, 1.0)
# The encoder's cell i of level n looks at pixel 2^n i; with the frame moved by so many pixels, at 2^n i + SHIFT.
SHIFT = 2
# What the encoder sees of an image of 0 to 1.
FACTOR, OFFSET = 2.0, -1.0


def conv(inputs: int, outputs: int, dilation: int = 1, size: int = 3) -> nn.Sequential:
    """A convolution and a leaky ReLU of 0.1."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, padding=dilation * (size // 2), dilation=dilation),
        nn.LeakyReLU(0.1, inplace=True),
    )


def begin(*modules: nn.Module) -> None:
    """Weights to begin with, of their convolutions."""
    for module in modules:
        for part in module.modules():
            if isinstance(part, nn.Conv2d):
                nn.init.kaiming_normal_(part.weight, a=0.1)
                nn.init.zeros_(part.bias)


def through(layers: nn.Module, parts: list[torch.Tensor]) -> torch.Tensor:
    """Layers that read several tensors as one. One operator in the bf16 graph of export.py."""
    return layers(parts[0] if len(parts) == 1 else torch.cat(parts, 1))


def cost_volume_plain(older: torch.Tensor, newer: torch.Tensor, reach: int = REACH) -> torch.Tensor:
    """Mean product of the features at every displacement of +-reach: [B, side^2, H, W], dy slow, dx fast. The definition."""
    height, width = older.shape[-2:]
    padded, side = F.pad(newer, [reach] * 4), 2 * reach + 1
    products = [
        (older * padded[:, :, dy : dy + height, dx : dx + width]).mean(1, keepdim=True)
        for dy in range(side)
        for dx in range(side)
    ]
    return torch.cat(products, 1)


def cost_volume(older: torch.Tensor, newer: torch.Tensor, tile: int | None, reach: int = REACH) -> torch.Tensor:
    """The same in a dozen operations, for training and for the exported graph alike.

    Rows are cut into tiles of `tile` >= 2 reach columns (None: one tile, the whole row). Each tile is multiplied, as a
    matrix, with the rows around it and a halo of `reach` columns; of the tile x (tile + 2 reach) products the band of
    2 reach + 1 diagonals is wanted. Padding the flattened matrix by `tile` and folding it one column wider turns the
    diagonals into columns. A row that is no whole number of tiles is filled up with zeros, and what they give is cut off.
    """
    batch, channels, height, width = older.shape
    halo = 2 * reach
    side = halo + 1
    span = width if tile is None else tile
    beyond = 0 if tile is None else -width % tile
    # A traced graph serves every width, not only the one that it is traced at.
    whole = tile is None or not (torch.jit.is_tracing() or beyond)
    rows = F.pad(newer, [reach, reach if tile is None else tile - reach + beyond, reach, reach]).permute(0, 2, 3, 1)
    if tile is None:
        rows = rows.unsqueeze(2)
    else:
        chunks = rows.reshape(batch, height + halo, -1, tile, channels)
        rows = torch.cat([chunks[:, :, :-1], chunks[:, :, 1:, :halo]], 3)
    around = torch.stack([rows[:, dy : dy + height] for dy in range(side)], 1)
    scaled = older * (1.0 / channels)
    filled = scaled if whole else F.pad(scaled, [0, beyond])
    tiles = filled.permute(0, 2, 3, 1).reshape(batch, 1, height, -1, span, channels)
    products = torch.matmul(tiles, around.transpose(-1, -2))
    band = F.pad(products.flatten(-2), [0, span]).reshape(batch, side, height, -1, span, span + halo + 1)[..., :side]
    volume = band.permute(0, 1, 5, 2, 3, 4).reshape(batch, side * side, height, width + beyond)
    return volume if whole else volume[..., :width]


def columns(level: int, device: torch.device) -> int | None:
    """Columns of a tile at a level. A GPU takes a row as one: it would rather multiply more than be given many small matrices."""
    return None if device.type == "cuda" else TILES.get(level)


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


def halved(values: torch.Tensor) -> torch.Tensor:
    """Means of 2x2 cells."""
    return F.avg_pool2d(values, 2)


def twice(values: torch.Tensor) -> torch.Tensor:
    """[B, C, h, w] of level 3, whose cell i looks at pixel 8 i + SHIFT, for level 2, whose cell j looks at 4 j + SHIFT:
    every second cell is a coarser one, and those between are the mean of their neighbours."""
    for dim in (2, 3):
        following = torch.cat([values.narrow(dim, 1, values.shape[dim] - 1), values.narrow(dim, values.shape[dim] - 1, 1)], dim)
        values = torch.stack([values, 0.5 * (values + following)], dim + 1).flatten(dim, dim + 1)
    return values


def doubled(values: torch.Tensor) -> torch.Tensor:
    """Bilinear: a cell becomes four, each with a quarter of its area."""
    return F.interpolate(values, scale_factor=2, mode="bilinear", align_corners=False)


def resized(rule, *values: torch.Tensor, gains: tuple[float, ...] | None = None) -> tuple[torch.Tensor, ...]:
    """Each of the values by a rule (`halved`, `doubled` or `twice`), then multiplied with its gain, if there are any. One operator
    in the fused graphs of export.py."""
    found = tuple(rule(value) for value in values)
    return tuple(gain * value if gain != 1 else value for gain, value in zip(gains or [1] * len(found), found))


class Pyramid(nn.Module):
    """Image [B, 3, H, W] (linear RGB, mean about 0.4) to what is to be known of one frame: features to match at level 2
    [B, 32, H/4, W/4] and 3 [B, 128, H/8, W/8], and context at level 3 [B, 64, H/8, W/8]."""

    def __init__(self):
        super().__init__()
        self.encoder = Encoder(FEATURES, normed=True)
        self.quarter = nn.Conv2d(64, QUARTER, 1)
        self.context = conv(FEATURES, CONTEXT_CHANNELS, size=1)
        # What export.py exchanges for operators of the node's own.
        self.normalised = normalised

    def levels(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The encoder's levels of the image as it sees it: projected at a quarter, as it is and projected at an eighth."""
        quarter, eighth = self.encoder.levels(F.pad(FACTOR * image + OFFSET, [-SHIFT, SHIFT] * 2))
        return self.quarter(quarter), eighth, self.context(eighth)

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        quarter, eighth, context = self.levels(image)
        return self.normalised(quarter), self.normalised(eighth), context


class LevelDecoder(nn.Module):
    """Cost volume, convolutions, a residual flow in pixels of this level.

    A `dense` one is as Sun et al. 2018 have it: every convolution of its body, and the one that predicts, reads all that there
    is before it, first what the body reads and then what its convolutions gave, in their order. What it passes on upward is
    the last convolution's output alone, so that all around it is shaped as without.
    """

    def __init__(self, reach: int, context: int, above: int, widths: tuple[int, ...], dense: bool = False):
        super().__init__()
        side = 2 * reach + 1
        self.reach, self.dense = reach, dense
        widths = (side * side + 2 + context + 2 + above, *widths)
        # What each convolution reads, and what the prediction does.
        read = list(itertools.accumulate(widths)) if dense else widths
        self.body = nn.Sequential(*(conv(i, o) for i, o in zip(read, widths[1:])))
        self.predict = nn.Conv2d(read[-1], 3, 3, padding=1)
        self.sharpness = nn.Parameter(torch.tensor(3.0))
        offsets = torch.arange(-reach, reach + 1, dtype=torch.float32)
        dy, dx = torch.meshgrid(offsets, offsets, indexing="ij")
        self.register_buffer("offsets", torch.stack([dx.flatten(), dy.flatten()]), persistent=False)

    def match(self, older, newer, flow, tile, fetch):
        """GAIN times the cost volume around the flow, its soft arg-max, and the flow as the convolutions read it. One operator in
        the fused graphs of export.py."""
        fetched = warp(newer.float(), flow).to(newer.dtype) if fetch else newer
        volume = cost_volume(older, fetched, tile, self.reach)
        pooled = F.avg_pool2d(volume.float(), 3, 1, 1, count_include_pad=False)
        weights = torch.softmax(pooled * self.sharpness.exp(), 1)
        return volume * GAIN, torch.einsum("bdyx,cd->bcyx", weights, self.offsets), FLOW_GAIN * flow

    def layers(self, parts):
        """The residual in fp32, and the body's features. One operator in the fused graphs of export.py."""
        if self.dense:
            for layer in self.body:
                parts = [*parts, through(layer, parts)]
            return through(self.predict, parts).float(), parts[-1]
        features = through(self.body, parts)
        return self.predict(features).float(), features

    def moved(self, flow, residual, argmax):
        """The flow after a look. One operator in the fused graphs of export.py."""
        return flow + residual[:, :2] + torch.sigmoid(residual[:, 2:]) * argmax

    def forward(self, older, newer, context, flow, above, tile, fetch=True):
        """Flow [B, 2, H, W] and body features, from those of the level above at this level's size."""
        volume, argmax, read = self.match(older, newer, flow, tile, fetch)
        residual, features = self.layers([volume, argmax.to(volume.dtype), context, read.to(volume.dtype), above])
        return self.moved(flow, residual, argmax), features


def error_head() -> nn.Sequential:
    """Body features to what softplus makes an expected error of."""
    return nn.Sequential(conv(DECODER_CHANNELS[-1], 32), nn.Conv2d(32, 1, 3, padding=1))


class Decoder(nn.Module):
    """Two frames' features to the flow from the older to the newer frame, and its expected error.

    Returns the flows from the coarsest level on, each in pixels of its level, and the expected end-point error
    [B, 1, H/4, W/4] in pixels of the network's input. The last flow is at level 2, also of the fast one. In training
    the expected errors are a list, of the last two flows at their own levels.
    """

    def __init__(self, dense: bool = False):
        super().__init__()
        self.shared = LevelDecoder(REACH, CONTEXT_CHANNELS, DECODER_CHANNELS[-1], DECODER_CHANNELS, dense)
        widths = (DECODER_CHANNELS[-1] + 2, *(c for c, _ in CONTEXT))
        self.context = nn.Sequential(
            *(conv(i, o, dilation=d) for i, (o, d) in zip(widths, CONTEXT)), nn.Conv2d(widths[-1], 2, 3, padding=1)
        )
        self.fine = LevelDecoder(NARROW_REACH, QUARTER, DECODER_CHANNELS[-1], NARROW_CHANNELS, dense)
        self.error, self.fast_error = error_head(), error_head()
        # What export.py exchanges for operators of the node's own, or for ONNX's that PyTorch does not have.
        self.through, self.resized = through, resized

    def forward(self, older, newer, fast: bool = False):
        matched = {3: (older[1], newer[1], older[2])}
        for level in range(FINEST_SHARED + 1, COARSEST + 1):
            matched[level] = self.resized(halved, *matched[level - 1])
        coarse = matched[COARSEST][0]
        flow, above = torch.zeros_like(coarse[:, :2]).float(), torch.zeros_like(coarse[:, : DECODER_CHANNELS[-1]])
        flows = []
        for level, looks in LOOKS.items():
            if level < COARSEST:
                flow, above = self.resized(doubled, flow, above, gains=(2.0, 1.0))
            for _ in range(looks):
                fetch = len(flows) > 0
                flow, above = self.shared(*matched[level], flow, above, columns(level, flow.device), fetch)
                flows.append(flow)
        flows[-1] = flow = flow + self.through(self.context, [above, (FLOW_GAIN * flow).to(above.dtype)]).float()
        coarser = F.softplus(self.through(self.fast_error, [above.detach()]).float()) + 0.01 if fast or self.training else None
        if fast:
            flow, expected = self.resized(twice, flow, coarser, gains=(2.0, 1.0))
            return [*flows, flow], expected
        flow, above = self.resized(twice, flow, above, gains=(2.0, 1.0))
        flow, features = self.fine(older[0], newer[0], older[0], flow, above, columns(2, flow.device))
        expected = F.softplus(self.through(self.error, [features.detach()]).float()) + 0.01
        return [*flows, flow], [coarser, expected] if self.training else expected


class PwcNet(nn.Module):
    """Pyramid and decoder together, as they are trained; with `dense` connections in the levels' decoders if so wanted."""

    # Scalars that have a long way to go.
    FAST = ("sharpness",)
    # Published weights, which need no more than a touch.
    SLOW = ("pyramid.encoder.",)

    def __init__(self, fast: bool = False, dense: bool = False):
        super().__init__()
        self.fast = fast
        self.pyramid, self.decoder = Pyramid(), Decoder(dense)
        begin(self.pyramid.quarter, self.pyramid.context, self.decoder)
        decoder = self.decoder
        with torch.no_grad():  # The residuals begin small, so that the soft arg-max leads.
            for last in (decoder.shared.predict, decoder.fine.predict, decoder.context[-1], decoder.error[-1], decoder.fast_error[-1]):
                last.weight.mul_(0.1)
            for level in (decoder.shared, decoder.fine):
                level.predict.bias[2] = -1.5

    def published(self, path) -> None:
        """Takes the encoder's published weights; every one of them must fit."""
        state = torch.load(path, map_location="cpu", weights_only=True)
        encoder = {n.removeprefix("module.fnet."): v for n, v in state.items() if n.startswith("module.fnet.")}
        self.pyramid.encoder.load_state_dict(encoder)

    @staticmethod
    def weighed(flows: list[torch.Tensor]) -> list[tuple[torch.Tensor, float]]:
        """Flows in pixels of the image, from the coarsest level to level 2, with their weights in the loss."""
        levels = [level for level, looks in LOOKS.items() for _ in range(looks)] + [2]
        return [(flow * 2**level, weight) for level, flow, weight in zip(levels, flows, LEVEL_WEIGHTS)]

    @staticmethod
    def truth(flow: torch.Tensor, cell: int) -> torch.Tensor:
        """The true flow [B, 2, H, W] where cells of so many pixels look: around pixel cell * i + SHIFT, at level 2 its mean
        over the cell, which is what the node's raster says."""
        before = SHIFT if cell >= 2**FINEST_SHARED else 0
        return F.avg_pool2d(F.pad(flow, [before, 0, before, 0], mode="replicate"), cell)

    def forward(self, older: torch.Tensor, newer: torch.Tensor):
        """One shared pyramid call for both frames, then the decoder."""
        half = older.shape[0]
        features = self.pyramid(torch.cat([older, newer]))
        return self.decoder([f[:half] for f in features], [f[half:] for f in features], self.fast)
