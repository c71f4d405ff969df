"""Trains in legs: `train.py fcdn.toml --minutes 9 --resume` ends by itself with a checkpoint to go on from, on a CPU or a
GPU, and on another kind of machine than the leg before."""

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

import checkpoints
from flownet import KINDS
from networks import PwcNet
from pairs import DARKEST, RECIPES, HeldOut, batch_of, levels
from raft import RaftSmall
from scenes import MIXTURE, Bank, Textures
from upsampler import Upsampled

JUDGED_LEVELS = (0, 10, 20, 30, 60)


def network_of(description: dict) -> nn.Module:
    """The network that a run's TOML describes, untrained but for published weights that it starts from."""
    kind = description["network"]
    if kind == "pwcnet":
        return PwcNet(dense=description.get("dense", False))
    if kind == "raftsmall":
        return RaftSmall(description["iterations"])
    if kind == "upsampler":
        return Upsampled()
    if kind in KINDS:
        return KINDS[kind](description["width"])
    raise ValueError(f"expected the network pwcnet, upsampler, raftsmall, {' or '.join(KINDS)}, found {kind}")


def start(network: nn.Module, where: str) -> None:
    """Weights to start from: published ones (`*.pth`), the running mean in a run's checkpoint (`runs/flownets/checkpoint`), or
    a network's graphs (`../models/pwcnet_fcdn`), which hold it in fp16."""
    if where.endswith(".pth"):
        return network.published(where)
    folder = Path(where)
    held = checkpoints.load(folder)["mean"] if checkpoints.exists(folder) else checkpoints.of_graphs(folder)
    missing, unknown = network.load_state_dict(held, strict=False)
    if unknown:
        raise ValueError(f"{where}: expected weights of {type(network).__name__}, {unknown} is unknown")
    if missing:
        print(f"# {where} has no {', '.join(missing)}", flush=True)


def off(flow: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """End-point error [B, 1, H, W]; the root's slope stays finite where it is zero."""
    return (flow - truth).square().sum(1, keepdim=True).add(1e-6).sqrt()


def loss_of(network, flows, expected, truth, pixels: bool = False):
    """Weighed sum of end-point errors in pixels of the input, the likelihood of the error heads (exponential law), and the
    last flow's error. `expected` is of the last flow, or a list of the last few.

    With `pixels` the last flow is judged as it is used, brought to every pixel: a cell that an edge runs through then takes
    one side's motion rather than the mean of both, which is nobody's.
    """
    total, errors = 0.0, []
    weighed = network.weighed(flows)
    for number, (flow, weight) in enumerate(weighed, 1):
        cell = truth.shape[-1] // flow.shape[-1]
        if pixels and number == len(weighed):
            each = off(F.interpolate(flow, scale_factor=cell, mode="bilinear"), truth)
            errors.append(F.avg_pool2d(each, cell))
        else:
            errors.append(off(flow, network.truth(truth, cell)))
        total = total + weight * errors[-1].mean()
    heads = expected if isinstance(expected, list) else [expected]
    pairs = list(zip(heads, (error.detach() for error in errors[-len(heads) :])))
    likelihood = sum((torch.log(head) + error / head).mean() for head, error in pairs)
    return total, likelihood, errors[-1].detach().mean()


def average_gradients(network: nn.Module) -> None:
    """Under `torchrun`, the mean gradient of all workers, in one exchange a step."""
    if dist.is_initialized():
        gradients = [p.grad for p in network.parameters() if p.requires_grad]
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


class Replayed:
    """A run's update as one CUDA graph a crop: a CPU takes longer to hand out a thousand small kernels one by one than a large
    GPU to run them."""

    WARM = 3

    def __init__(self, run):
        self.run, self.shape, self.warm = run, None, 0

    def __call__(self, *inputs) -> tuple[torch.Tensor, torch.Tensor]:
        if inputs[0].shape != self.shape:
            self.shape, self.warm, self.graph = inputs[0].shape, 0, None
        self.warm += 1
        if self.warm <= self.WARM:  # Compiles and chooses kernels, on a stream of its own as a capture will be.
            beside, here = torch.cuda.Stream(), torch.cuda.current_stream()
            beside.wait_stream(here)
            with torch.cuda.stream(beside):
                done = self.run.update(*inputs)
            here.wait_stream(beside)
            return done
        if self.graph is None:  # A capture runs nothing.
            self.held, self.graph = [given.clone() for given in inputs], torch.cuda.CUDAGraph()
            with torch.cuda.graph(self.graph):
                self.done = self.run.update(*self.held)
        for held, given in zip(self.held, inputs):
            held.copy_(given)
        self.graph.replay()
        return tuple(value.clone() for value in self.done)


class Run:
    """Network, its running mean, optimizer and place in the schedule."""

    def __init__(self, description: dict):
        self.description = description
        # Clean pairs are those of the recipe `paper` without its noise.
        self.recipe = "paper" if description["clean"] else description.get("recipe", "paper")
        if self.recipe not in RECIPES:
            raise ValueError(f"expected the recipe {', '.join(RECIPES[:-1])} or {RECIPES[-1]}, found {self.recipe}")
        torch.manual_seed(description["seed"])
        # Made on the CPU, so that a seed means the same weights on every kind of machine.
        with torch.device("cpu"):
            network = network_of(description)
            if "start" in description:
                start(network, description["start"])
        self.device = torch.get_default_device()
        # On a CPU instance norms would copy every map into the other layout and back: twice the encoder's time.
        self.layout = torch.channels_last if self.device.type == "cuda" else torch.contiguous_format
        self.network = network.to(self.device, memory_format=self.layout)
        self.mean = copy.deepcopy(self.network).requires_grad_(False)
        fast, slow, rest = [], [], []
        for name, parameter in self.network.named_parameters():
            of = lambda parts: any(part in name for part in parts)
            if not of(description.get("only", [""])):
                parameter.requires_grad_(False)
                continue
            (fast if of(network.FAST) else slow if of(network.SLOW) else rest).append(parameter)
        self.optimizer = torch.optim.AdamW(
            [
                {"params": rest, "factor": 1.0, "weight_decay": description["weight_decay"]},
                {"params": fast, "factor": 10.0, "weight_decay": 0.0},
                {"params": slow, "factor": 0.3, "weight_decay": description["weight_decay"]},
            ],
            fused=True,
        )
        self.replayed = Replayed(self) if description.get("graph") and self.device.type == "cuda" else None
        if self.replayed:  # Rates that a graph reads when it runs.
            for group in self.optimizer.param_groups:
                group |= {"lr": torch.tensor(0.0), "capturable": True}
        # Fuses what lies between the convolutions: cost volume, normalisation, warp. A crop's size is compiled in.
        self.forward = torch.compile(self.network, dynamic=False) if description["compile"] else self.network
        if self.device.type == "cuda":
            torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
            torch.backends.cudnn.benchmark = True
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

    def noise(self, batch: int) -> torch.Tensor | None:
        """Noise levels for a batch of the recipe `paper`; none for a clean run."""
        if self.description["clean"] or self.recipe != "paper":
            return None
        return levels(batch, self.description.get("darkest", DARKEST), self.description.get("towards_bright", 1.0))

    def train_step(self, older, newer, truth) -> tuple[torch.Tensor, torch.Tensor]:
        """One step; the loss and the end-point error of level 2, left where they were computed: reading a number
        makes the CPU wait for the GPU."""
        for group in self.optimizer.param_groups:
            rate = self.rate() * group["factor"]
            group["lr"] = group["lr"].fill_(rate) if self.replayed else rate
        older, newer = (f.contiguous(memory_format=self.layout) for f in (older, newer))
        loss, error = (self.replayed or self.update)(older, newer, truth)
        self.step += 1
        decay = min(self.description["mean_decay"], self.step / (self.step + 10))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.mean.parameters()), list(self.network.parameters()), 1 - decay)
        return loss, error

    def update(self, older, newer, truth) -> tuple[torch.Tensor, torch.Tensor]:
        """Forward, backward and the optimizer's step: everything of a step that reads no number of the CPU's."""
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.description["bf16"]):
            flows, expected = self.forward(older, newer)
        loss, likelihood, error = loss_of(self.network, flows, expected, truth, self.description.get("pixels", False))
        self.optimizer.zero_grad(set_to_none=True)
        (loss + 0.1 * likelihood).backward()
        average_gradients(self.network)
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.description["clip"])
        # A step whose gradient is not finite is left out by the fused optimizer itself, without waiting for the device.
        self.optimizer.found_inf = (~norm.isfinite()).float()
        self.optimizer.step()
        return loss.detach(), error

    def save(self, folder: Path) -> None:
        """Weights and their mean in fp32, the optimizer's moments in bf16, in pieces.

        The moments are rounded here too, so that going on and resuming are the same.
        """
        for moments in self.optimizer.state.values():
            for name in ("exp_avg", "exp_avg_sq"):
                moments[name].copy_(moments[name].bfloat16())
        optimizer = self.optimizer.state_dict()

        def narrow(name: str, value: torch.Tensor) -> torch.Tensor:
            return value.bfloat16() if name in ("exp_avg", "exp_avg_sq") else value

        state = {
            "network": self.network.state_dict(),
            "mean": self.mean.state_dict(),
            "moments": {i: {n: narrow(n, v) for n, v in m.items()} for i, m in optimizer["state"].items()},
            "random": torch.get_rng_state(),
            "kind": self.description["network"],
            "width": self.description.get("width"),
            "dense": self.description.get("dense", False),
            "step": self.step,
            "seconds": self.seconds,
        }
        if self.device.type == "cuda":
            state["random_cuda"] = torch.cuda.get_rng_state()
        checkpoints.save(state, folder)

    def load(self, folder: Path) -> None:
        """Goes on where `save` left off; the random numbers too, unless the leg before ran on another kind of machine."""
        state = checkpoints.load(folder)
        if state["kind"] != self.description["network"]:
            raise ValueError(f"{folder}: expected a {self.description['network']}, found a {state['kind']}")
        self.network.load_state_dict(state["network"])
        self.mean.load_state_dict(state["mean"])
        optimizer = self.optimizer.state_dict()
        # Moments come back as fp32, since that is what the weights are.
        optimizer["state"] = state["moments"]
        self.optimizer.load_state_dict(optimizer)
        torch.set_rng_state(state["random"])
        if self.device.type == "cuda" and "random_cuda" in state:
            torch.cuda.set_rng_state(state["random_cuda"])
        elif self.device.type == "cuda":
            torch.manual_seed(state["step"])
        self.step, self.seconds = state["step"], state["seconds"]


@torch.no_grad()
def judged(network: nn.Module, held: HeldOut, bf16: bool) -> list[float]:
    """Mean end-point error at full resolution for each noise level, a quick look and not the card's figure."""
    errors = []
    network.eval()
    for level in JUDGED_LEVELS:
        older, newer = held.at(level)
        total = 0.0
        for i in range(0, len(older), 4):
            with torch.autocast(older.device.type, torch.bfloat16, enabled=bf16):
                flow, _ = network.weighed(network(older[i : i + 4], newer[i : i + 4])[0])[-1]
            full = F.interpolate(flow, size=older.shape[-2:], mode="bilinear", align_corners=False)
            total += (full - held.flow[i : i + 4]).norm(dim=1).mean((1, 2)).sum().item()
        errors.append(total / len(older))
    return errors


def waited(device: torch.device) -> float:
    """The clock, once the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.monotonic()


def made_at_once(run: Run, textures: Textures | Bank, crop: dict, ahead: int, kind: dict) -> list:
    """So many batches of a crop: a GPU makes eight of them in twice the time of one."""
    many = crop["batch"] * ahead
    made = batch_of(textures, crop["height"], crop["width"], run.noise(many), batch=many, recipe=run.recipe, **kind)
    return list(zip(*(part.split(crop["batch"]) for part in made)))


def leg(run: Run, folder: Path, packed: Path, minutes: float, every: float) -> None:
    """Trains for so many minutes; a log row and a checkpoint every `every` minutes and at the end."""
    called = time.monotonic()
    textures, first = Textures(packed, held_out=False), not dist.is_initialized() or dist.get_rank() == 0
    log = Log(folder / "log.csv", packed) if first else None
    if not first:  # Workers start from one checkpoint and must not draw the same scenes.
        torch.manual_seed(1000 * run.step + dist.get_rank())
    kind = {"mixture": run.description.get("displacements", MIXTURE)}
    kind |= {key: run.description[key] for key in ("shapes", "apart") if key in run.description}
    if "bank" in run.description:
        bank = run.description["bank"] | kind
        file = bank.pop("file", None)
        textures = Bank.kept(Path(file), textures, run.description["seed"], **bank) if file else Bank.made(textures, **bank)
    before, began, row_due, losses, over = run.seconds, time.monotonic(), run.seconds + 60 * every, [], False
    told, counted = began + 30, 0
    if first and run.step == 0:
        log.row(run, losses)
    made_for, batches, ahead = None, [], run.description.get("ahead", 1)
    while not over:
        crop = run.crop()
        # One step in fifty is timed part by part; the others are not waited for.
        timed = first and run.step % 50 == 20
        start = waited(run.device) if timed else 0.0
        if timed or not batches or made_for != crop:
            made_for, batches = crop, made_at_once(run, textures, crop, ahead, kind)
        made = waited(run.device) if timed else 0.0
        losses.append(run.train_step(*batches.pop()))
        if counted == 0:  # The schedule is one of training: what is compiled by the first step does not count.
            waited(run.device)
            began, told = time.monotonic(), time.monotonic() + 30
        counted += crop["batch"]
        if timed:
            end = waited(run.device)
            making, now = (made - start) / ahead, time.monotonic()
            share = making / (making + end - made)
            if now >= told:
                told = now + 60
                print(f"# {counted / (now - began):.1f} pairs/s; {100 * share:.0f} % of a step is spent making pairs", flush=True)
        seconds = before + time.monotonic() - began
        over, run.seconds = agreed(time.monotonic() - called >= 60 * minutes, seconds)
        over = over or run.progress() >= 1
        if first and (over or run.seconds >= row_due):
            log.row(run, losses)
            run.save(folder / "checkpoint")
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
        loss, train = (torch.stack(values).mean().item() for values in zip(*losses)) if losses else (math.nan, math.nan)
        row = [run.step, f"{run.seconds / 60:.2f}", f"{loss:.3f}", f"{train:.3f}"]
        row += [f"{e:.3f}" for e in judged(run.mean, self.held, run.description["bf16"])] + [f"{self.zero:.3f}", f"{run.rate():.2e}"]
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
    parser.add_argument("--recipe", choices=("clean", *RECIPES), help="instead of the description's; the run is then NAME_RECIPE")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if "WORLD_SIZE" in os.environ:
        dist.init_process_group("gloo" if arguments.device == "cpu" else "nccl")
        if arguments.device == "cuda":
            arguments.device = f"cuda:{os.environ['LOCAL_RANK']}"
    # Scenes and network are made where this says.
    torch.set_default_device(arguments.device)
    description, name = tomllib.loads(arguments.description.read_text()), arguments.description.stem
    if arguments.recipe:
        description |= {"clean": arguments.recipe == "clean", "recipe": arguments.recipe}
        name = f"{name}_{arguments.recipe}"
    run = Run(description)
    folder = Path("runs") / name
    folder.mkdir(parents=True, exist_ok=True)
    if arguments.resume and checkpoints.exists(folder / "checkpoint"):
        run.load(folder / "checkpoint")
    leg(run, folder, arguments.photographs, arguments.minutes, arguments.every)


if __name__ == "__main__":
    main()
