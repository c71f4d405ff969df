"""FlowNetS and FlowNetC: shapes, gradients, halves and correlation by definition, graphs, and that they learn."""

import sys
import tomllib

import numpy as np
import onnx
import pytest
import torch
import torch.nn.functional as F

import checkpoints
import export
from export import FRAMES, Exported, gigamacs, golden_frames, graphs_of, rounded
from flownet import KINDS, REACH, SHIFT, FlowNetS, even, slim
from networks import cost_volume, cost_volume_plain
from pairs import batch_of
from scenes import Textures
# It is run here once more, with this file's `fresh` networks.
from test_export import test_graphs_equal_pytorch  # noqa: F401
from train import Run, start

DESCRIPTION = {
    "seed": 1, "network": "flownets", "width": 0.125, "clean": False, "peak_rate": 1e-3, "warm_up_steps": 5,
    "weight_decay": 0.0, "clip": 1.0, "mean_decay": 0.9, "bf16": False, "compile": False, "schedule": {"steps": 6},
    "crops": [{"from": 0.0, "height": 64, "width": 64, "batch": 2}],
}


@pytest.fixture(params=KINDS)
def network(request):
    """A slim untrained network of each kind."""
    torch.manual_seed(0)
    return KINDS[request.param](0.125)


@pytest.mark.parametrize("height, width", [(64, 64), (64, 192), (128, 128)])
def test_shapes_and_every_parameter_learns(network, height, width):
    flows, expected = network(torch.rand(2, 3, height, width), torch.rand(2, 3, height, width))
    assert [tuple(f.shape) for f in flows] == [(2, 2, height >> level, width >> level) for level in (6, 5, 4, 3, 2)]
    assert expected.shape == (2, 1, height // 4, width // 4) and (expected > 0).all()
    (sum(f.square().sum() for f in flows) + expected.sum()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().sum() > 0, name


def test_the_error_head_leaves_the_trunk_alone(network):
    network(torch.rand(1, 3, 64, 64), torch.rand(1, 3, 64, 64))[1].sum().backward()
    touched = {name for name, parameter in network.named_parameters() if parameter.grad is not None}
    assert touched and all(name.startswith("decoder.error.") for name in touched)


def test_channels_are_the_published_ones_at_full_width_and_slim_below():
    assert [slim(1.0, n) for n in (64, 1024)] == [64, 1024]
    assert [slim(0.25, n) for n in (32, 64, 128, 512, 1024)] == [16, 16, 32, 128, 256]
    # The published network has 38.7 million parameters; ours has an error head too.
    published = sum(p.numel() for name, p in FlowNetS(1.0).named_parameters() if ".error." not in name)
    assert published == pytest.approx(38.7e6, rel=2e-3)


def test_halves_of_the_first_layer_are_one_layer_over_both_frames():
    torch.manual_seed(0)
    network, (older, newer) = FlowNetS(0.125), torch.rand(2, 1, 3, 64, 128)
    first, second = network.pyramid.first, network.pyramid.second
    both = F.conv2d(
        torch.cat([even(older), even(newer)], 1), torch.cat([first.weight, second.weight], 1), first.bias, 2, 3
    )
    torch.testing.assert_close(network.pyramid(older)[0] + network.pyramid(newer)[1], both, rtol=1e-4, atol=1e-5)


def test_correlation_equals_its_definition_with_its_gradient():
    torch.manual_seed(0)
    older, newer = (torch.randn(2, 5, 8, 24, dtype=torch.double, requires_grad=True) for _ in range(2))
    fast, plain = cost_volume(older, newer, None, REACH), cost_volume_plain(older, newer, REACH)
    assert fast.shape == (2, 441, 8, 24)
    torch.testing.assert_close(fast, plain, rtol=0, atol=1e-12)
    # Seven columns on and two rows up from row 5, column 3.
    place = (-2 + REACH) * (2 * REACH + 1) + 7 + REACH
    torch.testing.assert_close(fast[1, place, 5, 3], older[1, :, 5, 3] @ newer[1, :, 3, 10] / 5, rtol=0, atol=1e-12)
    weight = torch.randn_like(plain)
    wanted, got = (torch.autograd.grad((volume * weight).sum(), (older, newer)) for volume in (plain, fast))
    for g, w in zip(got, wanted):
        torch.testing.assert_close(g, w, rtol=0, atol=1e-12)


def test_cells_look_where_their_truth_is():
    """An evenly growing flow: every level's truth is its value where the level's cells look, and so is what the next
    level begins with."""
    ramp = torch.arange(256.0).expand(1, 2, 64, 256)
    truths = {}
    for level in (2, 3, 4, 5, 6):
        truths[level] = FlowNetS.truth(ramp, 2**level)
        assert truths[level].shape == (1, 2, 64 >> level, 256 >> level)
        # A window of an even number of pixels lies half a pixel beside.
        looked = SHIFT - 0.5 + 2**level * torch.arange(256 >> level)
        torch.testing.assert_close(truths[level][..., 1:], looked[1:].expand_as(truths[level][..., 1:]))
    enlarged = FlowNetS(0.125).decoder.enlarge["4"](truths[5])
    torch.testing.assert_close(enlarged[..., :-1, 2:-1], truths[4][..., :-1, 2:-1])


def test_a_frames_brightness_and_contrast_do_not_matter(network):
    older, newer = torch.rand(2, 1, 3, 64, 64)
    with torch.no_grad():
        (*_, one), _ = network.eval()(older, newer)
        (*_, other), _ = network(0.5 * older + 0.1, newer)
    torch.testing.assert_close(one, other, rtol=0, atol=0.02 * one.abs().max().item())


@pytest.fixture(scope="module", params=KINDS)
def fresh(request):
    """A network of each kind and its graphs; no two of its biases are alike, or the graphs would hold them once."""
    torch.manual_seed(0)
    network = KINDS[request.param](0.25).eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.003 * torch.randn_like(parameter))
    graphs = {part: graph.SerializeToString() for part, graph in graphs_of(network).items()}
    return rounded(network), graphs, Exported(graphs["pyramid"], graphs["decoder"], threads=1)


def test_graphs_keep_to_the_interface(fresh):
    network, graphs, exported = fresh
    assert list(graphs) == ["pyramid", "decoder"] and exported.names == network.features
    for name, feature in exported.features(golden_frames()[0]).items():
        assert feature.shape[2:] == (128 >> int(name[-1]), 192 >> int(name[-1]))
    read = [i.name for i in exported.decoder.get_inputs()]
    assert read == [*network.reads, "scale"]
    assert set(network.reads) <= {f"{frame}_{name}" for frame in FRAMES for name in network.features}
    for graph in graphs.values():
        model = onnx.load_from_string(graph)
        assert [(o.domain, o.version) for o in model.opset_import] == [("", export.OPSET)]
        large = [t for t in model.graph.initializer if np.prod(t.dims) > 1024]
        assert large and all(t.data_type == onnx.TensorProto.FLOAT16 for t in large)
    (flow, error), (scaled, same) = exported(*golden_frames()), exported(*golden_frames(), scale=(2.0, 3.0))
    np.testing.assert_allclose(scaled, flow * np.array([2, 3], np.float32), rtol=1e-5)
    np.testing.assert_array_equal(error, same)
    assert flow.shape == (1, 32, 48, 2) and error.shape == (1, 32, 48)


def test_multiply_adds_count_transposed_layers_too(fresh, tmp_path):
    network, graphs, _ = fresh
    for part, graph in graphs.items():
        (tmp_path / part).write_bytes(graph)
    total = 0

    def count(layer, given, came):
        nonlocal total
        cells = given[0] if isinstance(layer, torch.nn.ConvTranspose2d) else came
        total += layer.weight.numel() * cells[0, 0].numel()

    layers = [m for m in network.modules() if isinstance(m, (torch.nn.Conv2d, torch.nn.ConvTranspose2d))]
    hooks = [layer.register_forward_hook(count) for layer in layers]
    with torch.no_grad():
        image = torch.rand(1, 3, 256, 320)
        features = dict(zip(network.features, network.pyramid(image)))
        network.decoder(*(features[name.split("_", 1)[1]] for name in network.reads))
    for hook in hooks:
        hook.remove()
    assert gigamacs(tmp_path / "pyramid", tmp_path / "decoder") == pytest.approx(total / 1e9, rel=1e-6)


def test_start_from_graphs_and_from_nothing_else(fresh, tmp_path):
    network, graphs, _ = fresh
    for part, graph in graphs.items():
        (tmp_path / f"name_{part}.onnx").write_bytes(graph)
    other = type(network)(0.25).eval()
    assert set(checkpoints.of_graphs(tmp_path / "name")) >= set(dict(other.named_parameters()))
    start(other, str(tmp_path / "name"))
    pair = [torch.from_numpy(frame) for frame in golden_frames()]
    with torch.no_grad():
        assert torch.equal(other(*pair)[0][-1], network(*pair)[0][-1])
    with pytest.raises(ValueError, match="for research alone"):
        start(other, "flownet.pth")


def test_resumed_equals_straight_through_and_is_exported_at_its_width(packed, tmp_path, monkeypatch):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    textures = Textures(packed, held_out=False)

    def steps(run: Run, count: int) -> None:
        for _ in range(count):
            run.train_step(*batch_of(textures, 64, 64, run.noise(2)))

    straight, second = Run(DESCRIPTION), Run(DESCRIPTION)
    steps(straight, 2)
    straight.save(tmp_path / "checkpoint")
    steps(straight, 2)
    second.load(tmp_path / "checkpoint")
    steps(second, 2)
    torch.set_num_threads(threads)
    for name, value in second.network.state_dict().items():
        assert torch.equal(value, straight.network.state_dict()[name]), name
    models = tmp_path / "models"
    given = [str(tmp_path / "checkpoint"), "--name", "flownets_new", "--version", "1", "--models", str(models)]
    monkeypatch.setattr(sys, "argv", ["export.py", *given])
    export.main()
    entry = tomllib.loads((models / "manifest.toml").read_text())["flownets_new"]
    assert "fused" not in entry and (models / entry["decoder"]["file"]).stat().st_size < 3_000_000


def test_an_unknown_recipe_or_network_is_refused():
    assert Run(DESCRIPTION | {"recipe": "unprocess"}).noise(2) is None
    assert Run(DESCRIPTION | {"recipe": "unprocess", "clean": True}).recipe == "paper"
    with pytest.raises(ValueError, match="expected the recipe paper, authors-2021 or unprocess, found authors"):
        Run(DESCRIPTION | {"recipe": "authors"})
    with pytest.raises(ValueError, match="pwcnet, upsampler, raftsmall, flownets or flownetc, found flownet2"):
        Run(DESCRIPTION | {"network": "flownet2"})


@pytest.mark.parametrize("kind", KINDS)
def test_a_few_pairs_are_learned_by_heart(packed, kind):
    torch.manual_seed(4)
    pairs = batch_of(Textures(packed, held_out=False), 64, 64, torch.full((4,), 3.0), ((1.0, 0.5, 6.0),))
    run = Run(DESCRIPTION | {"network": kind, "schedule": {"steps": 70}})
    zero = pairs[2].norm(dim=1).mean().item()
    for _ in range(70):
        _, error = run.train_step(*pairs)
    assert zero > 1.0 and error < 0.5 * zero, (zero, error)
