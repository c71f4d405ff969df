"""Trains in legs: `train.py fcdn.toml --minutes 20 --resume` ends by itself with a checkpoint to go on from."""

import argparse
import copy
import csv
import math
import time
import tomllib
from pathlib import Path

import torch
import torch.nn.functional as F

from networks import LEVELS, PwcNet
from pairs import HeldOut, batch_of
from scenes import Textures

LEVEL_WEIGHTS = dict(zip(LEVELS, (0.25, 0.25, 0.3, 0.5, 1.0)))
JUDGED_LEVELS = (0, 10, 20, 30)


def loss_of(flows, expected, truth):
    """Multi-scale end-point error in pixels of the input, plus the likelihood of the error head (exponential law)."""
    total = 0.0
    for level, flow in zip(LEVELS, flows):
        cell = 2**level
        error = (flow * cell - F.avg_pool2d(truth, cell)).square().sum(1, keepdim=True).add(1e-6).sqrt()
        total = total + LEVEL_WEIGHTS[level] * error.mean()
    error = error.detach()
    return total, (torch.log(expected) + error / expected).mean(), error.mean()


class Run:
    """Network, its running mean, optimizer and place in the schedule."""

    def __init__(self, description: dict):
        self.description = description
        torch.manual_seed(description["seed"])
        self.network = PwcNet().to(memory_format=torch.channels_last)
        self.mean = copy.deepcopy(self.network).requires_grad_(False)
        sharp = [p for n, p in self.network.named_parameters() if n.endswith("sharpness")]
        rest = [p for n, p in self.network.named_parameters() if not n.endswith("sharpness")]
        self.optimizer = torch.optim.AdamW(
            [
                {"params": rest, "factor": 1.0, "weight_decay": description["weight_decay"]},
                {"params": sharp, "factor": 10.0, "weight_decay": 0.0},
            ],
            fused=True,
        )
        self.step, self.seconds = 0, 0.0

    def progress(self) -> float:
        """Share of the schedule that is done: by steps if the description counts steps, else by minutes of training."""
        schedule = self.description["schedule"]
        done = self.step / schedule["steps"] if "steps" in schedule else self.seconds / (60 * schedule["minutes"])
        return min(done, 1.0)

    def rate(self) -> float:
        """Linear warm-up by steps, then half a cosine down to 1 % of the peak."""
        peak = self.description["peak_rate"]
        warm = min(1.0, (self.step + 1) / self.description["warm_up_steps"])
        return peak * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * self.progress())))

    def crop(self) -> dict:
        """The crop stage in force: the last whose start is reached."""
        return [c for c in self.description["crops"] if c["from"] <= self.progress()][-1]

    def train_step(self, older, newer, truth) -> tuple[float, float]:
        """One update; the loss and the end-point error of level 2."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate() * group["factor"]
        channels_last = {"memory_format": torch.channels_last}
        with torch.autocast("cpu", torch.bfloat16, enabled=self.description["bf16"]):
            flows, expected = self.network(older.to(**channels_last), newer.to(**channels_last))
        loss, likelihood, error = loss_of(flows, expected, truth)
        self.optimizer.zero_grad(set_to_none=True)
        (loss + 0.1 * likelihood).backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.description["clip"])
        self.optimizer.step()
        self.step += 1
        decay = min(self.description["mean_decay"], self.step / (self.step + 10))
        with torch.no_grad():
            for kept, new in zip(self.mean.parameters(), self.network.parameters()):
                kept.lerp_(new, 1 - decay)
        return loss.item(), error.item()

    def save(self, path: Path) -> None:
        """Writes beside and renames, so that a leg cut short leaves the former checkpoint whole."""
        state = {
            "network": self.network.state_dict(),
            "mean": self.mean.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "random": torch.get_rng_state(),
            "step": self.step,
            "seconds": self.seconds,
        }
        torch.save(state, path.with_suffix(".part"))
        path.with_suffix(".part").replace(path)

    def load(self, path: Path) -> None:
        """Goes on where `save` left off, random numbers included."""
        state = torch.load(path, weights_only=True)
        self.network.load_state_dict(state["network"])
        self.mean.load_state_dict(state["mean"])
        self.optimizer.load_state_dict(state["optimizer"])
        for group in self.optimizer.param_groups:
            group["fused"], group["foreach"] = True, None
        torch.set_rng_state(state["random"])
        self.step, self.seconds = state["step"], state["seconds"]


@torch.no_grad()
def judged(network: PwcNet, held: HeldOut) -> list[float]:
    """Mean end-point error at full resolution for each noise level, in bf16 (a quick look, not the card's figure)."""
    errors = []
    for level in JUDGED_LEVELS:
        older, newer = held.at(level)
        total = 0.0
        for i in range(0, len(older), 4):
            with torch.autocast("cpu", torch.bfloat16):
                flow = network(older[i : i + 4], newer[i : i + 4])[0][-1]
            full = F.interpolate(4 * flow, scale_factor=4, mode="bilinear", align_corners=False)
            total += (full - held.flow[i : i + 4]).norm(dim=1).mean((1, 2)).sum().item()
        errors.append(total / len(older))
    return errors


def leg(run: Run, folder: Path, packed: Path, minutes: float, every: float) -> None:
    """Trains for so many minutes; a log row and a checkpoint every `every` minutes and at the end."""
    textures, held = Textures(packed, held_out=False), HeldOut(packed, count=16)
    zero = held.flow.norm(dim=1).mean().item()
    log = folder / "log.csv"
    if not log.exists():
        heading = ["step", "minutes", "loss", "train_epe", *(f"epe_{n}" for n in JUDGED_LEVELS), "zero_flow", "rate"]
        log.write_text(",".join(heading) + "\n")
    began, row_due, losses = time.monotonic(), run.seconds + 60 * every, []
    before = run.seconds
    while True:
        crop = run.crop()
        pairs = batch_of(textures, crop["batch"], crop["height"], crop["width"], clean=run.description["clean"])
        losses.append(run.train_step(*pairs))
        run.seconds = before + time.monotonic() - began
        over = run.seconds - before >= 60 * minutes or run.progress() >= 1
        if over or run.seconds >= row_due:
            loss, train = (sum(v) / len(losses) for v in zip(*losses))
            row = [run.step, f"{run.seconds / 60:.2f}", f"{loss:.3f}", f"{train:.3f}"]
            row += [f"{e:.3f}" for e in judged(run.mean, held)] + [f"{zero:.3f}", f"{run.rate():.2e}"]
            with open(log, "a", newline="") as file:
                csv.writer(file, lineterminator="\n").writerow(row)
            print(*row, flush=True)
            run.save(folder / "checkpoint.pt")
            row_due, losses = run.seconds + 60 * every, []
        if over:
            return


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("description", type=Path, help="a run's TOML")
    parser.add_argument("--photographs", type=Path, default=Path("runs/photographs.npz"))
    parser.add_argument("--minutes", type=float, required=True)
    parser.add_argument("--every", type=float, default=4.0, help="minutes between log rows")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    run = Run(tomllib.loads(arguments.description.read_text()))
    folder = Path("runs") / arguments.description.stem
    folder.mkdir(parents=True, exist_ok=True)
    if arguments.resume and (folder / "checkpoint.pt").exists():
        run.load(folder / "checkpoint.pt")
    leg(run, folder, arguments.photographs, arguments.minutes, arguments.every)


if __name__ == "__main__":
    main()
