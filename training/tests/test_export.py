"""Export: graphs equal PyTorch at every size, and the committed files are what the manifest says."""

import hashlib
import tomllib
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

import checkpoints
import dense
import int8
from export import (GOLDEN_COLUMNS, GOLDEN_ROWS, OPSET, USUAL_STRIDE, Exported, gigamacs, golden_frames, graphs_of,
                    manifest_entry, moved, parity, rounded, write_manifest)
from flownet import FlowNetS
from networks import STRIDE, PwcNet
from raft import RaftSmall

MODELS = Path(__file__).parents[2] / "models"


NETWORKS = {
    "pwcnet": PwcNet,
    "fast": lambda: PwcNet(fast=True),
    "dense": lambda: PwcNet(dense=True),
    "raft": lambda: RaftSmall(2),
}


@pytest.fixture(scope="module", params=NETWORKS)
def fresh(request):
    """An untrained network of every kind and its graphs."""
    torch.manual_seed(0)
    network = NETWORKS[request.param]().eval()
    graphs = {part: graph.SerializeToString() for part, graph in graphs_of(network).items()}
    return rounded(network), graphs, Exported(graphs["pyramid"], graphs["decoder"])


@pytest.mark.parametrize("height, width", [(64, 64), (128, 192), (256, 320), (448, 640)])
def test_graphs_equal_pytorch(fresh, height, width):
    network, _, exported = fresh
    assert parity(network, exported, *moved(height, width, 1)) < 1e-3
    random = np.random.default_rng(0)
    assert parity(network, exported, *(random.random((1, 3, height, width), np.float32) for _ in range(2))) < 1e-3


# The other networks take multiples of 64.
@pytest.mark.parametrize("fresh", ["pwcnet", "fast", "dense"], indirect=True)
@pytest.mark.parametrize("height, width", [(96, 64), (128, 160), (32, 96)])
def test_a_pwcnet_takes_multiples_of_32(fresh, height, width):
    assert height % STRIDE == width % STRIDE == 0
    test_graphs_equal_pytorch(fresh, height, width)


def test_plain_graphs_have_no_operators_of_the_nodes_own():
    graphs = graphs_of(PwcNet().eval(), plain=True)
    assert list(graphs) == ["pyramid", "decoder"]
    assert {node.domain for graph in graphs.values() for node in graph.graph.node} == {""}


def test_int8_graphs_stay_near_and_come_with_a_manifest(packed, tmp_path, monkeypatch):
    torch.manual_seed(0)
    for part, graph in graphs_of(FlowNetS(0.125).eval()).items():
        (tmp_path / f"small_{part}.onnx").write_bytes(graph.SerializeToString())
    given = ["--name", "small", "--models", str(tmp_path), "--photographs", str(packed), "--count", "2", "--keep", "predict"]
    monkeypatch.setattr("sys.argv", ["int8.py", str(tmp_path / "int8"), *given])
    int8.main()
    entry = tomllib.loads((tmp_path / "int8" / "manifest.toml").read_text())["small_int8"]
    files = [tmp_path / "int8" / entry[part]["file"] for part in ("pyramid", "decoder")]
    assert all("QuantizeLinear" in {node.op_type for node in onnx.load(file).graph.node} for file in files)
    pair = golden_frames()
    plain = Exported(*(str(tmp_path / f"small_{part}.onnx") for part in ("pyramid", "decoder")))(*pair)[0]
    found = Exported(*map(str, files))(*pair)[0]
    assert 0 < np.abs(found - plain).max() < 0.2 * np.abs(plain).max()


def test_scale_multiplies_flow_but_not_the_expected_error(fresh):
    exported = fresh[2]
    pair = golden_frames()
    (flow, error), (scaled, same) = exported(*pair), exported(*pair, scale=(2.0, 3.0))
    np.testing.assert_allclose(scaled, flow * np.array([2, 3], np.float32), rtol=1e-5)
    np.testing.assert_array_equal(error, same)
    assert flow.shape == (1, 32, 48, 2) and error.shape == (1, 32, 48)


def test_the_interface_is_the_same_for_every_network(fresh):
    exported = fresh[2]
    names = exported.names
    assert names in (["match_level2", "match_level3", "context_level3"], ["match_level3", "context_level3"])
    assert [i.name for i in exported.pyramid.get_inputs()] == ["image"]
    wanted = [f"{frame}_{name}" for frame in ("older", "newer") for name in names]
    read = [i.name for i in exported.decoder.get_inputs()]
    assert read[-1] == "scale" and set(read[:-1]) <= set(wanted)
    for name, feature in exported.features(golden_frames()[0]).items():
        assert feature.shape[2:] == (128 >> int(name[-1]), 192 >> int(name[-1]))


def test_weights_are_stored_in_half_precision(fresh):
    for graph in fresh[1].values():
        model = onnx.load_from_string(graph)
        assert model.opset_import[0].version == OPSET
        large = [t for t in model.graph.initializer if np.prod(t.dims) > 1024]
        assert large and all(t.data_type == onnx.TensorProto.FLOAT16 for t in large)


def test_the_fused_decoder_is_called_alike_and_matches_by_the_one_operator(fresh):
    network, graphs, _ = fresh
    if not isinstance(network, PwcNet):
        assert "fused" not in graphs
        return
    plain, fused = (onnx.load_from_string(graphs[part]) for part in ("decoder", "fused"))
    assert plain.graph.input == fused.graph.input
    assert [output.name for output in plain.graph.output] == [output.name for output in fused.graph.output]
    assert not {"MatMul", "Einsum", "Softmax", "GridSample"} & {node.op_type for node in fused.graph.node}
    reaches = []
    for node in fused.graph.node:
        if node.op_type == "CostVolume":
            given = {attribute.name: onnx.helper.get_attribute_value(attribute) for attribute in node.attribute}
            assert node.domain == "nightflow" and given["gain"] == 4.0
            reaches.append(given["reach"])
    # Levels 5, 4, 3 and 3 again, then level 2.
    assert reaches == [4, 4, 4, 4] + ([] if network.fast else [2])


@pytest.mark.parametrize("bits", [16, 32])
def test_graphs_of_own_operators_are_called_alike_and_convolve_by_them(fresh, bits):
    network, graphs, _ = fresh
    names = {16: ("pyramid_bf16", "decoder_bf16"), 32: ("pyramid_fused", "fused")}[bits]
    if not isinstance(network, PwcNet):
        assert not set(names) & set(graphs)
        return
    for part, name in zip(("pyramid", "decoder"), names):
        plain, own = (onnx.load_from_string(graphs[name]) for name in (part, name))
        assert plain.graph.input == own.graph.input
        assert [output.name for output in plain.graph.output] == [output.name for output in own.graph.output]
        given = {node.op_type: node for node in own.graph.node if node.domain == "nightflow"}
        chains = [node for node in own.graph.node if node.op_type == "Convolutions"]
        assert not any(node.op_type == "Conv" for node in own.graph.node)
        if part == "pyramid":
            # The encoder sees the image as the network does, and two projections are its own.
            assert set(given) == {"Encoder", "Normalised"} and len(given["Encoder"].input) == 1 + 2 * 24
            view = {a.name: onnx.helper.get_attribute_value(a) for a in given["Encoder"].attribute}
            assert np.allclose(view.pop("slopes"), [1.0, 0.1]) and view.pop("bits", 16) == bits
            assert view == {"factor": 2.0, "offset": -1.0, "shift": 2}
            continue
        assert set(given) == {"CostVolume", "Convolutions", "Moved", "Resized"}
        of = lambda node, name: next(onnx.helper.get_attribute_value(a) for a in node.attribute if a.name == name)
        # To levels 4 and 5, from there to 4 and 3, then to 2.
        resized = [(of(node, "rule"), of(node, "gains")) for node in own.graph.node if node.op_type == "Resized"]
        both = [2.0, 1.0]
        assert resized == [(b"halved", [1.0] * 3)] * 2 + [(b"doubled", both)] * 2 + [(b"between", both)]
        # What a level's convolutions read of the flow comes out of its match, and the flow is moved after each look.
        matched = [node for node in own.graph.node if node.op_type == "CostVolume"]
        assert [of(node, "part") for node in matched] == [0.25] * len(matched)
        assert sum(node.op_type == "Moved" for node in own.graph.node) == len(matched)
        parts, layers = [of(node, "parts") for node in chains], [len(of(node, "slopes")) for node in chains]
        # Levels 5, 4, 3 and 3 again, the context network, level 2, a head for the expected error.
        assert parts == [5, 5, 5, 5, 2] + ([1] if network.fast else [5, 1])
        assert np.allclose(of(chains[0], "slopes"), [0.1] * 5 + [1.0])
        dense = [any(a.name == "dense" for a in node.attribute) for node in chains]
        assert dense == [network.decoder.shared.dense and count == 5 for count in parts]
        dilations = [of(node, "dilations") for node in chains]
        assert [given for given in dilations if set(given) != {1}] == [[1, 2, 4, 8, 1, 1]]
        for node in chains:
            assert len(node.input) == of(node, "parts") + 2 * len(of(node, "slopes"))
    # Nothing of the tracing stays with the network.
    network(*(torch.rand(1, 3, 64, 64) for _ in range(2)))[0][-1].sum().backward()


@pytest.mark.parametrize("name", ["pwcnet_fcdn", "pwcnet_fcdn_fast"])
def test_the_committed_graphs_are_those_of_their_weights(name):
    """What is added to a network leaves its committed graphs as they are."""
    network = PwcNet(fast=name.endswith("_fast")).eval()
    network.load_state_dict(checkpoints.of_graphs(MODELS / "pwcnet_fcdn"))
    graphs = graphs_of(network)
    named = {"fused": "decoder_fused"}
    for part in ("decoder", "fused", "decoder_bf16"):
        assert graphs[part].graph == onnx.load(MODELS / f"{name}_{named.get(part, part)}.onnx").graph, part
    for part in ("pyramid_fused", "pyramid_bf16"):
        assert graphs[part].graph == onnx.load(MODELS / f"pwcnet_fcdn_{part}.onnx").graph, part


def test_an_untrained_dense_network_comes_with_a_manifest(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["dense.py", "--to", str(tmp_path / "dense")])
    dense.main()
    manifest = tomllib.loads((tmp_path / "dense" / "manifest.toml").read_text())
    entry = manifest.pop("pwcnet_dense")
    assert not manifest and entry["precisions"] == ["bf16"] and entry["stride"] == STRIDE
    assert {"pyramid", "decoder", "pyramid_fused", "fused", "pyramid_bf16", "decoder_bf16", "golden"} <= set(entry)
    assert 0 < max(map(abs, entry["golden"]["flow"])) < 8 and max(entry["golden"]["uncertainty"]) < 8
    assert entry["gigamacs"] == pytest.approx(5.870, abs=1e-3)
    with pytest.raises(SystemExit, match="without a manifest"):
        dense.main()


def test_golden_frames_follow_their_formula():
    older, newer = golden_frames()
    c, y, x = 2, 50, 70
    wanted = 0.4 + 0.25 * np.sin(0.20 * x + 0.13 * y + c) * np.cos(0.17 * y - 0.05 * x)
    assert older[0, c, y, x] == np.float32(wanted)
    np.testing.assert_allclose(newer[0, :, 1:, 2:], older[0, :, :-1, :-2], atol=1e-6)


def test_the_manifest_keeps_other_networks(fresh, tmp_path):
    files = {}
    for part, graph in fresh[1].items():
        files[part] = tmp_path / f"one_{part}.onnx"
        files[part].write_bytes(graph)
    for name in ("one", "two", "one"):
        stride = 32 if name == "two" else USUAL_STRIDE
        write_manifest(tmp_path / "manifest.toml", name, manifest_entry(name, "1", files, fresh[2], stride))
    written = tomllib.loads((tmp_path / "manifest.toml").read_text())
    # A stride that is not said is the usual one.
    assert {name: entry.get("stride") for name, entry in written.items()} == {"one": None, "two": 32}


@pytest.mark.parametrize("models", [MODELS, MODELS / "recipes"], ids=["flown", "recipes"])
def test_committed_files_are_those_of_the_manifest(models):
    manifest = tomllib.loads((models / "manifest.toml").read_text())
    assert manifest
    for entry in manifest.values():
        parts = ("pyramid", "decoder", "pyramid_fused", "fused", "pyramid_bf16", "decoder_bf16", "upsampler")
        paths = {part: models / entry[part]["file"] for part in parts if part in entry}
        for part, path in paths.items():
            assert hashlib.sha256(path.read_bytes()).hexdigest() == entry[part]["sha256"]
            assert path.stat().st_size <= 20_000_000
        assert abs(entry["gigamacs"] - gigamacs(paths["pyramid"], paths["decoder"])) < 1e-3
        exported = Exported(str(paths["pyramid"]), str(paths["decoder"]))
        sides = [3 * entry.get("stride", USUAL_STRIDE), entry.get("stride", USUAL_STRIDE)]
        assert exported(*moved(*sides, 1))[1].shape == (1, sides[0] // 4, sides[1] // 4)
        outputs = exported(*golden_frames())
        rows, columns = np.ix_(GOLDEN_ROWS, GOLDEN_COLUMNS)
        for key, output in zip(("flow", "uncertainty"), outputs):
            golden = np.array(entry["golden"][key])
            assert np.abs(output[0][rows, columns].flatten() - golden).max() <= entry["golden"]["tolerance"]
