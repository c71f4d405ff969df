"""RAFT-small (Teed and Deng 2020) for dark raw frames, behind the interface of the pyramid and the decoder.

Feature encoder, context encoder and recurrent update are the published ones, so that the published weights fit. Three
things differ:

* the flow is brought from an eighth to a quarter of the image by learned convex weights, which begin as the bilinear ones;
* a small head predicts the expected end-point error from the recurrent state, which it may not disturb;
* images are linear RGB of a mean of about 0.4, brought to the range of the published network by `2 x - 1`.

What concerns one frame alone (both encoders) is a graph of its own, so that a stream computes it once a frame.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

HIDDEN, CONTEXT, FEATURES, LEVELS, RADIUS = 96, 64, 128, 4, 3
SIDE = 2 * RADIUS + 1


def instance_norm(x: Tensor) -> Tensor:
    """Each channel to a mean of zero and a deviation of one. Where it is compiled it is written out, so that it is fused with
    what stands around it: the operator alone takes a CPU longer than the convolution before it."""
    if not torch.compiler.is_compiling():
        return F.instance_norm(x)
    centred = x.float() - x.float().mean((2, 3), keepdim=True)
    return (centred * torch.rsqrt(centred.square().mean((2, 3), keepdim=True) + 1e-5)).to(x.dtype)


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
        return instance_norm(x) if self.normed else x

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
        for number, (entering, width, stride) in enumerate(((32, 32, 1), (32, 64, 2), (64, 96, 2)), 1):
            units = [Bottleneck(entering, width, stride, normed), Bottleneck(width, width, 1, normed)]
            setattr(self, f"layer{number}", nn.Sequential(*units))
        self.conv2 = nn.Conv2d(96, leaving, 1)
        self.normed = normed

    def levels(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """A quarter [B, 64, H/4, W/4], and an eighth of `leaving` channels."""
        x = self.conv1(image)
        x = F.relu(instance_norm(x) if self.normed else x)
        quarter = self.layer2(self.layer1(x))
        return quarter, self.conv2(self.layer3(quarter))

    def forward(self, image: Tensor) -> Tensor:
        return self.levels(image)[1]


class Motion(nn.Module):
    """Correlations and flow become the recurrent unit's input."""

    def __init__(self):
        super().__init__()
        self.convc1 = nn.Conv2d(LEVELS * SIDE**2, 96, 1)
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


def bilinear_logits() -> Tensor:
    """Logits [4, 9] of the convex weights that are bilinear interpolation from an eighth to a quarter.

    Cell i of an eighth looks at pixel 8 i (the encoders' strides leave it there); cell j of a quarter stands for pixel
    4 j + 1.5, that is 0.1875 or 0.6875 of the way from one to the next.
    """
    along = torch.tensor([[1e-3, 0.8125, 0.1875], [1e-3, 0.3125, 0.6875]])
    weights = along[:, None, :, None] * along[None, :, None, :]
    return weights.reshape(4, 9).log()


class RaftSmall(nn.Module):
    """The whole. `iterations` is fixed when it is called or exported."""

    def __init__(self, iterations: int = 8):
        super().__init__()
        self.fnet, self.cnet = Encoder(FEATURES, normed=True), Encoder(HIDDEN + CONTEXT, normed=False)
        self.update_block = Update()
        self.enlarge = nn.Sequential(nn.Conv2d(HIDDEN, 64, 3, padding=1), nn.ReLU(), nn.Conv2d(64, 36, 1))
        self.error = nn.Sequential(nn.Conv2d(HIDDEN, 64, 3, padding=1), nn.ReLU(), nn.Conv2d(64, 4, 1))
        self.iterations = iterations
        with torch.no_grad():
            self.enlarge[-1].weight.zero_()
            self.enlarge[-1].bias.copy_(bilinear_logits().flatten())
            self.error[-1].weight.mul_(0.1)

    # New parts, which have all to learn.
    FAST = ("enlarge.", "error.")
    SLOW = ()

    def published(self, path) -> None:
        """Takes the published weights; every one of them must fit, and only the two new heads stay as they are."""
        state = torch.load(path, map_location="cpu", weights_only=True)
        missing, unknown = self.load_state_dict({n.removeprefix("module."): v for n, v in state.items()}, strict=False)
        if unknown or any(not name.startswith(("enlarge.", "error.")) for name in missing):
            raise ValueError(f"{path}: expected the weights of RAFT-small, {unknown} is unknown and {missing} is missing")

    @staticmethod
    def weighed(flows: list[Tensor]) -> list[tuple[Tensor, float]]:
        """Flows in pixels of the image with their weights in the loss: later iterations count more."""
        return [(flow, 0.8 ** (len(flows) - 1 - i)) for i, flow in enumerate(flows)]

    @staticmethod
    def truth(flow: Tensor, cell: int) -> Tensor:
        """The true flow's mean over cells of so many pixels."""
        return F.avg_pool2d(flow, cell)

    def frame(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """What is to be known of one frame: features to match [B, 128, h, w], and state and context [B, 160, h, w]."""
        image = 2 * image - 1
        return self.fnet(image), self.cnet(image)

    def look(self, volumes: list[Tensor], places: Tensor) -> Tensor:
        """Correlations around where each point went, [B, 196, h, w]; a volume is [B h w, 1, rows, columns]."""
        batch = places.shape[0]
        steps = torch.arange(-RADIUS, RADIUS + 1, dtype=places.dtype, device=places.device)
        # The published lookup runs through x in its outer loop and through y in its inner one.
        offsets = torch.stack([steps.repeat_interleave(SIDE), steps.repeat(SIDE)], 1).view(1, SIDE, SIDE, 2)
        found = []
        for level, volume in enumerate(volumes):
            rows, columns = volume.shape[-2:]
            at = places.permute(0, 2, 3, 1).reshape(-1, 1, 1, 2) / 2**level + offsets
            # Sizes as values of the graph, or they would be frozen to those of the export.
            size = torch.stack([torch.arange(n)[-1] + 1 for n in (columns, rows)]).to(places)
            read = F.grid_sample(volume, (2 * at + 1) / size - 1, align_corners=False)
            found.append(read.view(batch, *places.shape[-2:], SIDE * SIDE))
        return torch.cat(found, 3).permute(0, 3, 1, 2)

    def quarter(self, flow: Tensor, state: Tensor) -> Tensor:
        """Flow of an eighth [B, 2, h, w] as flow of a quarter [B, 2, 2h, 2w], in pixels of the image."""
        batch, _, rows, columns = flow.shape
        weights = self.enlarge(state).view(batch, 1, 4, 9, rows, columns).softmax(3)
        padded = F.pad(8 * flow, [1] * 4, mode="replicate")
        shifts = [(y, x) for y in range(3) for x in range(3)]
        around = torch.stack([padded[:, :, y : y + rows, x : x + columns] for y, x in shifts], 2).unsqueeze(2)
        return F.pixel_shuffle((weights * around).sum(3).flatten(1, 2), 2)

    def steps(self, older: Tensor, newer: Tensor, context: Tensor):
        """After each iteration the flow [B, 2, h, w] in pixels of an eighth, and the recurrent state."""
        batch, channels = older.shape[:2]
        products = older.flatten(2).transpose(1, 2) @ newer.flatten(2) / channels**0.5
        volumes = [products.view(-1, 1, *newer.shape[-2:])]
        for _ in range(LEVELS - 1):
            volumes.append(F.avg_pool2d(volumes[-1], 2))
        state, context = context.split([HIDDEN, CONTEXT], 1)
        state, context = torch.tanh(state), torch.relu(context)
        rows, columns = older.shape[-2:]
        y, x = torch.meshgrid(
            torch.arange(rows, device=older.device), torch.arange(columns, device=older.device), indexing="ij"
        )
        home = torch.stack([x, y]).to(older.dtype).unsqueeze(0)
        places = home.expand(batch, -1, -1, -1)
        for _ in range(self.iterations):
            places = places.detach()
            moved = self.update_block.encoder(places - home, self.look(volumes, places))
            state = self.update_block.gru(state, torch.cat([context, moved], 1))
            places = places + self.update_block.flow_head(state)
            yield places - home, state

    def pair(self, older, newer, context: Tensor):
        """Features of both frames and the older one's context to the flows [B, 2, H/4, W/4] after each iteration, in
        pixels of the image, and the expected end-point error [B, 1, H/4, W/4]. In evaluation only the last flow."""
        steps = list(self.steps(older, newer, context))
        flows = [self.quarter(*step) for step in (steps if self.training else steps[-1:])]
        state = steps[-1][1]
        expected = F.softplus(F.pixel_shuffle(self.error(state.detach()), 2)) + 0.01
        return flows, expected

    def forward(self, older: Tensor, newer: Tensor):
        """Both frames in one call of each encoder."""
        features = self.fnet(2 * torch.cat([older, newer]) - 1)
        first, second = features.chunk(2)
        return self.pair(first, second, self.cnet(2 * older - 1))
