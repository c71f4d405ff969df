"""Trains in legs: `train.py fcdn.toml --minutes 20 --resume` ends by itself with a checkpoint to go on from."""

import argparse
import copy
import csv
import math
import os
import time
import tomllib
from pathlib import Path

import torch
import torch.distributed as dist
import torch.nn.functional as F
from torch import nn

from networks import PwcNet, levels_from
from pairs import HeldOut, batch_of
from scenes import Textures

LEVEL_WEIGHTS = {6: 0.25, 5: 0.25, 4: 0.4, 3: 0.5, 2: 1.0}
JUDGED_LEVELS = (0, 10, 20, 30)


def loss_of(flows, expected, truth):
    """Multi-scale end-point error in pixels of the input, plus the likelihood of the error head (exponential law)."""
    total = 0.0
    for level, flow in zip(levels_from(len(flows) + 1), flows):
        cell = 2**level
        error = (flow * cell - F.avg_pool2d(truth, cell)).square().sum(1, keepdim=True).add(1e-6).sqrt()
        total = total + LEVEL_WEIGHTS[level] * error.mean()
    error = error.detach()
    return total, (torch.log(expected) + error / expected).mean(), error.mean()


def average_gradients(network: nn.Module) -> None:
    """Under `torchrun`, the mean gradient of all workers, in one exchange a step."""
    if dist.is_initialized():
        gradients = [p.grad for p in network.parameters()]
        flat = torch.cat([g.flatten() for g in gradients])
        dist.all_reduce(flat)
        flat /= dist.get_world_size()
        for gradient, mean in zip(gradients, flat.split([g.numel() for g in gradients])):
            gradient.copy_(mean.view_as(gradient))


def agreed(value: bool, seconds: float) -> tuple[bool, float]:
    """What the first worker says, so that all end a leg at the same step."""
    if not dist.is_initialized():
        return value, seconds
    said = torch.tensor([float(value), seconds], dtype=torch.float64)
    dist.broadcast(said, 0)
    return bool(said[0]), said[1].item()


class Run:
    """Network, its running mean, optimizer and place in the schedule."""

    def __init__(self, description: dict):
        self.description = description
        torch.manual_seed(description["seed"])
        self.network = PwcNet(description["coarsest"]).to(memory_format=torch.channels_last)
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
        average_gradients(self.network)
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
            "coarsest": self.description["coarsest"],
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
    textures, first = Textures(packed, held_out=False), not dist.is_initialized() or dist.get_rank() == 0
    log = Log(folder / "log.csv", packed) if first else None
    if not first:  # Workers start from one checkpoint and must not draw the same scenes.
        torch.manual_seed(1000 * run.step + dist.get_rank())
    before, began, row_due, losses, over = run.seconds, time.monotonic(), run.seconds + 60 * every, [], False
    while not over:
        crop = run.crop()
        pairs = batch_of(textures, crop["batch"], crop["height"], crop["width"], clean=run.description["clean"])
        losses.append(run.train_step(*pairs))
        seconds = before + time.monotonic() - began
        over, run.seconds = agreed(seconds - before >= 60 * minutes, seconds)
        over = over or run.progress() >= 1
        if first and (over or run.seconds >= row_due):
            log.row(run, losses)
            run.save(folder / "checkpoint.pt")
            row_due, losses = run.seconds + 60 * every, []


class Log:
    """The learning curve: a CSV row now and then, judged on the held-out pairs."""

    def __init__(self, path: Path, packed: Path):
        self.path, self.held = path, HeldOut(packed, count=16)
        self.zero = self.held.flow.norm(dim=1).mean().item()
        if not path.exists():
            heading = ["step", "minutes", "loss", "train_epe", *(f"epe_{n}" for n in JUDGED_LEVELS), "zero_flow", "rate"]
            path.write_text(",".join(heading) + "\n")

    def row(self, run: Run, losses: list[tuple[float, float]]) -> None:
        """Judges the running mean of the weights and writes where the run stands."""
        loss, train = (sum(values) / len(losses) for values in zip(*losses))
        row = [run.step, f"{run.seconds / 60:.2f}", f"{loss:.3f}", f"{train:.3f}"]
        row += [f"{e:.3f}" for e in judged(run.mean, self.held)] + [f"{self.zero:.3f}", f"{run.rate():.2e}"]
        with open(self.path, "a", newline="") as file:
            csv.writer(file, lineterminator="\n").writerow(row)
        print(*row, flush=True)


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
    if "WORLD_SIZE" in os.environ:
        dist.init_process_group("gloo")
    run = Run(tomllib.loads(arguments.description.read_text()))
    folder = Path("runs") / arguments.description.stem
    folder.mkdir(parents=True, exist_ok=True)
    if arguments.resume and (folder / "checkpoint.pt").exists():
        run.load(folder / "checkpoint.pt")
    leg(run, folder, arguments.photographs, arguments.minutes, arguments.every)


if __name__ == "__main__":
    main()
