"""The upsampler: begins as bilinear interpolation, stays within what cells say, learns edges, leaves its network alone."""

import tomllib
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
import torch.nn.functional as F

import checkpoints
import export
from export import Exported, UpsamplerGraph, moved, upsampler_graph, with_upsampler
from networks import PwcNet
from upsampler import REACH, Upsampled, Upsampler, around, asinh

MODELS = Path(__file__).parents[2] / "models"


def untaught() -> Upsampler:
    """One whose weights depend on nothing that it sees."""
    torch.manual_seed(0)
    upsampler = Upsampler().eval()
    torch.nn.init.zeros_(upsampler.weights.weight)
    return upsampler


def test_asinh_is_as_torch_has_it():
    values = torch.tensor([-300.0, -2.0, -1e-3, 0.0, 1e-3, 0.5, 90.0], dtype=torch.float64)
    torch.testing.assert_close(asinh(values), torch.asinh(values))


def test_it_begins_as_bilinear_interpolation():
    rows, columns = torch.meshgrid(torch.arange(12.0), torch.arange(16.0), indexing="ij")
    flow = torch.stack([0.5 * columns - 0.2 * rows, 3 - 0.1 * columns])[None]
    full, expected = untaught()(torch.rand(1, 3, 48, 64), flow, torch.ones(1, 1, 12, 16))
    bilinear = F.interpolate(flow, scale_factor=4, mode="bilinear")
    # Two cells from the edge no repeated cell is read, and what the least weights mix in lies around.
    inside = (..., slice(8, -8), slice(8, -8))
    assert (full - bilinear)[inside].abs().max() < 0.02
    torch.testing.assert_close(expected, torch.ones(1, 1, 48, 64))


def test_a_vector_lies_within_those_of_the_cells_around():
    torch.manual_seed(1)
    flow, error = torch.randn(2, 2, 8, 8) * 20, torch.rand(2, 1, 8, 8) + 0.1
    full, expected = Upsampler()(torch.rand(2, 3, 32, 32), flow, error)
    for values, found in ((flow, full), (error, expected)):
        near = around(values, REACH)
        low, high = (F.interpolate(bound, scale_factor=4, mode="nearest") for bound in (near.amin(1), near.amax(1)))
        assert (found >= low - 1e-4).all() and (found <= high + 1e-4).all()


def test_an_edge_that_the_frame_shows_is_learned():
    torch.manual_seed(2)
    upsampler = Upsampler()
    optimizer = torch.optim.Adam(upsampler.parameters(), 1e-3)

    def halves():
        """Two colours that move apart; the edge is anywhere, and the cells' vectors are means over cells."""
        edge = torch.randint(20, 44, (4,))
        left = (torch.arange(64)[None] < edge[:, None]).float()[:, None, None].expand(-1, 1, 64, 64)
        truth = torch.cat([8 * left - 4, torch.zeros_like(left)], 1)
        image = (0.2 + 0.5 * left).expand(-1, 3, -1, -1) + 0.02 * torch.randn(4, 3, 64, 64)
        return image, F.avg_pool2d(truth, 4), truth

    def error():
        image, flow, truth = halves()
        full, _ = upsampler(image, flow, torch.ones_like(flow[:, :1]))
        return (full - truth).abs().mean(), (F.interpolate(flow, scale_factor=4, mode="bilinear") - truth).abs().mean()

    for _ in range(200):
        optimizer.zero_grad()
        error()[0].backward()
        torch.nn.utils.clip_grad_norm_(upsampler.parameters(), 1.0)
        optimizer.step()
    learned, bilinear = (torch.stack(values).mean() for values in zip(*(error() for _ in range(8))))
    assert learned < 0.4 * bilinear


def test_the_network_behind_it_stays_as_it_is():
    torch.manual_seed(3)
    network = Upsampled()
    flows, expected = network(*(torch.rand(1, 3, 64, 64) for _ in range(2)))
    assert flows[-1].shape == (1, 2, 64, 64) and expected.shape == (1, 1, 64, 64)
    flows[-1].abs().sum().backward()
    moving = {name for name, parameter in network.named_parameters() if parameter.grad is not None}
    assert moving == {name for name, _ in network.named_parameters() if name.startswith("upsampler.")}
    # It brings the very flow of the network to every pixel, in pixels of the image.
    pair = [torch.rand(1, 3, 64, 64) for _ in range(2)]
    alone = PwcNet().eval()
    alone.load_state_dict({n: v for n, v in network.state_dict().items() if not n.startswith("upsampler.")})
    with torch.no_grad():
        quarter = 4 * alone(*pair)[0][-1]
        full = network.eval()(*pair)[0][-1]
    low, high = quarter.amin((2, 3)), quarter.amax((2, 3))
    assert (full.amin((2, 3)) >= low - 1e-4).all() and (full.amax((2, 3)) <= high + 1e-4).all()


@pytest.mark.parametrize("height, width", [(64, 64), (96, 160), (256, 320)])
def test_the_graph_equals_pytorch(height, width, tmp_path):
    torch.manual_seed(4)
    upsampler = Upsampler().eval()
    graph = upsampler_graph(upsampler).SerializeToString()
    export.rounded(upsampler)
    rows, columns = height // 4, width // 4
    given = [torch.rand(1, 3, height, width), torch.randn(1, rows, columns, 2) * 9, torch.rand(1, rows, columns) + 0.05]
    with torch.no_grad():
        wanted = UpsamplerGraph(upsampler)(*given)
    found = export.session(graph).run(UpsamplerGraph.outputs, dict(zip(UpsamplerGraph.inputs, (g.numpy() for g in given))))
    for one, other in zip(found, wanted):
        np.testing.assert_allclose(one, other.numpy(), atol=1e-4)


def test_an_entry_takes_it_and_takes_another_in_its_place(tmp_path):
    entry = '[one]\nkind = "pyramid_decoder"\n[one.pyramid]\nfile = "a"\n[one.golden]\nheight = 128\n'
    for content in (b"first", b"second"):
        (tmp_path / "upsampler_one.onnx").write_bytes(content)
        entry = with_upsampler(entry, "one", tmp_path / "upsampler_one.onnx")
    held = tomllib.loads(entry)["one"]
    assert held["upsampler"] == {"file": "upsampler_one.onnx", "sha256": export.hashlib.sha256(b"second").hexdigest()}
    assert held["pyramid"] == {"file": "a"} and held["golden"] == {"height": 128} and held["kind"] == "pyramid_decoder"


@pytest.mark.parametrize("name", ["pwcnet_fcdn", "pwcnet_clean"])
def test_the_committed_ones_are_no_part_of_their_network_and_keep_within_its_flow(name):
    entry = tomllib.loads((MODELS / "manifest.toml").read_text())[name]
    assert not any(key.startswith("upsampler.") for key in checkpoints.of_graphs(MODELS / name))
    file = MODELS / entry["upsampler"]["file"]
    assert onnx.load(file).opset_import[0].version == export.OPSET
    parts = (str(MODELS / entry[part]["file"]) for part in ("pyramid", "decoder"))
    exported = Exported(*parts, upsampler=str(file))
    older, newer = moved(128, 192, 1)
    flow, error = exported(older, newer)
    full, expected = exported.full(older, flow, error)
    assert full.shape == (1, 128, 192, 2) and expected.shape == (1, 128, 192)
    assert flow.min() - 1e-4 <= full.min() and full.max() <= flow.max() + 1e-4
    assert error.min() - 1e-4 <= expected.min() and expected.max() <= error.max() + 1e-4
