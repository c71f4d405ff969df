"""RAFT-small: shapes, gradients, the enlargement that begins as bilinear, and correlations where they belong."""

import pytest
import torch
import torch.nn.functional as F

from raft import HIDDEN, LEVELS, RADIUS, SIDE, RaftSmall, instance_norm


def test_shapes_and_every_parameter_learns():
    torch.manual_seed(0)
    network = RaftSmall(2)
    flows, expected = network(torch.rand(2, 3, 64, 128), torch.rand(2, 3, 64, 128))
    assert [tuple(f.shape) for f in flows] == [(2, 2, 16, 32)] * 2
    assert expected.shape == (2, 1, 16, 32) and (expected > 0).all()
    (sum(f.square().sum() for f in flows) + expected.sum()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        # An instance norm takes away the bias before it.
        biased = name.startswith("fnet") and name.endswith("bias") and name != "fnet.conv2.bias"
        # Weights of zero let nothing through to the layer before them in the first step.
        if not biased and not name.startswith("enlarge.0"):
            assert parameter.grad.abs().sum() > 0, name


def test_the_error_head_leaves_the_trunk_alone():
    network = RaftSmall(1)
    network(torch.rand(1, 3, 64, 64), torch.rand(1, 3, 64, 64))[1].sum().backward()
    assert {n.split(".")[0] for n, p in network.named_parameters() if p.grad is not None} == {"error"}


def test_a_flow_that_grows_evenly_is_enlarged_evenly():
    network = RaftSmall(1)
    y, x = torch.meshgrid(torch.arange(6.0), torch.arange(9.0), indexing="ij")
    # Cell i of an eighth is at pixel 8 i, cell j of a quarter at 4 j + 1.5.
    flow = torch.stack([0.1 * x - 0.2 * y, 0.3 * y])[None]
    quarter = network.quarter(flow, torch.zeros(1, HIDDEN, 6, 9))
    y, x = torch.meshgrid(torch.arange(12.0), torch.arange(18.0), indexing="ij")
    x, y = (4 * x + 1.5) / 8, (4 * y + 1.5) / 8
    wanted = 8 * torch.stack([0.1 * x - 0.2 * y, 0.3 * y])[None]
    inner = (..., slice(2, -2), slice(2, -2))
    torch.testing.assert_close(quarter[inner], wanted[inner], rtol=0, atol=0.01)


def test_correlations_are_read_around_where_a_point_went():
    torch.manual_seed(0)
    volumes = [torch.rand(2 * 8 * 8, 1, 8 >> level, 8 >> level) for level in range(LEVELS)]
    y, x = torch.meshgrid(torch.arange(8.0), torch.arange(8.0), indexing="ij")
    places = torch.stack([x, y]).repeat(2, 1, 1, 1)
    places[:, 0] += 1
    found = RaftSmall(1).look(volumes, places)
    assert found.shape == (2, LEVELS * SIDE * SIDE, 8, 8)
    # Second pair, row 3, column 4, moved one column on; two columns to the left and one row up of there.
    dx, dy = -2, -1
    place = (dx + RADIUS) * SIDE + dy + RADIUS
    assert found[1, place, 3, 4] == pytest.approx(volumes[0][64 + 3 * 8 + 4, 0, 3 + dy, 5 + dx].item(), abs=1e-5)


def test_published_weights_fit_or_are_refused(tmp_path):
    network = RaftSmall(1)
    state = {f"module.{n}": v + 1 for n, v in network.state_dict().items() if not n.startswith(("enlarge", "error"))}
    torch.save(state, tmp_path / "fits.pth")
    network.published(tmp_path / "fits.pth")
    assert torch.equal(network.fnet.conv1.weight, state["module.fnet.conv1.weight"])
    del state["module.fnet.conv1.weight"]
    torch.save(state, tmp_path / "lacks.pth")
    with pytest.raises(ValueError, match="fnet.conv1.weight"):
        network.published(tmp_path / "lacks.pth")


def test_the_norm_that_is_compiled_is_the_operator(monkeypatch):
    x = (3 * torch.randn(2, 5, 12, 20) + 7).requires_grad_()
    weight = torch.randn(2, 5, 12, 20)
    results = []
    for compiling in (False, True):
        monkeypatch.setattr(torch.compiler, "is_compiling", lambda compiling=compiling: compiling)
        y = instance_norm(x)
        results.append((y, *torch.autograd.grad((y * weight).sum(), x)))
    assert torch.allclose(results[1][0], F.instance_norm(x), atol=1e-5)
    for plain, written in zip(*results):
        assert torch.allclose(plain, written, atol=1e-5)
