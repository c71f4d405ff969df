"""Writes a trained network as two ONNX graphs, checks them against PyTorch, and enters them in the manifest."""

import argparse
import hashlib
import io
import tomllib
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from torch import nn

import checkpoints
from networks import PwcNet

OPSET = 17
LEVEL_NAMES = [f"level{level}" for level in range(2, 7)]
LARGEST_FILE = 20_000_000
PARITY_PX = 1e-3
GOLDEN_HEIGHT, GOLDEN_WIDTH = 128, 192
GOLDEN_ROWS, GOLDEN_COLUMNS = (4, 12, 20, 28), (4, 12, 20, 28, 36, 44)
GOLDEN_TOLERANCE = 0.02


class FrameGraph(nn.Module):
    """The pyramid behind the interface that the node uses: five levels, whatever the network's coarsest is.

    Levels that the network has not are given as averages of the coarsest, and nobody reads them.
    """

    def __init__(self, network: PwcNet):
        super().__init__()
        self.pyramid = network.pyramid

    def forward(self, image):
        features = list(self.pyramid(image))
        while len(features) < len(LEVEL_NAMES):
            features.append(nn.functional.avg_pool2d(features[-1], 2))
        return tuple(features)


class PairGraph(nn.Module):
    """The decoder behind the interface that the node uses.

    Ten feature maps and `scale` [2] (camera pixels per network pixel) to flow [1, H/4, W/4, 2] in camera pixels and
    the expected end-point error [1, H/4, W/4] in network pixels.
    """

    def __init__(self, network: PwcNet):
        super().__init__()
        self.decoder = network.decoder

    def forward(self, *inputs):
        flows, expected = self.decoder(inputs[:5], inputs[5:10])
        return (4.0 * flows[-1]).permute(0, 2, 3, 1) * inputs[10], expected[:, 0]


def golden_frames() -> tuple[np.ndarray, np.ndarray]:
    """Two frames [1, 3, 128, 192] by formula, the second moved by (2, 1) pixels."""

    def picture(c, y, x):
        return 0.4 + 0.25 * np.sin(0.20 * x + 0.13 * y + c) * np.cos(0.17 * y - 0.05 * x)

    c, y, x = np.meshgrid(np.arange(3.0), np.arange(GOLDEN_HEIGHT), np.arange(GOLDEN_WIDTH), indexing="ij")
    return tuple(picture(c, y - dy, x - dx)[None].astype(np.float32) for dx, dy in ((0, 0), (2, 1)))


def with_half_weights(graph: onnx.ModelProto) -> onnx.ModelProto:
    """Stores every large initialiser as fp16 with a Cast that the runtime folds when it loads the graph."""
    casts, kept = [], []
    for tensor in graph.graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.dtype == np.float32 and values.size > 1024:
            half = tensor.name + "_half"
            kept.append(onnx.numpy_helper.from_array(values.astype(np.float16), half))
            casts.append(
                onnx.helper.make_node("Cast", [half], [tensor.name], to=onnx.TensorProto.FLOAT, name=half + "_cast")
            )
        else:
            kept.append(tensor)
    nodes = casts + list(graph.graph.node)
    del graph.graph.initializer[:], graph.graph.node[:]
    graph.graph.initializer.extend(kept)
    graph.graph.node.extend(nodes)
    return graph


def traced(module: nn.Module, inputs: tuple, names: list[str], outputs: list[str], axes: dict) -> onnx.ModelProto:
    """An ONNX graph of a module with dynamic rows and columns."""
    memory = io.BytesIO()
    torch.onnx.export(
        module, inputs, memory, input_names=names, output_names=outputs, dynamic_axes=axes, opset_version=OPSET,
        dynamo=False, do_constant_folding=True,
    )
    return onnx.load_from_string(memory.getvalue())


def declare(decoder: onnx.ModelProto, inputs: list[str], features: list[torch.Tensor]) -> None:
    """Puts the inputs that a shallow network does not read back into the decoder's interface, in order."""
    present = {i.name: i for i in decoder.graph.input}
    for name, feature in zip(inputs, [*features, *features]):
        level = name.split("_")[1]
        shape = [1, feature.shape[1], f"rows_{level}", f"columns_{level}"]
        present.setdefault(name, onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape))
    del decoder.graph.input[:]
    decoder.graph.input.extend(present[name] for name in [*inputs, "scale"])


def graphs_of(network: PwcNet) -> dict[str, onnx.ModelProto]:
    """`pyramid` and `decoder` graphs of a network in evaluation mode."""
    image = torch.rand(1, 3, GOLDEN_HEIGHT, GOLDEN_WIDTH)
    frame = FrameGraph(network).eval()
    features = frame(image)
    rows = {name: {2: f"rows_{name}", 3: f"columns_{name}"} for name in LEVEL_NAMES}
    pyramid = traced(
        frame, (image,), ["image"], LEVEL_NAMES, {"image": {2: "height", 3: "width"}, **rows}
    )
    inputs = [f"{frame}_{name}" for frame in ("older", "newer") for name in LEVEL_NAMES]
    axes = {f"{frame}_{name}": rows[name] for frame in ("older", "newer") for name in LEVEL_NAMES}
    axes |= {out: {1: "rows_level2", 2: "columns_level2"} for out in ("flow", "uncertainty")}
    decoder = traced(
        PairGraph(network), (*features, *features, torch.ones(2)), [*inputs, "scale"], ["flow", "uncertainty"], axes
    )
    declare(decoder, inputs, features)
    return {"pyramid": with_half_weights(pyramid), "decoder": with_half_weights(decoder)}


class Exported:
    """The two graphs in ONNX Runtime."""

    def __init__(self, pyramid: bytes | str, decoder: bytes | str, threads: int = 2):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        self.pyramid, self.decoder = (
            onnxruntime.InferenceSession(g, options, providers=["CPUExecutionProvider"]) for g in (pyramid, decoder)
        )

    def features(self, image: np.ndarray) -> list[np.ndarray]:
        """Levels 2...6 of one frame."""
        return self.pyramid.run(LEVEL_NAMES, {"image": image})

    def flow(self, older: list, newer: list, scale=(1.0, 1.0)) -> list[np.ndarray]:
        """Flow [1, H/4, W/4, 2] and expected error [1, H/4, W/4]."""
        feed = {f"older_{n}": f for n, f in zip(LEVEL_NAMES, older)}
        feed |= {f"newer_{n}": f for n, f in zip(LEVEL_NAMES, newer)}
        return self.decoder.run(["flow", "uncertainty"], feed | {"scale": np.array(scale, np.float32)})

    def __call__(self, older: np.ndarray, newer: np.ndarray, scale=(1.0, 1.0)) -> list[np.ndarray]:
        return self.flow(self.features(older), self.features(newer), scale)


def rounded(network: PwcNet) -> PwcNet:
    """The network as the files hold it: large weights through fp16 and back."""
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.numel() > 1024:
                parameter.copy_(parameter.half().float())
    return network


@torch.no_grad()
def parity(network: PwcNet, exported: Exported, older: np.ndarray, newer: np.ndarray) -> float:
    """Greatest difference in pixels between the graphs and PyTorch on one pair."""
    flows, expected = network(torch.from_numpy(older), torch.from_numpy(newer))
    flow, uncertainty = exported(older, newer)
    by_torch = (4 * flows[-1]).permute(0, 2, 3, 1).numpy()
    return max(np.abs(flow - by_torch).max(), np.abs(uncertainty - expected[:, 0].numpy()).max())


def moved(height: int, width: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A random smooth picture and the same moved by (3, 2) pixels: a pair at any size, for the parity check."""
    random = np.random.default_rng(seed)
    coarse = torch.from_numpy(random.random((1, 3, height // 4 + 2, width // 4 + 2), np.float32))
    picture = torch.nn.functional.interpolate(coarse, scale_factor=4, mode="bilinear").numpy()
    return tuple(np.ascontiguousarray(picture[:, :, y : y + height, x : x + width]) for y, x in ((4, 4), (2, 1)))


def manifest_entry(name: str, version: str, files: dict[str, Path], exported: Exported) -> str:
    """The manifest's tables for one network, with the golden output."""
    flow, uncertainty = exported(*golden_frames())
    rows, columns = np.ix_(GOLDEN_ROWS, GOLDEN_COLUMNS)
    lines = [f"[{name}]", 'kind = "pyramid_decoder"', f"opset = {OPSET}", f'version = "{version}"']
    for part, file in files.items():
        lines += [f"[{name}.{part}]", f'file = "{file.name}"']
        lines += [f'sha256 = "{hashlib.sha256(file.read_bytes()).hexdigest()}"']
    lines += [f"[{name}.golden]", f"height = {GOLDEN_HEIGHT}", f"width = {GOLDEN_WIDTH}"]
    lines += [f"tolerance = {GOLDEN_TOLERANCE}"]
    for key, values in (("flow", flow[0][rows, columns]), ("uncertainty", uncertainty[0][rows, columns])):
        lines += [f"{key} = [{', '.join(f'{v:.5f}' for v in values.flatten())}]"]
    return "\n".join(lines) + "\n"


def write_manifest(path: Path, name: str, entry: str) -> None:
    """Puts one network's entry into the manifest and leaves the others as they are."""
    heading = "# Written by training/export.py. Golden inputs are given by formula there (golden_frames).\n"
    blocks = []
    if path.exists():
        for block in path.read_text().split("\n\n"):
            if block.strip() and not block.startswith("#") and name not in tomllib.loads(block):
                blocks.append(block.strip() + "\n")
    path.write_text("\n".join([heading, *blocks, entry]))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path, help="folder of pieces, such as runs/fcdn/checkpoint")
    parser.add_argument("--name", default="pwcnet_fcdn")
    parser.add_argument("--version", required=True, help="such as 2026-11-22.1")
    parser.add_argument("--models", type=Path, default=Path("../models"))
    arguments = parser.parse_args()
    state = checkpoints.load(arguments.checkpoint)
    network = PwcNet(state["coarsest"]).eval()
    network.load_state_dict(state["mean"])
    arguments.models.mkdir(parents=True, exist_ok=True)
    files = {}
    for part, graph in graphs_of(network).items():
        files[part] = arguments.models / f"{arguments.name}_{part}.onnx"
        onnx.checker.check_model(graph)
        written = graph.SerializeToString()
        if len(written) > LARGEST_FILE:
            raise SystemExit(f"{files[part].name}: expected at most {LARGEST_FILE} bytes, got {len(written)}")
        files[part].write_bytes(written)
    exported = Exported(*(str(file) for file in files.values()))
    for height, width in ((128, 192), (256, 320), (512, 640)):
        worst = parity(rounded(network), exported, *moved(height, width, height))
        print(f"{height}x{width}: graphs and PyTorch differ by at most {worst:.1e} px")
        if worst > PARITY_PX:
            raise SystemExit(f"{height}x{width}: expected graphs within {PARITY_PX} px of PyTorch, got {worst}")
    entry = manifest_entry(arguments.name, arguments.version, files, exported)
    write_manifest(arguments.models / "manifest.toml", arguments.name, entry)


if __name__ == "__main__":
    main()
