"""Pairs for training and judging: clean scenes made into dark raw frames by the FCDN recipe `paper` or one of its
rivals."""

import math
import struct
import subprocess
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from scenes import MIXTURE, Bank, Textures, scene, uniform

MEAN_LEVEL = 0.4
DARKEST = 30.0
# As `nightflow synth fcdn` names them.
RECIPES = ("paper", "authors-2021", "unprocess")
# From CIE XYZ to the colours of four cameras; the figures are those published with `unprocess`
# (google-research/unprocessing, Apache-2.0).
XYZ_TO_CAMERA = (
    ((1.0234, -0.2969, -0.2266), (-0.5625, 1.6328, -0.0469), (-0.0703, 0.2188, 0.6406)),
    ((0.4913, -0.0541, -0.0202), (-0.613, 1.3513, 0.2906), (-0.1564, 0.2151, 0.7183)),
    ((0.838, -0.263, -0.0639), (-0.2887, 1.0725, 0.2496), (-0.0627, 0.1427, 0.5438)),
    ((0.6596, -0.2079, -0.0562), (-0.4782, 1.3016, 0.1933), (-0.097, 0.1581, 0.5181)),
)
# From linear sRGB to CIE XYZ, white D65.
RGB_TO_XYZ = ((0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.0721750), (0.0193339, 0.1191920, 0.9503041))


def levels(batch: int, darkest: float = DARKEST, towards_bright: float = 1.0) -> torch.Tensor:
    """[B] noise levels 0...darkest: evenly, or with a power above 1 more of the bright ones."""
    return darkest * torch.rand(batch) ** towards_bright


def linear(first: torch.Tensor, second: torch.Tensor, jitter: bool = True):
    """Tone curve and white balance undone by an inverse gamma per channel, one gain for both frames, mean about 0.4."""
    batch = len(first)
    gamma = uniform(batch * 3, 1.0, 2.4).view(batch, 3, 1, 1) if jitter else torch.full((batch, 3, 1, 1), 2.2)
    target = uniform(batch, 0.25, 0.55) if jitter else torch.full((batch,), MEAN_LEVEL)
    frames = [frame.clamp(1e-4, 1).pow(gamma) for frame in (first, second)]
    gain = target / frames[0].mean((1, 2, 3)).clamp(min=0.01)
    # A little flicker of lamps; and a picture that is mostly black is not brought up without bound.
    flicker = 1 + (0.02 * torch.randn(batch) if jitter else torch.zeros(batch))
    gain = gain.clamp(max=8.0)
    gains = gain, gain * flicker
    return tuple((frame * g.view(-1, 1, 1, 1)).clamp(0, 1) for frame, g in zip(frames, gains))


def noisy(first: torch.Tensor, second: torch.Tensor, level: float | torch.Tensor):
    """z ~ N(y, a y + b), clipped; `level` (one for all, or [B]) is the deviation at a grey of 0.4 in 1/255.

    The shot part grows against the read part as in the paper; the deviation differs a little from channel to channel,
    since binning averages two greens and white balance multiplies red and blue.
    """
    batch = len(first)
    level = torch.as_tensor(level, dtype=torch.float32).expand(batch)
    deviation = (level / 255).view(-1, 1, 1, 1) * uniform(batch * 3, 0.7, 1.3).view(batch, 3, 1, 1)
    shot = uniform(batch, 0.3, 1.0).view(-1, 1, 1, 1)
    a, b = deviation**2 * shot / MEAN_LEVEL, deviation**2 * (1 - shot)
    return tuple((y + torch.randn_like(y) * torch.sqrt(a * y + b)).clamp(0, 1) for y in (first, second))


def over_pixels(values: torch.Tensor) -> torch.Tensor:
    """[B] or [B, 3], one for a pair or one for each of its colours, as [B, 1 or 3, 1, 1]."""
    return values.view(len(values), -1, 1, 1)


def authors_drawn(batch: int):
    """The authors' released script of 2021: deviation by signal a [B], deviation in the dark b [B] on the 8-bit scale,
    and a gain for each colour [B, 3]."""
    a, b = (torch.randn(batch) * 19.5 / 255).abs(), (torch.randn(batch) * 38.25).abs()
    return a, b, 1 / (1 + 0.05 * torch.randn(batch, 3))


def authors(first, second, a, b, gain):
    """z ~ N(x, (a x + b)^2) on the 8-bit scale, cut to a whole number; times the gain, cut again."""

    def seen(frame):
        x = (255 * frame).round()
        z = (x + (over_pixels(a) * x + over_pixels(b)) * torch.randn_like(x)).clamp(0, 255).trunc()
        return (over_pixels(gain) * z).clamp(0, 255).trunc() / 255

    return seen(first), seen(second)


def unprocess_drawn(batch: int):
    """Brooks et al. 2019: from linear sRGB to the colours of a camera between four [B, 3, 3], gains that undo the white
    balance [B, 3], and noise a [B] and b [B] as in `noisy`."""
    weights = uniform(batch * len(XYZ_TO_CAMERA), 1e-8, 1.0).view(batch, -1)
    matrix = torch.einsum("bk,kix,xj->bij", weights, torch.tensor(XYZ_TO_CAMERA), torch.tensor(RGB_TO_XYZ))
    brightness = 0.8 + 0.1 * torch.randn(batch)
    gain = torch.stack([brightness / uniform(batch, 1.9, 2.4), brightness, brightness / uniform(batch, 1.5, 1.9)], 1)
    ln_a = uniform(batch, math.log(0.0001), math.log(0.012))
    ln_b = 2.18 * ln_a + 1.20 + 0.26 * torch.randn(batch)
    return matrix / matrix.sum(2, keepdim=True), gain, ln_a.exp(), ln_b.exp()


def unprocess(first, second, matrix, gain, a, b):
    """Tone curve, power, colours and white balance undone, the last but for highlights; then z ~ N(y, a y + b), clipped
    and rounded to a byte."""
    gain = over_pixels(gain)

    def seen(frame):
        linear = (0.5 - torch.sin(torch.asin(1 - 2 * frame.clamp(0, 1)) / 3)).clamp(min=0) ** 2.2
        colours = torch.einsum("bij,bjyx->biyx", matrix, linear)
        light = ((colours.mean(1, keepdim=True) - 0.9) / 0.1).clamp(min=0) ** 2
        y = (colours * torch.maximum(light + (1 - light) * gain, gain)).clamp(0, 1)
        z = y + torch.sqrt(over_pixels(a) * y + over_pixels(b)) * torch.randn_like(y)
        return (255 * z.clamp(0, 1)).round() / 255

    return seen(first), seen(second)


def batch_of(
    textures: Textures | Bank, height: int, width: int, level: torch.Tensor | None, mixture=MIXTURE, batch: int = 4,
    recipe: str = "paper", **kind,
):
    """A training batch: older, newer [B, 3, H, W] and the flow [B, 2, H, W]. By the recipe `paper` one pair for each
    noise level, or `batch` clean ones; the others draw their own noise for `batch` pairs, and what they make is not
    brought to a mean. `kind` is what `scene` is told of its shapes. A bank has its own mixture."""
    batch = batch if level is None else len(level)
    if isinstance(textures, Bank):
        first, second, flow = textures.draw(batch, height, width)
    else:
        first, second, flow = scene(textures, batch, height, width, mixture, **kind)
    if recipe == "authors-2021":
        return *authors(first, second, *authors_drawn(batch)), flow
    if recipe == "unprocess":
        return *unprocess(first, second, *unprocess_drawn(batch)), flow
    first, second = linear(first, second)
    if level is not None:
        first, second = noisy(first, second, level)
    return first, second, flow


class HeldOut:
    """A fixed set of clean pairs from photographs that training never sees, and their noisy versions. Drawn on the CPU and
    then brought to the default device, so that it is the same on every kind of machine."""

    def __init__(self, packed: Path, count: int, height: int = 256, width: int = 320, seed: int = 7):
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            with torch.device("cpu"):
                textures = Textures(packed, held_out=True)
                parts = [batch_of(textures, height, width, None) for _ in range(-(-count // 4))]
        self.first, self.second, flow = (torch.cat(p)[:count] for p in zip(*parts))
        self.flow = flow.to(torch.get_default_device())

    def at(self, level: float, seed: int = 11):
        """Older and newer frames at a noise level of 0...30."""
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            with torch.device("cpu"):
                pair = noisy(self.first, self.second, level)
            return tuple(frame.to(self.flow.device) for frame in pair)


def read_flo(path: Path) -> np.ndarray:
    """Middlebury .flo: [H, W, 2] in pixels, not-a-number where unknown."""
    with open(path, "rb") as file:
        magic = np.fromfile(file, "<f4", 1)
        if magic.size != 1 or magic[0] != np.float32(202021.25):
            raise ValueError(f"{path}: expected the .flo magic 202021.25, found {magic}")
        width, height = np.fromfile(file, "<i4", 2)
        values = np.fromfile(file, "<f4", 2 * width * height)
    if values.size != 2 * width * height:
        raise ValueError(f"{path}: expected {2 * width * height} values, found {values.size}")
    flow = values.reshape(height, width, 2).copy()
    flow[np.abs(flow).max(2) > 1e8] = np.nan
    return flow


class Stream:
    """Pairs that `nightflow synth scenes --stream` makes, noise included; the layout is that of its
    `darkness::scenes::stream`. `command` is the whole command line; the program waits while nobody reads."""

    MAGIC, VERSION = b"NFPAIRS\0", 1

    def __init__(self, command: list[str]):
        # Unbuffered: records are read in one piece into the batch's own memory.
        self.program = subprocess.Popen(command, stdout=subprocess.PIPE, bufsize=0)
        head = self._read(bytearray(96))
        magic, version, length, width, height, component, record = struct.unpack_from("<8s6I", head)
        if (magic, version, length) != (self.MAGIC, self.VERSION, 96):
            found = f"{magic!r}, version {version}, {length} bytes"
            raise ValueError(f"expected a stream of {self.MAGIC!r}, version {self.VERSION}, 96 bytes, found {found}")
        self.seed, self.first, self.count = struct.unpack_from("<3Q", head, 32)
        self.recipe, self.preset = (head[at : at + 16].rstrip(b"\0").decode() for at in (56, 72))
        self.height, self.width, self.left = height, width, self.count or None
        frame = (height, width, 3)
        self.record = np.dtype(
            [("index", "<u8"), ("a", "<f4", 3), ("b", "<f4", 3), ("level", "<f4"), ("zero", "<u4")]
            + [("older", "u1", frame), ("newer", "u1", frame)]
            + [("flow", f"<f{component}", (height, width, 2)), ("valid", "u1", (height, width))]
        )
        if self.record.itemsize != record:
            raise ValueError(f"expected records of {self.record.itemsize} bytes, found {record}")

    def _read(self, memory):
        view, at = memoryview(memory).cast("B"), 0
        while at < len(view):
            more = self.program.stdout.readinto(view[at:])
            if not more:
                raise EOFError(f"expected {len(view)} bytes, the stream ended after {at}")
            at += more
        return memory

    def records(self, batch: int) -> np.ndarray:
        """The next records as they are: index, a, b, level, older, newer, flow, valid."""
        if self.left is not None:
            batch, self.left = min(batch, self.left), self.left - min(batch, self.left)
        if batch == 0:
            raise EOFError(f"all {self.count} pairs of the stream were read")
        records = np.empty(batch, self.record)
        self._read(records.view("u1"))
        return records

    def batch(self, batch: int):
        """Older, newer [B, 3, H, W] in 0...1, flow [B, 2, H, W], valid [B, 1, H, W] as 0 or 1, and level [B]."""
        found = self.records(batch)
        frames = (torch.from_numpy(found[name]).permute(0, 3, 1, 2).float().div_(255) for name in ("older", "newer"))
        flow = torch.from_numpy(found["flow"].astype(np.float32)).permute(0, 3, 1, 2)
        return *frames, flow, torch.from_numpy(found["valid"])[:, None].float(), torch.from_numpy(found["level"].copy())

    def close(self):
        """Lets go of the program, which then ends by itself."""
        self.program.stdout.close()
        self.program.wait()


def public_pairs(folder: Path):
    """Name, older, newer [1, 3, H, W] in 0...1 and flow [1, 2, H, W] of every `NAME_flow.flo` in a folder: frames are
    `NAME_img1` and `NAME_img2`, PNG or (as in FlyingChairs and FCDN) PPM."""
    for flow_file in sorted(folder.glob("*_flow.flo")):
        name = flow_file.name.removesuffix("_flow.flo")
        ending = "png" if (folder / f"{name}_img1.png").exists() else "ppm"
        frames = [np.asarray(Image.open(folder / f"{name}_img{i}.{ending}").convert("RGB")) for i in (1, 2)]
        older, newer = (torch.from_numpy(f.copy()).permute(2, 0, 1)[None].float() / 255 for f in frames)
        yield name, older, newer, torch.from_numpy(read_flo(flow_file)).permute(2, 0, 1)[None]
