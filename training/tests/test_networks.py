"""The network: shapes, gradients, and the fast cost volume against its definition."""

import pytest
import torch

from networks import LOOKS, SHIFT, STRIDE, PwcNet, columns, cost_volume, cost_volume_plain, doubled, halved, resized, twice


@pytest.mark.parametrize(
    "shape, tile, reach",
    [
        ((2, 32, 8, 48), 16, 4), ((2, 8, 6, 24), 8, 4), ((1, 5, 8, 12), None, 4), ((1, 5, 2, 3), None, 4), ((2, 6, 5, 32), 16, 2),
        # Rows that are no whole number of tiles, as where an input is an odd multiple of 32 wide.
        ((2, 8, 6, 20), 8, 4), ((1, 8, 4, 4), 8, 4), ((2, 6, 5, 40), 16, 2), ((1, 6, 5, 8), 16, 2), ((1, 3, 4, 17), 8, 4),
    ],
)
def test_fast_cost_volume_equals_the_plain_one(shape, tile, reach):
    torch.manual_seed(0)
    older, newer = (torch.randn(shape, dtype=torch.double, requires_grad=True) for _ in range(2))
    plain, fast = cost_volume_plain(older, newer, reach), cost_volume(older, newer, tile, reach)
    torch.testing.assert_close(fast, plain, rtol=0, atol=1e-12)
    weight = torch.randn_like(plain)
    wanted = torch.autograd.grad((plain * weight).sum(), (older, newer))
    got = torch.autograd.grad((fast * weight).sum(), (older, newer))
    for g, w in zip(got, wanted):
        torch.testing.assert_close(g, w, rtol=0, atol=1e-12)


def test_a_gpu_takes_whole_rows():
    assert [columns(level, torch.device("cpu")) for level in (2, 3, 4)] == [16, 8, None]
    assert [columns(level, torch.device("cuda")) for level in (2, 3, 4)] == [None, None, None]


def test_cost_volume_peaks_at_the_displacement():
    torch.manual_seed(0)
    older = torch.randn(1, 64, 16, 32)
    newer = older.roll((2, -3), (2, 3))
    best = cost_volume(older, newer, 16)[0, :, 6:10, 8:24].flatten(1).argmax(0)
    assert (best == (2 + 4) * 9 + (-3 + 4)).all()


def biased(name: str) -> bool:
    """Biases that an instance norm takes away."""
    return name.startswith("pyramid.encoder") and name.endswith("bias") or name == "pyramid.quarter.bias"


@pytest.mark.parametrize("height, width", [(32, 32), (96, 160)])
def test_inputs_are_multiples_of_the_stride(height, width):
    network = PwcNet().eval()
    with torch.no_grad():
        flows, expected = network(torch.rand(1, 3, height, width), torch.rand(1, 3, height, width))
    assert STRIDE == 32 and flows[0].shape == (1, 2, height // STRIDE, width // STRIDE)
    assert flows[-1].shape == (1, 2, height // 4, width // 4) and expected.shape == (1, 1, height // 4, width // 4)


@pytest.mark.parametrize("dense", [False, True])
def test_shapes_and_every_parameter_learns(dense):
    torch.manual_seed(0)
    network = PwcNet(dense=dense)
    flows, expected = network(torch.rand(2, 3, 64, 128), torch.rand(2, 3, 64, 128))
    levels = [level for level, looks in LOOKS.items() for _ in range(looks)] + [2]
    assert [tuple(f.shape) for f in flows] == [(2, 2, 64 >> level, 128 >> level) for level in levels]
    assert [tuple(e.shape) for e in expected] == [(2, 1, 8, 16), (2, 1, 16, 32)] and all((e > 0).all() for e in expected)
    (sum(f.square().sum() for f in flows) + sum(e.sum() for e in expected)).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        assert biased(name) or parameter.grad.abs().sum() > 0, name


def test_a_dense_body_reads_all_that_came_before():
    torch.manual_seed(0)
    plain, dense = PwcNet().decoder, PwcNet(dense=True).decoder
    # Volume, arg-max, context, flow, what is above; then what each convolution gave.
    read = lambda level: [layer.in_channels for layer in (*(unit[0] for unit in level.body), level.predict)]
    assert read(plain.shared) == [181, 128, 128, 96, 64, 32] and read(plain.fine) == [93, 64, 64, 32]
    assert read(dense.shared) == [181, 309, 437, 533, 597, 629] and read(dense.fine) == [93, 157, 221, 253]
    level, parts = dense.fine, [torch.randn(1, count, 4, 6) for count in (25, 2, 32, 2, 32)]
    found, features = level.layers(parts)
    seen = torch.cat(parts, 1)
    for layer in level.body:
        seen = torch.cat([seen, layer(seen)], 1)
    assert torch.equal(found, level.predict(seen)) and torch.equal(features, seen[:, -32:])
    # Else nothing differs, so that all around the levels is shaped alike.
    shapes = lambda decoder: {n: v.shape for n, v in decoder.state_dict().items() if "body" not in n and "predict" not in n}
    assert shapes(plain) == shapes(dense)


def test_dense_connections_double_the_parameters():
    count = lambda network: sum(parameter.numel() for parameter in network.parameters())
    assert (count(PwcNet()), count(PwcNet(dense=True))) == (885_644, 1_887_218)


@pytest.mark.parametrize("fast", [False, True])
def test_the_error_heads_leave_the_trunk_alone(fast):
    network = PwcNet(fast).eval()
    network(torch.rand(1, 3, 64, 64), torch.rand(1, 3, 64, 64))[1].sum().backward()
    touched = {name for name, p in network.named_parameters() if p.grad is not None}
    assert touched and all(name.startswith("decoder.fast_error." if fast else "decoder.error.") for name in touched)


def test_the_fast_network_is_the_same_up_to_level_3():
    torch.manual_seed(0)
    network, frames = PwcNet().eval(), torch.rand(2, 3, 64, 128)
    with torch.no_grad():
        full, _ = network(frames[:1], frames[1:])
        network.fast = True
        fast, expected = network(frames[:1], frames[1:])
    assert len(fast) == len(full) and expected.shape == (1, 1, 16, 32)
    for a, b in zip(fast[:-1], full[:-1]):
        assert torch.equal(a, b)
    assert torch.equal(fast[-1], 2 * twice(fast[-2]))


def test_features_of_a_frame_do_not_depend_on_its_partner():
    torch.manual_seed(0)
    network, frames = PwcNet().eval(), torch.rand(2, 3, 64, 64)
    with torch.no_grad():
        for together, alone in zip(network.pyramid(frames), network.pyramid(frames[:1])):
            torch.testing.assert_close(together[:1], alone, rtol=1e-4, atol=1e-5)


def test_cells_look_where_their_truth_is():
    """An evenly growing picture: every level's truth is its value where the level's cells look, and what is brought from
    one level to the next lies where the next one's cells look."""
    ramp = torch.arange(128.0).expand(1, 2, 64, 128)
    inner = (..., slice(1, -1))
    for level in (3, 4, 5):
        middle = SHIFT + 2 ** (level - 1) - 4 + 2**level * torch.arange(128 >> level)
        truth = PwcNet.truth(ramp, 2**level)
        assert truth.shape == (1, 2, 64 >> level, 128 >> level)
        # A window of an even number of pixels lies half a pixel beside.
        torch.testing.assert_close(truth[inner], (middle - 0.5).expand_as(truth)[inner])
    eighth = (SHIFT + 8 * torch.arange(16.0)).expand(1, 2, 8, 16)
    assert torch.equal(halved(eighth)[0, 0, 0], SHIFT + 4 + 16 * torch.arange(8.0))
    assert torch.equal(twice(eighth)[0, 0, 0, :-1], SHIFT + 4 * torch.arange(31.0))
    assert torch.equal(PwcNet.truth(ramp, 4)[0, 0, 0], 1.5 + 4 * torch.arange(32.0))


def test_what_is_resized_is_so_by_its_rule_and_gain():
    values = [torch.rand(1, count, 4, 6) for count in (2, 3)]
    for rule in (halved, doubled, twice):
        for gains in (None, (2.0, 1.0)):
            found = resized(rule, *values, gains=gains)
            for value, gain, found in zip(values, gains or (1.0, 1.0), found, strict=True):
                assert torch.equal(found, gain * rule(value))
    # A cell becomes four that lie evenly around it.
    torch.testing.assert_close(doubled(torch.tensor([[[[0.0, 4.0]]]])), torch.tensor([[[[0.0, 1.0, 3.0, 4.0]] * 2]]))


def test_published_weights_fit_or_are_refused(tmp_path):
    network = PwcNet()
    state = {f"module.fnet.{n}": v + 1 for n, v in network.pyramid.encoder.state_dict().items()}
    torch.save(state | {"module.cnet.other": torch.zeros(1)}, tmp_path / "fits.pth")
    network.published(tmp_path / "fits.pth")
    assert torch.equal(network.pyramid.encoder.conv1.weight, state["module.fnet.conv1.weight"])
    del state["module.fnet.conv1.weight"]
    torch.save(state, tmp_path / "lacks.pth")
    with pytest.raises(RuntimeError, match="conv1.weight"):
        network.published(tmp_path / "lacks.pth")
