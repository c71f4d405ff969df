"""The network: shapes, gradients, and the fast cost volume against its definition."""

import pytest
import torch

from networks import PwcNet, levels_from, cost_volume, cost_volume_plain


@pytest.mark.parametrize(
    "shape, tile", [((2, 32, 8, 48), 16), ((2, 8, 6, 24), 8), ((1, 5, 8, 12), None), ((1, 5, 2, 3), None)]
)
def test_fast_cost_volume_equals_the_plain_one(shape, tile):
    torch.manual_seed(0)
    older, newer = (torch.randn(shape, dtype=torch.double, requires_grad=True) for _ in range(2))
    plain, fast = cost_volume_plain(older, newer), cost_volume(older, newer, tile)
    torch.testing.assert_close(fast, plain, rtol=0, atol=1e-12)
    weight = torch.randn_like(plain)
    wanted = torch.autograd.grad((plain * weight).sum(), (older, newer))
    got = torch.autograd.grad((fast * weight).sum(), (older, newer))
    for g, w in zip(got, wanted):
        torch.testing.assert_close(g, w, rtol=0, atol=1e-12)


def test_cost_volume_peaks_at_the_displacement():
    torch.manual_seed(0)
    older = torch.randn(1, 64, 16, 32)
    newer = older.roll((2, -3), (2, 3))
    best = cost_volume(older, newer, 16)[0, :, 6:10, 8:24].flatten(1).argmax(0)
    assert (best == (2 + 4) * 9 + (-3 + 4)).all()


@pytest.mark.parametrize("coarsest", [4, 6])
def test_shapes_and_every_parameter_learns(coarsest):
    torch.manual_seed(0)
    network = PwcNet(coarsest)
    flows, expected = network(torch.rand(2, 3, 64, 128), torch.rand(2, 3, 64, 128))
    assert [tuple(f.shape) for f in flows] == [(2, 2, 64 >> level, 128 >> level) for level in levels_from(coarsest)]
    assert expected.shape == (2, 1, 16, 32) and (expected > 0).all()
    (sum(f.square().sum() for f in flows) + expected.sum()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().sum() > 0, name


def test_the_error_head_leaves_the_trunk_alone():
    network = PwcNet()
    network(torch.rand(1, 3, 64, 64), torch.rand(1, 3, 64, 64))[1].sum().backward()
    touched = {name for name, p in network.named_parameters() if p.grad is not None}
    assert touched and all(name.startswith("decoder.error.") for name in touched)


def test_features_of_a_frame_do_not_depend_on_its_partner():
    torch.manual_seed(0)
    network, frames = PwcNet().eval(), torch.rand(2, 3, 64, 64)
    with torch.no_grad():
        for together, alone in zip(network.pyramid(frames), network.pyramid(frames[:1])):
            torch.testing.assert_close(together[:1], alone, rtol=1e-4, atol=1e-5)
