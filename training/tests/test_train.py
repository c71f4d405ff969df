"""Training: a leg that is resumed equals one that went straight through, and the network does learn."""

import tomllib
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.nn.functional as F

import checkpoints
from networks import PwcNet
from pairs import HeldOut, batch_of
from scenes import Textures
from train import Run, agreed, average_gradients, judged, leg, loss_of, main

DESCRIPTION = {
    "seed": 1, "network": "pwcnet", "clean": False, "peak_rate": 6e-4, "warm_up_steps": 5, "weight_decay": 1e-4, "clip": 1.0,
    "mean_decay": 0.9, "bf16": False, "compile": False, "schedule": {"steps": 6},
    "crops": [
        {"from": 0.0, "height": 64, "width": 64, "batch": 2},
        {"from": 0.5, "height": 64, "width": 128, "batch": 1},
    ],
}


@pytest.fixture
def one_thread():
    """Sums in one order, so that two runs can be equal to the bit."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def steps(run: Run, textures: Textures, count: int) -> None:
    for _ in range(count):
        crop = run.crop()
        run.train_step(*batch_of(textures, crop["height"], crop["width"], run.noise(crop["batch"])))


def test_a_dense_network_is_trained_where_a_run_says_so(packed, tmp_path):
    run = Run(DESCRIPTION | {"dense": True})
    assert run.network.decoder.shared.dense and not Run(DESCRIPTION).network.decoder.shared.dense
    before = run.network.decoder.shared.predict.weight.clone()
    steps(run, Textures(packed, held_out=False), 1)
    assert not torch.equal(run.network.decoder.shared.predict.weight, before)
    run.save(tmp_path / "checkpoint")
    state = checkpoints.load(tmp_path / "checkpoint")
    assert state["dense"]
    PwcNet(dense=True).load_state_dict(state["mean"])


@pytest.mark.parametrize("network", ["pwcnet", "raftsmall"])
def test_a_run_starts_from_the_graphs_of_a_network(network):
    name = Path(__file__).parents[2] / "models" / f"{network}_fcdn"
    held = checkpoints.of_graphs(name)
    run = Run(DESCRIPTION | {"network": network, "iterations": 1, "start": str(name)})
    for key, value in run.network.state_dict().items():
        assert torch.equal(value, held[key]), key


def test_a_run_starts_from_no_other_networks_graphs():
    name = Path(__file__).parents[2] / "models" / "pwcnet_fcdn"
    with pytest.raises(ValueError, match="is unknown"):
        Run(DESCRIPTION | {"network": "raftsmall", "iterations": 1, "start": str(name)})
    with pytest.raises(FileNotFoundError, match="pwcnet_none"):
        Run(DESCRIPTION | {"start": str(name.with_name("pwcnet_none"))})


def test_resumed_equals_straight_through(packed, tmp_path, one_thread):
    textures = Textures(packed, held_out=False)
    straight = Run(DESCRIPTION)
    steps(straight, textures, 3)
    # Moments are rounded where a checkpoint is written, whether one goes on or resumes.
    straight.save(tmp_path / "passing")
    steps(straight, textures, 3)
    first = Run(DESCRIPTION)
    steps(first, textures, 3)
    first.save(tmp_path / "checkpoint")
    torch.manual_seed(99)
    second = Run(DESCRIPTION)
    second.load(tmp_path / "checkpoint")
    steps(second, textures, 3)
    assert second.step == straight.step == 6
    for kind in ("network", "mean"):
        wanted = getattr(straight, kind).state_dict()
        for name, value in getattr(second, kind).state_dict().items():
            assert torch.equal(value, wanted[name]), (kind, name)


def test_a_torn_checkpoint_is_named(tmp_path):
    state = {"network": {"weight": torch.arange(1000.0)}}
    checkpoints.save(state, tmp_path / "checkpoint", piece=1000)
    pieces = sorted((tmp_path / "checkpoint").iterdir())
    assert len(pieces) > 4 and all(piece.stat().st_size <= 1000 for piece in pieces)
    assert torch.equal(checkpoints.load(tmp_path / "checkpoint")["network"]["weight"], state["network"]["weight"])
    pieces[1].write_bytes(pieces[1].read_bytes()[:-1])
    with pytest.raises(ValueError, match="expected .* bytes with sha256"):
        checkpoints.load(tmp_path / "checkpoint")
    pieces[2].unlink()
    with pytest.raises(ValueError, match=r"without \[2\]"):
        checkpoints.load(tmp_path / "checkpoint")
    with pytest.raises(ValueError, match="at most 8 pieces"):
        checkpoints.save(state, tmp_path / "checkpoint", piece=300)


def test_the_schedule_warms_up_and_falls(packed):
    run = Run(DESCRIPTION)
    assert run.rate() == pytest.approx(6e-4 / 5)
    run.step = 5
    assert run.crop()["width"] == 128 and 6e-6 < run.rate() < 1e-4
    run.step = 6
    assert run.rate() == pytest.approx(6e-6)


@pytest.mark.parametrize("description", sorted(Path(__file__).parents[1].glob("*.toml")), ids=lambda path: path.name)
def test_every_description_makes_a_run(description):
    if description.name == "pyproject.toml":
        return
    known = tomllib.loads(description.read_text())
    leg = {"start"} if description.stem.endswith("_leg") else set()
    own = {"pwcnet": {"start"}, "upsampler": {"start"}, "raftsmall": {"iterations", "start"}}.get(known["network"], {"width"} | leg)
    extra = {"dense", "darkest", "towards_bright", "displacements", "recipe", "bank", "shapes", "apart", "ahead", "only", "pixels", "graph"}
    assert set(known) - extra == set(DESCRIPTION) | own, "the same keys as every run"
    known.pop("start", None)
    run = Run(known)
    assert run.crop()["height"] % 64 == 0 and run.crop()["width"] % 64 == 0 and run.progress() == 0


def test_minutes_make_a_schedule_too():
    run = Run(DESCRIPTION | {"schedule": {"minutes": 2}})
    run.seconds = 30.0
    assert run.progress() == 0.25
    run.seconds = 500.0
    assert run.progress() == 1.0


def test_a_leg_writes_its_log_and_a_checkpoint(packed, tmp_path):
    run = Run(DESCRIPTION | {"schedule": {"steps": 2}})
    leg(run, tmp_path, packed, minutes=10, every=10)
    heading, first, row = (tmp_path / "log.csv").read_text().splitlines()
    assert heading.startswith("step,minutes,loss") and first.startswith("0,") and row.startswith("2,")
    assert len(row.split(",")) == len(heading.split(","))
    again = Run(DESCRIPTION)
    again.load(tmp_path / "checkpoint")
    assert again.step == 2


def test_a_leg_may_make_several_batches_ahead_and_keep_a_bank_to_itself(packed, tmp_path):
    bank = {"count": 4, "height": 64, "width": 128}
    run = Run(DESCRIPTION | {"schedule": {"steps": 5}, "ahead": 3, "bank": bank, "shapes": 2, "apart": [[0.5, 8.0, 16.0]]})
    given, step = [], run.train_step
    run.train_step = lambda *pairs: given.append(pairs) or step(*pairs)
    leg(run, tmp_path, packed, minutes=10, every=10)
    assert [tuple(older.shape) for older, _, _ in given] == 3 * [(2, 3, 64, 64)] + 2 * [(1, 3, 64, 128)]
    assert not torch.equal(given[0][0], given[1][0]) and run.step == 5


def test_a_run_may_train_the_error_heads_alone(packed, tmp_path):
    run = Run(DESCRIPTION | {"only": ["decoder.error."], "schedule": {"steps": 2}})
    before = {name: value.clone() for name, value in run.network.state_dict().items()}
    leg(run, tmp_path, packed, minutes=10, every=10)
    for kept in (run.network.state_dict(), checkpoints.load(tmp_path / "checkpoint")["mean"]):
        moved = {name for name, value in kept.items() if not torch.equal(value, before[name])}
        assert moved == {name for name in before if name.startswith("decoder.error.")}


def test_a_step_whose_gradient_is_not_finite_is_left_out(packed):
    run = Run(DESCRIPTION)
    pairs = batch_of(Textures(packed, held_out=False), 64, 64, run.noise(2))
    run.train_step(*pairs)
    before = {name: value.clone() for name, value in run.network.state_dict().items()}
    torn = pairs[2].clone()
    torn[0, 0, 0, 0] = torch.nan
    run.train_step(*pairs[:2], torn)
    assert all(torch.equal(value, before[name]) for name, value in run.network.state_dict().items())
    run.train_step(*pairs)
    after = run.network.state_dict()
    assert all(value.isfinite().all() for value in after.values()) and any(not torch.equal(after[n], v) for n, v in before.items())


def test_a_leg_from_a_checkpoint_by_another_recipe_out_of_a_bank(packed, tmp_path, monkeypatch, one_thread):
    monkeypatch.chdir(tmp_path)
    lines = [f"{key} = {toml(value)}" for key, value in (DESCRIPTION | {"schedule": {"steps": 2}, "clean": True}).items()]
    whole = "\n".join([*lines, 'bank = { file = "runs/bank.pt", count = 4, height = 64, width = 128 }'])
    (tmp_path / "bright.toml").write_text(whole)
    (tmp_path / "leg.toml").write_text(whole + '\nstart = "runs/bright/checkpoint"')
    given = ["--photographs", str(packed), "--minutes", "10", "--every", "10", "--threads", "1", "--device", "cpu", "--resume"]
    for arguments in (["bright.toml"], ["leg.toml", "--recipe", "authors-2021"], ["leg.toml", "--recipe", "clean"]):
        monkeypatch.setattr("sys.argv", ["train.py", *arguments, *given])
        main()
    start = checkpoints.load(tmp_path / "runs" / "bright" / "checkpoint")["mean"]
    begun = Run(tomllib.loads((tmp_path / "leg.toml").read_text()))
    assert all(torch.equal(value, start[key]) for key, value in begun.network.state_dict().items())
    ended = [checkpoints.load(tmp_path / "runs" / f"leg_{name}" / "checkpoint") for name in ("authors-2021", "clean")]
    assert [state["step"] for state in ended] == [2, 2]
    # Another recipe is another run.
    assert any(not torch.equal(value, ended[1]["mean"][key]) for key, value in ended[0]["mean"].items())


def toml(value) -> str:
    """What a description may hold, as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(inner)}" for key, inner in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return {True: "true", False: "false"}[value] if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else repr(value)


def test_ten_pairs_are_learned_by_heart(packed):
    torch.manual_seed(4)
    pairs = batch_of(Textures(packed, held_out=False), 64, 64, torch.full((10,), 3.0), ((1.0, 0.5, 3.0),))
    run = Run(DESCRIPTION | {"peak_rate": 2e-3, "weight_decay": 0.0, "schedule": {"steps": 200}})
    zero = pairs[2].norm(dim=1).mean().item()
    for _ in range(200):
        _, error = run.train_step(*pairs)
    assert zero > 1.0 and error < 0.1, (zero, error)


def test_raft_learns_a_few_pairs(packed):
    torch.manual_seed(4)
    pairs = batch_of(Textures(packed, held_out=False), 64, 64, torch.full((2,), 5.0))
    run = Run(DESCRIPTION | {"network": "raftsmall", "iterations": 3, "peak_rate": 1e-3, "schedule": {"steps": 120}})
    zero = pairs[2].norm(dim=1).mean().item()
    for _ in range(90):
        _, error = run.train_step(*pairs)
    assert zero > 1.0 and error < 0.4 * zero, (zero, error)


def test_judging_does_not_move_the_random_state(packed):
    network, held = Run(DESCRIPTION).mean, HeldOut(packed, count=2, height=64, width=64)
    before = torch.get_rng_state()
    assert len(judged(network, held, bf16=False)) == 5
    assert torch.equal(before, torch.get_rng_state())


def worker(rank: int, meeting: str) -> None:
    """One of two workers whose gradients are 1 and 3 everywhere."""
    dist.init_process_group("gloo", init_method=meeting, rank=rank, world_size=2)
    network = torch.nn.Linear(3, 2)
    for parameter in network.parameters():
        parameter.grad = torch.full_like(parameter, 1.0 + 2.0 * rank)
    average_gradients(network)
    assert all((p.grad == 2.0).all() for p in network.parameters())
    assert agreed(rank == 0, 7.0 + rank) == (True, 7.0)
    dist.destroy_process_group()


def test_two_workers_agree(tmp_path):
    torch.multiprocessing.spawn(worker, (f"file://{tmp_path}/meeting",), nprocs=2)


def test_a_flow_may_be_judged_at_every_pixel():
    truth = torch.zeros(1, 2, 64, 64)
    truth[:, 0, :, 30:] = 8.0
    cells = F.avg_pool2d(truth, 4)
    one_side = cells.clone()
    one_side[:, 0, :, 7] = 8.0
    flows = lambda last: [torch.zeros(1, 2, 64 // 2**level, 64 // 2**level) for level in (5, 4, 3, 3)] + [last / 4]
    expected = torch.ones(1, 1, 16, 16)
    last = lambda flow, pixels: loss_of(PwcNet, flows(flow), expected, truth, pixels)[2].item()
    assert last(cells, False) < 2e-3 < last(one_side, False), "the mean over the cell is what is asked"
    # Between cells the flow is bilinear: 8 px on one side of column 30 and none on the other can't be told exactly.
    off = (F.interpolate(one_side, scale_factor=4, mode="bilinear") - truth).norm(dim=1).mean().item()
    assert last(one_side, True) == pytest.approx(off, abs=2e-3)
