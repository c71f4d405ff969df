"""Synthetic scenes with exact flow: photographs as textures on moving planes and on cut-out shapes.

Every layer is a plane whose motion is a homography M from frame 1 to frame 2 (pixels), so the flow is M x - x without
approximation. Displacements are drawn from a mixture with much weight on small ones, since a drone at 30 Hz sees
mostly 0...8 px at 320x256.
"""

import math
import sys
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

SIDE = 512
HELD_OUT = 20
# Least mean step between every fourth row of a window, in 1/255.
DULL = 8.0
THIN = 4
# How many cut-out shapes a scene has at most; each is there three times in four.
SHAPES = 5
# Share, least and greatest typical displacement in pixels.
MIXTURE = ((0.05, 0.0, 0.0), (0.40, 0.2, 4.0), (0.35, 4.0, 12.0), (0.20, 12.0, 28.0))


def pack(photographs: Path, target: Path) -> None:
    """Squares of 512 px from every photograph, in a fixed order; the last 20 photographs are held out."""
    files = sorted(photographs.glob("*.jpg"))
    # A fixed shuffle, so that what is held out is not all from one source.
    order = np.random.default_rng(5).permutation(len(files))
    squares, owners = [], []
    for rank, index in enumerate(order):
        image = Image.open(files[index]).convert("RGB")
        scale = SIDE / min(image.size)
        image = image.resize([max(SIDE, round(s * scale)) for s in image.size], Image.LANCZOS)
        pixels = np.asarray(image)
        height, width = pixels.shape[:2]
        wide = max(height, width) > 1.3 * SIDE
        down, right = height - SIDE, width - SIDE
        for y, x in [(0, 0), (down, right)] if wide else [(down // 2, right // 2)]:
            squares.append(pixels[y : y + SIDE, x : x + SIDE])
            owners.append(rank)
    np.savez(target, squares=np.stack(squares), owners=np.array(owners), names=[files[i].name for i in order])


class Textures:
    """Random windows out of the packed photographs, on the default device."""

    def __init__(self, packed: Path, held_out: bool):
        with np.load(packed) as file:
            held = file["owners"] >= file["owners"].max() + 1 - HELD_OUT
            self.squares = torch.as_tensor(file["squares"][held == held_out], device=torch.get_default_device())
        # A GPU fetches words much faster than triples of bytes.
        self.words = F.pad(self.squares, (0, 1)).view(torch.int32).flatten() if self.squares.is_cuda else None
        thin = self.squares[:, ::THIN, ::THIN].float()
        steps = (thin[:, 1:] - thin[:, :-1]).abs().mean(3)
        # Sums over all rectangles that begin at the corner, so that a window's mean step is four look-ups.
        self.steps = F.pad(steps.double().cumsum(1).cumsum(2), (1, 0, 1, 0)).float()

    def draw(self, batch: int, side: int) -> torch.Tensor:
        """[B, 3, side, side] in 0...1, with random mirror images.

        Skies and gradients teach little: most of them are drawn again, three times at most. All four tries are drawn
        at once, and nothing is read back from the device.
        """
        which = torch.randint(len(self.squares), (batch, 4))
        y, x = torch.randint(SIDE - side + 1, (2, batch, 4))
        rows, columns = (y // THIN).clamp(max=self.steps.shape[1] - 1 - side // THIN), x // THIN
        below, right = rows + side // THIN, columns + side // THIN
        corner = lambda at_y, at_x: self.steps[which, at_y, at_x]
        total = corner(below, right) - corner(rows, right) - corner(below, columns) + corner(rows, columns)
        lively = (total / (side // THIN) ** 2 > DULL) | (torch.rand(batch, 4) < 0.1)
        lively[:, 3] = True
        taken = lively.float().argmax(1)[:, None]
        which, y, x = (drawn.gather(1, taken)[:, 0] for drawn in (which, y, x))
        mirrored = torch.rand(batch) < 0.5
        if self.words is not None:
            along = torch.arange(side)
            columns = torch.where(mirrored[:, None], x[:, None] + side - 1 - along, x[:, None] + along)
            index = (which[:, None, None] * SIDE + (y[:, None] + along)[:, :, None]) * SIDE + columns[:, None]
            windows = self.words[index][..., None].view(torch.uint8)[..., :3]
        else:
            places = zip(which.tolist(), y.tolist(), x.tolist(), mirrored.tolist())
            cut = [(self.squares[n, j : j + side, i : i + side], flip) for n, j, i, flip in places]
            windows = torch.stack([window.flip(1) if flip else window for window, flip in cut])
        return windows.permute(0, 3, 1, 2).float().div_(255)


def uniform(batch: int, low: float, high: float) -> torch.Tensor:
    """[B] drawn evenly."""
    return low + (high - low) * torch.rand(batch)


def magnitudes(batch: int, mixture) -> torch.Tensor:
    """[B] typical displacement of a scene in pixels, from the mixture."""
    shares = torch.tensor([share for share, _, _ in mixture])
    bounds = torch.tensor([bounds for _, *bounds in mixture])[torch.multinomial(shares, batch, replacement=True)]
    return bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) * torch.rand(batch)


def homographies(magnitude, centre_x, centre_y, size: float) -> torch.Tensor:
    """[B, 3, 3] about a centre: a shift of about `magnitude`, and turn, zoom, shear and tilt that move a point `size`
    away by a like amount."""
    batch = len(magnitude)
    angle = uniform(batch, 0, 2 * math.pi)
    shift = magnitude * uniform(batch, 0.2, 1.0)
    rate = (magnitude / size).clamp(max=0.35)
    turn, zoom, shear = (torch.randn(batch) * rate * s for s in (0.35, 0.35, 0.12))
    tilt = torch.randn(batch, 2) * (rate / size * 0.2)[:, None]
    scale = torch.exp(zoom)
    rows = [
        *(scale * torch.cos(turn), -scale * torch.sin(turn) + shear, shift * torch.cos(angle)),
        *(scale * torch.sin(turn), scale * torch.cos(turn), shift * torch.sin(angle)),
        *(tilt[:, 0], tilt[:, 1], torch.ones(batch)),
    ]
    core = torch.stack(rows, -1).view(batch, 3, 3)
    return _shifts(centre_x, centre_y) @ core @ _shifts(-centre_x, -centre_y)


def _shifts(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    matrix = torch.eye(3).repeat(len(x), 1, 1)
    matrix[:, 0, 2], matrix[:, 1, 2] = x, y
    return matrix


def mapped(matrix: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Homography [B, 3, 3] applied to points [B or 1, 2, H, W]."""
    m = matrix[..., None, None]
    x, y = points[:, 0], points[:, 1]
    depth = (m[:, 2, 0] * x + m[:, 2, 1] * y + m[:, 2, 2]).clamp(min=0.2)
    return torch.stack(
        [
            (m[:, 0, 0] * x + m[:, 0, 1] * y + m[:, 0, 2]) / depth,
            (m[:, 1, 0] * x + m[:, 1, 1] * y + m[:, 1, 2]) / depth,
        ],
        1,
    )


def inverse(matrix: torch.Tensor) -> torch.Tensor:
    """[B, 3, 3]; homographies this mild have one, and asking the device whether they do would mean waiting for it."""
    return torch.linalg.inv_ex(matrix).inverse


class Surface:
    """A photograph on a plane: how frame-1 pixels fall on the texture."""

    def __init__(self, texture: torch.Tensor, height: int, width: int):
        batch, self.texture, side = len(texture), texture, texture.shape[-1]
        zoom, turn = torch.exp(uniform(batch, math.log(0.5), math.log(1.8))), torch.randn(batch) * 0.5
        matrix = torch.eye(3).repeat(batch, 1, 1)
        matrix[:, 0, 0] = matrix[:, 1, 1] = zoom * torch.cos(turn)
        matrix[:, 1, 0], matrix[:, 0, 1] = zoom * torch.sin(turn), -zoom * torch.sin(turn)
        matrix[:, 2, :2] = torch.randn(batch, 2) * (0.15 / max(height, width))
        middle = torch.full((batch,), side / 2.0)
        about = _shifts(torch.full((batch,), -width / 2.0), torch.full((batch,), -height / 2.0))
        self.matrix = _shifts(middle, middle) @ matrix @ about

    def colour(self, points: torch.Tensor) -> torch.Tensor:
        """Colours [B, 3, H, W] at frame-1 points."""
        grid = mapped(self.matrix, points) * (2.0 / self.texture.shape[-1]) - 1
        return F.grid_sample(self.texture, grid.permute(0, 2, 3, 1), padding_mode="reflection", align_corners=False)


class Outline:
    """A soft cut-out in frame-1 pixels: a wavy shape, some stretched to thin rods, some with a hole or bars."""

    def __init__(self, batch: int, height: int, width: int):
        self.x, self.y = uniform(batch, 0, width), uniform(batch, 0, height)
        self.radius = torch.exp(uniform(batch, math.log(7.0), math.log(0.45 * min(height, width))))
        stretch = torch.exp(uniform(batch, 0, math.log(2.0)) + (torch.rand(batch) < 0.25) * uniform(batch, 0.3, 1.4))
        self.stretch = torch.minimum(stretch, (self.radius / 1.5).sqrt().clamp(min=1))
        self.turn = uniform(batch, 0, 2 * math.pi)
        self.waves = torch.randint(2, 8, (batch, 3)).float()
        self.heights = torch.rand(batch, 3) * torch.tensor([0.35, 0.2, 0.15])
        self.phases = uniform(batch * 3, 0, 2 * math.pi).view(batch, 3)
        self.hole = (torch.rand(batch) < 0.25) * uniform(batch, 0.3, 0.75)
        self.barred = torch.rand(batch) < 0.2
        self.pitch = uniform(batch, 6, 24)
        self.present = (torch.rand(batch) < 0.75).float()

    def cover(self, points: torch.Tensor) -> torch.Tensor:
        """Opacity [B, 1, H, W] at frame-1 points."""

        def b(values):
            return values.view(-1, 1, 1)

        dx, dy = points[:, 0] - b(self.x), points[:, 1] - b(self.y)
        c, s = b(torch.cos(self.turn)), b(torch.sin(self.turn))
        along, across = (c * dx + s * dy) / b(self.stretch), (c * dy - s * dx) * b(self.stretch)
        distance = torch.sqrt(along * along + across * across + 1e-6)
        angle = torch.atan2(across, along)
        limit = 1.0
        for j in range(3):
            limit = limit + b(self.heights[:, j]) * torch.cos(b(self.waves[:, j]) * angle + b(self.phases[:, j]))
        limit = b(self.radius) * limit
        cover = (limit - distance + 0.5).clamp(0, 1)
        cover = cover * (distance - b(self.hole) * limit + 0.5 + 2 * b((self.hole == 0).float())).clamp(0, 1)
        bars = (b(self.pitch) * 0.5 * torch.cos((2 * math.pi / b(self.pitch)) * (c * dx + s * dy)) + 0.5).clamp(0, 1)
        return (torch.where(b(self.barred), cover * bars, cover) * b(self.present))[:, None]


def scene(textures: Textures, batch: int, height: int, width: int, mixture=MIXTURE, shapes: int = SHAPES, apart=()):
    """Two frames [B, 3, H, W] in 0...1 and the flow [B, 2, H, W] from the first to the second, in pixels.

    A shape moves about as much as the camera does, but for those that move `apart`, by a displacement of their own out of that
    mixture, whose shares need not add up to one: what is fast over a slow ground is what a pyramid loses first.
    """
    side = min(SIDE, 64 * math.ceil(1.6 * max(height, width) / 64))
    size = 0.5 * math.hypot(height, width)
    x, y = torch.arange(width).float(), torch.arange(height).float()
    points = torch.stack(torch.meshgrid(x, y, indexing="xy"))[None]
    middle = torch.full((batch,), width / 2.0), torch.full((batch,), height / 2.0)
    magnitude = magnitudes(batch, mixture)
    # Some scenes have a still camera and moving things, some a moving camera over still things.
    camera = homographies(magnitude * (torch.rand(batch) > 0.1), *middle, size)
    ground = Surface(textures.draw(batch, side), height, width)
    first = ground.colour(points.expand(batch, -1, -1, -1))
    second = ground.colour(mapped(inverse(camera), points))
    flow = mapped(camera, points) - points
    for _ in range(shapes):
        outline, surface = Outline(batch, height, width), Surface(textures.draw(batch, side), height, width)
        much = magnitude * uniform(batch, 0.0, 1.2)
        if apart:
            own = torch.rand(batch) < sum(share for share, _, _ in apart)
            much = torch.where(own, magnitudes(batch, apart), much)
        own = homographies(much, outline.x, outline.y, 0.6 * size)
        motion = camera @ own
        origin = mapped(inverse(motion), points)
        cover, cover_second = outline.cover(points), outline.cover(origin)
        first = torch.lerp(first, surface.colour(points.expand(batch, -1, -1, -1)), cover)
        second = torch.lerp(second, surface.colour(origin), cover_second)
        flow = torch.where(cover > 0.5, mapped(motion, points) - points, flow)
    return first, second, flow


class Bank:
    """Scenes made once and shown again and again, each time by another window of them in one of four mirror images.

    Making a scene costs more than half of a small network's step. Noise is not in the bank: it is drawn anew each time.
    """

    def __init__(self, frames: torch.Tensor, flow: torch.Tensor):
        """Frames [N, 2, 3, H, W] as bytes and flow [N, 2, H, W] in pixels."""
        self.frames, self.flow = frames, flow

    @classmethod
    def made(cls, textures: Textures, count: int, height: int, width: int, mixture=MIXTURE, **kind):
        """`count` scenes, a few at a time; `kind` is what `scene` is told of its shapes."""
        frames = torch.empty(count, 2, 3, height, width, dtype=torch.uint8)
        flow = torch.empty(count, 2, height, width, dtype=torch.float16)
        some = 96 if frames.is_cuda else 8
        for i in range(0, count, some):
            first, second, flow[i : i + some] = scene(textures, min(some, count - i), height, width, mixture, **kind)
            frames[i : i + some] = torch.stack([first, second], 1).mul(255).add(0.5)
        return cls(frames, flow)

    @classmethod
    def kept(cls, file: Path, textures: Textures, seed: int, **described):
        """The bank in a file, which is made if there is none, so that runs and their legs share it. The random numbers of who
        asks go on as if there were no bank."""
        known = described | {"seed": seed}
        if not file.exists():
            with torch.random.fork_rng():
                torch.manual_seed(seed)
                made = cls.made(textures, **described)
            beside = file.with_name(file.name + ".part")
            torch.save({"described": known, "frames": made.frames.cpu(), "flow": made.flow.cpu()}, beside)
            beside.rename(file)
        held = torch.load(file, weights_only=True, mmap=True, map_location="cpu")
        if held["described"] != known:
            raise ValueError(f"{file}: expected a bank of {known}, found one of {held['described']}")
        return cls(held["frames"], held["flow"])

    def windows(self, which: torch.Tensor, down: torch.Tensor, right: torch.Tensor, height: int, width: int):
        """Frames [B, 2, 3, H, W] in 0...255 and flow [B, 2, H, W] at these places, on the default device."""
        if self.flow.is_cuda:  # Places stay on the device: reading them would mean waiting for it.
            return self.gathered(which, down[:, None] + torch.arange(height), right[:, None] + torch.arange(width))
        places = zip(which.tolist(), down.tolist(), right.tolist())
        places = [(n, ..., slice(y, y + height), slice(x, x + width)) for n, y, x in places]
        device = torch.get_default_device()
        return tuple(torch.stack([held[place] for place in places]).to(device) for held in (self.frames, self.flow))

    def gathered(self, which: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor):
        """Windows of rows [B, H] and columns [B, W] by one index, that is by one kernel."""
        n, y, x = which[:, None, None], rows[:, :, None], columns[:, None]
        return self.frames[n, :, :, y, x].permute(0, 3, 4, 1, 2), self.flow[n, :, y, x].permute(0, 3, 1, 2)

    def draw(self, batch: int, height: int, width: int):
        """As `scene`: two frames [B, 3, H, W] in 0...1 and the flow [B, 2, H, W]."""
        rows, columns = self.flow.shape[2:]
        which = torch.randint(len(self.flow), (batch,))
        down = torch.randint(rows - height + 1, (batch,))
        right = torch.randint(columns - width + 1, (batch,))
        frames, flow = self.windows(which, down, right, height, width)
        frames, flow = frames.float().div_(255), flow.float()
        # Along x, then along y; what is mirrored moves the other way.
        for turned, side in (((-1.0, 1.0), -1), ((1.0, -1.0), -2)):
            mirrored = (torch.rand(batch) < 0.5)[:, None, None, None]
            frames = torch.where(mirrored[..., None], frames.flip(side), frames)
            flow = torch.where(mirrored, flow.flip(side) * torch.tensor(turned)[:, None, None], flow)
        return frames[:, 0], frames[:, 1], flow


if __name__ == "__main__":
    folder, packed = map(Path, sys.argv[1:])
    packed.parent.mkdir(parents=True, exist_ok=True)
    pack(folder, packed)
