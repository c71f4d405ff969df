"""Judges the exported graphs: error by noise level against zero flow and DIS, and how true the predicted error is."""

import argparse
import csv
import tomllib
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from export import Exported
from pairs import HeldOut, linear, noisy, public_pairs

NOISE_LEVELS = (0, 10, 20, 30, 60)
SPEEDS = ((0, 1), (1, 4), (4, 8), (8, 16), (16, 1000))
CELL = 4


def network_flow(graphs: Exported, older: torch.Tensor, newer: torch.Tensor):
    """Full-resolution flow [H, W, 2], by the upsampler where there is one, and expected error at a quarter of it; sides are padded
    to multiples of 64."""
    height, width = older.shape[-2:]
    padding = [0, -width % 64, 0, -height % 64]
    older, newer = (F.pad(f, padding, mode="reflect").numpy() for f in (older, newer))
    flow, expected = graphs(older, newer)
    if graphs.upsampler:
        full = graphs.full(older, flow, expected)[0][0]
    else:
        full = F.interpolate(torch.from_numpy(flow).permute(0, 3, 1, 2), scale_factor=CELL, mode="bilinear")
        full = full[0].permute(1, 2, 0).numpy()
    return full[:height, :width], expected[0]


def dis_flow(older: torch.Tensor, newer: torch.Tensor, gamma: float) -> np.ndarray:
    """OpenCV's DIS (medium preset) on 8-bit grey, linear or with a tone curve."""
    grey = [
        np.clip(f[0].mean(0).numpy() ** gamma * 255 + 0.5, 0, 255).astype(np.uint8) for f in (older, newer)
    ]
    return cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*grey, None)


def errors_of(flow: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """End-point error [H, W], not-a-number where the truth is unknown."""
    return np.sqrt(np.square(flow - truth).sum(-1))


def cells(values: np.ndarray) -> np.ndarray:
    """[H, W, C] averaged over the network's 4x4 cells."""
    height, width = (s // CELL * CELL for s in values.shape[:2])
    return values[:height, :width].reshape(height // CELL, CELL, width // CELL, CELL, -1).mean((1, 3))


class Scores:
    """Errors gathered over the pairs of one set at one noise level."""

    def __init__(self):
        self.network, self.zero, self.dis, self.dis_curve = [], [], [], []
        self.by_speed = [[] for _ in SPEEDS]
        self.predicted, self.measured = [], []

    def add(self, graphs: Exported, older, newer, truth: np.ndarray) -> None:
        """Judges one pair; truth is [H, W, 2]."""
        flow, expected = network_flow(graphs, older, newer)
        error, speed = errors_of(flow, truth), np.sqrt(np.square(truth).sum(-1))
        self.network.append(np.nanmean(error))
        self.zero.append(np.nanmean(speed))
        self.dis.append(np.nanmean(errors_of(dis_flow(older, newer, 1.0), truth)))
        self.dis_curve.append(np.nanmean(errors_of(dis_flow(older, newer, 1 / 2.2), truth)))
        for kept, (low, high) in zip(self.by_speed, SPEEDS):
            kept.append(error[(speed >= low) & (speed < high)])
        truth_cells = cells(truth)
        rows, columns = truth_cells.shape[:2]
        self.predicted.append(expected[:rows, :columns].flatten())
        self.measured.append(errors_of(cells(flow), truth_cells).flatten())

    def best_dis(self) -> list[float]:
        """DIS on linear or on curved grey, whichever is better over the set."""
        return min(self.dis, self.dis_curve, key=np.mean)


def spread(values: list[float]) -> str:
    """Mean and deviation over pairs."""
    return f"{np.mean(values):.2f} ± {np.std(values):.2f}"


def error_table(title: str, scores: dict[int, Scores], count: int) -> list[str]:
    """Markdown table of one set."""
    lines = [f"### {title} ({count} pairs; mean ± deviation over pairs, px)", ""]
    lines += ["| noise level (1/255 at 0.4) | network | DIS | zero flow |", "| --- | --- | --- | --- |"]
    for level, score in scores.items():
        lines += [f"| {level} | {spread(score.network)} | {spread(score.best_dis())} | {spread(score.zero)} |"]
    return [*lines, ""]


def speed_table(scores: dict[int, Scores]) -> list[str]:
    """Markdown table of the error by true displacement."""
    names = [f"{low}…{high}" if high < 1000 else f"> {low}" for low, high in SPEEDS]
    lines = ["### Error by true displacement, held-out pairs (px)", ""]
    lines += [f"| noise level | {' | '.join(names)} |", "| --- " * (len(names) + 1) + "|"]
    for level, score in scores.items():
        gathered = [np.concatenate(kept) for kept in score.by_speed]
        means = [values.mean() if values.size else np.nan for values in gathered]
        lines += [f"| {level} | {' | '.join(f'{m:.2f}' for m in means)} |"]
    return [*lines, ""]


def reliability_table(scores: dict[int, Scores]) -> list[str]:
    """Markdown table: cells sorted by predicted error into ten equal bins, prediction against measurement."""
    lines = ["### Is the predicted error true? Held-out pairs, cells in ten equal bins by prediction (px)", ""]
    lines += ["| noise level | | " + " | ".join(str(i + 1) for i in range(10)) + " |", "| --- " * 12 + "|"]
    for level, score in scores.items():
        predicted, measured = np.concatenate(score.predicted), np.concatenate(score.measured)
        bins = np.array_split(np.argsort(predicted), 10)
        for name, values in (("predicted", predicted), ("measured", measured)):
            lines += [f"| {level} | {name} | " + " | ".join(f"{values[b].mean():.2f}" for b in bins) + " |"]
    return [*lines, ""]


# What a learning curve may be drawn against: the log's column, its name, and how far marks are apart.
AXES = {"minutes": ("minutes", 10), "step": ("steps", 2000)}


def curve_picture(log: Path, target: Path, against: str = "minutes") -> None:
    """The learning curve as an SVG: error by noise level against minutes or, where legs ran on unlike machines, against steps."""
    with open(log) as file:
        rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]
    width, height, left, bottom = 640, 320, 50, 40
    names = [key for key in rows[0] if key.startswith("epe_")]
    longest, highest = max(r[against] for r in rows), 1.05 * max(r[key] for r in rows for key in names)

    def place(done: float, error: float) -> tuple[float, float]:
        x = left + done / longest * (width - left - 130)
        return x, height - bottom - error / highest * (height - bottom - 10)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif" '
        'font-size="12"><rect width="100%" height="100%" fill="white"/>'
    ]
    step = 1 if highest > 3 else 0.5
    for error in (step * i for i in range(int(highest / step) + 1)):
        (x0, y), (x1, _) = place(0, error), place(longest, error)
        parts.append(f'<path d="M{x0:.1f} {y:.1f}H{x1:.1f}" stroke="#ddd"/>')
        parts.append(f'<text x="{x0 - 24}" y="{y + 4:.1f}">{error}</text>')
    unit, apart = AXES[against]
    for mark in range(0, int(longest) + 1, apart):
        x, y = place(mark, 0)
        parts.append(f'<text x="{x - 6:.1f}" y="{y + 16:.1f}">{mark}</text>')
    parts.append(f'<text x="{left + 130}" y="{height - 8}">{unit} of training</text>')
    parts.append('<text x="4" y="12">px</text>')
    colours = ("#1b7837", "#2166ac", "#b2182b", "#000000", "#e08214")
    for i, (key, colour) in enumerate(zip(names, colours)):
        name = key.replace("epe_", "noise ")
        points = " ".join("{:.1f},{:.1f}".format(*place(r[against], r[key])) for r in rows)
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        parts.append(f'<text x="{width - 120}" y="{20 + 18 * i}" fill="{colour}">{name}: {rows[-1][key]:.2f}</text>')
    target.write_text("\n".join([*parts, "</svg>"]) + "\n")


def main() -> None:
    """Command line; writes `NAME_evaluation.md` and the learning curve beside the graphs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", type=Path, default=Path("../models"))
    parser.add_argument("--name", default="pwcnet_fcdn")
    parser.add_argument("--photographs", type=Path, default=Path("runs/photographs.npz"))
    parser.add_argument("--public", type=Path, help="folder of public pairs with ground truth (judging only)")
    parser.add_argument("--log", type=Path, default=Path("runs/fcdn/log.csv"))
    parser.add_argument("--against", choices=AXES, default="minutes", help="what the learning curve is drawn against")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    files = (str(arguments.models / f"{arguments.name}_{part}.onnx") for part in ("pyramid", "decoder"))
    entry = tomllib.loads((arguments.models / "manifest.toml").read_text()).get(arguments.name, {})
    upsampler = str(arguments.models / entry["upsampler"]["file"]) if "upsampler" in entry else None
    graphs = Exported(*files, arguments.threads, upsampler)
    held, scores = HeldOut(arguments.photographs, arguments.count, seed=23), {}
    for level in NOISE_LEVELS:
        scores[level] = Scores()
        older, newer = held.at(level)
        for i in range(arguments.count):
            truth = held.flow[i].permute(1, 2, 0).numpy()
            scores[level].add(graphs, older[i : i + 1], newer[i : i + 1], truth)
    lines = [f"## {arguments.name}: measured by `training/evaluate.py`", ""]
    lines += error_table("Held-out synthetic pairs, 320×256, unseen photographs", scores, arguments.count)
    lines += speed_table(scores) + reliability_table(scores)
    if arguments.public:
        sets = (("chairs", "FlyingChairs, 512×384"), ("rubberwhale", "Middlebury RubberWhale, 584×388"))
        for prefix, title in sets:
            chosen = [p for p in public_pairs(arguments.public) if p[0].startswith(prefix)]
            scores = {level: Scores() for level in NOISE_LEVELS}
            for level, score in scores.items():
                torch.manual_seed(31)
                for _, older, newer, truth in chosen:
                    dark = noisy(*linear(older, newer, jitter=False), level)
                    score.add(graphs, *dark, truth[0].permute(1, 2, 0).numpy())
            lines += error_table(title, scores, len(chosen))
    curve_picture(arguments.log, arguments.models / f"{arguments.name}_curve.svg", arguments.against)
    (arguments.models / f"{arguments.name}_evaluation.md").write_text("\n".join(lines))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
