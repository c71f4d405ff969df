"""Writes a trained network as ONNX graphs, checks them against PyTorch, and enters them in the manifest."""

import argparse
import contextlib
import functools
import hashlib
import io
import json
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from torch import nn

import checkpoints
from flownet import KINDS, FlowNet
from networks import FACTOR, FLOW_GAIN, GAIN, OFFSET, SHIFT, STRIDE, PwcNet, doubled, halved, twice
from raft import RaftSmall
from upsampler import CELL, Upsampled, Upsampler

OPSET = 17
# Of operators that are not ONNX's own, and their version.
DOMAIN, DOMAIN_VERSION = "nightflow", 1
FRAMES = ("older", "newer")
LARGEST_FILE = 20_000_000
PARITY_PX = 1e-3
# What inputs are multiples of where the manifest says nothing else.
USUAL_STRIDE = 64
GOLDEN_HEIGHT, GOLDEN_WIDTH = 128, 192
GOLDEN_ROWS, GOLDEN_COLUMNS = (4, 12, 20, 28), (4, 12, 20, 28, 36, 44)
GOLDEN_TOLERANCE = 0.02


class FrameGraph(nn.Module):
    """PWC-Net's pyramid: what is matched at levels 2 and 3, and context."""

    names = ["match_level2", "match_level3", "context_level3"]

    def __init__(self, network: PwcNet):
        super().__init__()
        self.pyramid = network.pyramid

    def forward(self, image):
        return self.pyramid(image)


class PairGraph(nn.Module):
    """PWC-Net's decoder: features to flow [1, H/4, W/4, 2] in camera pixels, by `scale` [2] (camera pixels per network
    pixel), and the expected end-point error [1, H/4, W/4] in network pixels. The fast one reads no level 2."""

    def __init__(self, network: PwcNet):
        super().__init__()
        self.decoder, self.fast = network.decoder, network.fast
        self.names = [f"{frame}_match_level3" for frame in FRAMES] + ["older_context_level3"]
        if not self.fast:
            self.names += [f"{frame}_match_level2" for frame in FRAMES]

    def forward(self, older, newer, context, *rest):
        *level2, scale = rest
        of = lambda matched, n: (None if self.fast else level2[n], matched, context)
        flows, expected = self.decoder(of(older, 0), of(newer, 1), self.fast)
        return (flows[-1] * (4.0 * scale).view(1, 2, 1, 1)).permute(0, 2, 3, 1), expected[:, 0]


class CostVolume(torch.autograd.Function):
    """A level's match as the node's own operator `nightflow::CostVolume`, which warps, multiplies and seeks the maximum in one
    go. models/README.md defines it; tracing asks for shapes only."""

    @staticmethod
    def forward(ctx, older, newer, flow, sharpness, reach: int):
        volume = older.new_zeros(1, (2 * reach + 1) ** 2, *older.shape[2:])
        return volume, torch.zeros_like(flow), torch.zeros_like(flow)

    @staticmethod
    def symbolic(g, older, newer, flow, sharpness, reach: int):
        inputs = (older, newer, flow, sharpness)
        found = g.op(f"{DOMAIN}::CostVolume", *inputs, reach_i=reach, gain_f=GAIN, part_f=FLOW_GAIN, outputs=3)
        for value, channels in zip(found, ((2 * reach + 1) ** 2, 2, 2)):
            value.setType(older.type().with_sizes([1, channels, None, None]))
        return tuple(found)


class Moved(torch.autograd.Function):
    """`networks.LevelDecoder.moved` as the node's own operator `nightflow::Moved`."""

    @staticmethod
    def forward(ctx, flow, predicted, argmax):
        return torch.zeros_like(flow)

    @staticmethod
    def symbolic(g, flow, predicted, argmax):
        found = g.op(f"{DOMAIN}::Moved", flow, predicted, argmax)
        found.setType(flow.type())
        return found


class Convolutions(torch.autograd.Function):
    """Convolutions one after the other, of factors of so many bits, as the node's own operator `nightflow::Convolutions`. Its
    definition stands in models/README.md; tracing asks for shapes only."""

    @staticmethod
    def forward(ctx, settings: dict, parts: int, dilations: list[int], slopes: list[float], kept: bool, *tensors):
        channels = [bias.numel() for bias in tensors[parts + 1 :: 2]]
        of = lambda count: tensors[0].new_zeros(1, count, *tensors[0].shape[2:])
        return (of(channels[-1]), of(channels[-2])) if kept else of(channels[-1])

    @staticmethod
    def symbolic(g, settings: dict, parts: int, dilations: list[int], slopes: list[float], kept: bool, *tensors):
        channels = [bias.type().sizes()[0] for bias in tensors[parts + 1 :: 2]]
        settings = settings | {"parts_i": parts, "dilations_i": dilations, "slopes_f": slopes}
        found = g.op(f"{DOMAIN}::Convolutions", *tensors, outputs=2 if kept else 1, **settings)
        for value, count in zip(found if kept else [found], reversed(channels)):
            value.setType(tensors[0].type().with_sizes([1, count, None, None]))
        return tuple(found) if kept else found


class Normalised(torch.autograd.Function):
    """`networks.normalised` as the node's own operator `nightflow::Normalised`."""

    @staticmethod
    def forward(ctx, features):
        return torch.zeros_like(features)

    @staticmethod
    def symbolic(g, features):
        found = g.op(f"{DOMAIN}::Normalised", features)
        found.setType(features.type())
        return found


class Resized(torch.autograd.Function):
    """`networks.resized` as the node's own operator `nightflow::Resized`."""

    # By the rule how it is called there, and what length a length becomes.
    RULES = {
        halved: ("halved", lambda length: length // 2),
        doubled: ("doubled", lambda length: 2 * length),
        twice: ("between", lambda length: 2 * length),
    }

    @staticmethod
    def forward(ctx, rule, channels: list[int], gains: list[float], *values):
        become = Resized.RULES[rule][1]
        return tuple(value.new_zeros(1, count, *map(become, value.shape[2:])) for value, count in zip(values, channels))

    @staticmethod
    def symbolic(g, rule, channels: list[int], gains: list[float], *values):
        found = g.op(f"{DOMAIN}::Resized", *values, rule_s=Resized.RULES[rule][0], gains_f=gains, outputs=len(values))
        found = [found] if len(values) == 1 else found
        for to, value, count in zip(found, values, channels):
            to.setType(value.type().with_sizes([1, count, None, None]))
        return tuple(found)


def resized_as_one(rule, *values: torch.Tensor, gains: tuple[float, ...] | None = None) -> tuple[torch.Tensor, ...]:
    """What `networks.resized` gives, by the one operator."""
    return Resized.apply(rule, [int(value.shape[1]) for value in values], list(gains or [1.0] * len(values)), *values)


class EncoderLevels(torch.autograd.Function):
    """RAFT-small's feature encoder with what is projected from it, of factors of so many bits, as the node's own operator
    `nightflow::Encoder`."""

    @staticmethod
    def forward(ctx, image, settings: dict, slopes: list[float], *tensors):
        rows, columns = image.shape[2:]
        eighth, quarter, projected = (bias.numel() for bias in tensors[-5::2])
        sizes = ((quarter, 4), (eighth, 8), (projected, 8))
        return tuple(image.new_zeros(1, count, rows // part, columns // part) for count, part in sizes)

    @staticmethod
    def symbolic(g, image, settings: dict, slopes: list[float], *tensors):
        view = {"factor_f": FACTOR, "offset_f": OFFSET, "shift_i": SHIFT, "slopes_f": slopes}
        found = g.op(f"{DOMAIN}::Encoder", image, *tensors, outputs=3, **settings, **view)
        eighth, quarter, projected = (bias.type().sizes()[0] for bias in tensors[-5::2])
        for value, count in zip(found, (quarter, eighth, projected)):
            value.setType(image.type().with_sizes([1, count, None, None]))
        return tuple(found)


def said(bits: int) -> dict[str, int]:
    """The operators' attribute for so many bits; 16 is what they are of if nothing is said."""
    return {"bits_i": bits} if bits != 16 else {}


def convolutions_of(layers: nn.Module) -> tuple[list[nn.Conv2d], list[float]]:
    """Its convolutions and what each multiplies negative results with."""
    found = [part for part in layers.modules() if isinstance(part, (nn.Conv2d, nn.LeakyReLU))]
    following = [*found[1:], None]
    slopes = [after.negative_slope if isinstance(after, nn.LeakyReLU) else 1.0 for after in following]
    both = [(part, slope) for part, slope in zip(found, slopes) if isinstance(part, nn.Conv2d)]
    return [part for part, _ in both], [slope for _, slope in both]


def chained(layers: nn.Module, parts: list[torch.Tensor], kept: bool = False, dense: bool = False, *, bits: int):
    """What `networks.through` gives, by the one operator; with `kept` also what the layer before the last gives; of `dense`
    layers each reads all that there is before it."""
    convolutions, slopes = convolutions_of(layers)
    weights = [tensor for convolution in convolutions for tensor in (convolution.weight, convolution.bias)]
    dilations = [convolution.dilation[0] for convolution in convolutions]
    settings = said(bits) | ({"dense_i": 1} if dense else {})
    return Convolutions.apply(settings, len(parts), dilations, slopes, kept, *parts, *weights)


@contextlib.contextmanager
def exchanged(parts: list[tuple[nn.Module, str, object]]):
    """Within it these attributes of modules are these."""
    before = [(module, name, module.__dict__.get(name)) for module, name, _ in parts]
    for module, name, value in parts:
        module.__dict__[name] = value
    try:
        yield
    finally:
        for module, name, value in before:
            if value is None:
                del module.__dict__[name]
            else:
                module.__dict__[name] = value


def fused(network: PwcNet, bits: int = 32):
    """Within it what looks at one frame and what looks at two are of the node's operators, with factors of so many bits."""
    decoder, chain = network.decoder, functools.partial(chained, bits=bits)
    parts = [(decoder, "through", chain), (decoder, "resized", resized_as_one)]
    for level in (decoder.shared, decoder.fine):
        match = lambda older, newer, flow, tile, fetch, level=level: CostVolume.apply(
            older, newer, flow, level.sharpness, level.reach
        )
        layers = lambda parts, level=level: chain(nn.Sequential(level.body, level.predict), parts, kept=True, dense=level.dense)
        parts += [(level, "match", match), (level, "layers", layers), (level, "moved", Moved.apply)]
    pyramid, encoder = network.pyramid, network.pyramid.encoder
    # In the order of use; a unit registers its short cut last, which is where the operator looks for it.
    in_turn = (encoder.conv1, encoder.layer1, encoder.layer2, encoder.layer3, encoder.conv2)
    used = [p for part in in_turn for p in part.modules() if isinstance(p, nn.Conv2d)]
    projections, slopes = convolutions_of(nn.Sequential(pyramid.quarter, pyramid.context))
    weights = [tensor for convolution in used + projections for tensor in (convolution.weight, convolution.bias)]
    levels = lambda image: EncoderLevels.apply(image, said(bits), slopes, *weights)
    return exchanged(parts + [(pyramid, "levels", levels), (pyramid, "normalised", Normalised.apply)])


class RaftFrameGraph(nn.Module):
    """RAFT-small's encoders: what is matched, and state and context."""

    names = ["match_level3", "context_level3"]

    def __init__(self, network: RaftSmall):
        super().__init__()
        self.network = network

    def forward(self, image):
        return self.network.frame(image)


class RaftPairGraph(nn.Module):
    """RAFT-small's correlations and updates; of the newer frame only what is matched is read."""

    names = ["older_match_level3", "newer_match_level3", "older_context_level3"]

    def __init__(self, network: RaftSmall):
        super().__init__()
        self.network = network

    def forward(self, older, newer, context, scale):
        flows, expected = self.network.pair(older, newer, context)
        return flows[-1].permute(0, 2, 3, 1) * scale, expected[:, 0]


class FlowNetFrameGraph(nn.Module):
    """What concerns one frame alone: FlowNetS's halves of a layer, or FlowNetC's level 2 and what is matched."""

    def __init__(self, network: FlowNet):
        super().__init__()
        self.pyramid, self.names = network.pyramid, network.features

    def forward(self, image):
        return self.pyramid(image)


class FlowNetPairGraph(nn.Module):
    """The rest, in the order in which the decoder takes it."""

    def __init__(self, network: FlowNet):
        super().__init__()
        self.decoder, self.names = network.decoder, network.reads

    def forward(self, *inputs):
        *features, scale = inputs
        flows, expected = self.decoder(*features)
        return flows[-1].permute(0, 2, 3, 1) * scale, expected[:, 0]


class UpsamplerGraph(nn.Module):
    """The older frame, and flow [1, H/4, W/4, 2] and expected error [1, H/4, W/4] in pixels of the network's input, to both at every
    pixel."""

    inputs, outputs = ["image", "flow", "uncertainty"], ["full_flow", "full_uncertainty"]

    def __init__(self, upsampler: Upsampler):
        super().__init__()
        self.upsampler = upsampler

    def forward(self, image, flow, uncertainty):
        full, expected = self.upsampler(image, flow.permute(0, 3, 1, 2), uncertainty[:, None])
        return full.permute(0, 2, 3, 1), expected[:, 0]


GRAPHS = {
    PwcNet: (FrameGraph, PairGraph),
    RaftSmall: (RaftFrameGraph, RaftPairGraph),
    FlowNet: (FlowNetFrameGraph, FlowNetPairGraph),
}


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


def traced(
    module: nn.Module, inputs: tuple, names: list[str], outputs: list[str], axes: dict, domains: dict | None = None
) -> onnx.ModelProto:
    """An ONNX graph of a module with dynamic rows and columns."""
    memory = io.BytesIO()
    torch.onnx.export(
        module, inputs, memory, input_names=names, output_names=outputs, dynamic_axes=axes, opset_version=OPSET,
        dynamo=False, do_constant_folding=True, custom_opsets=domains,
    )
    return onnx.load_from_string(memory.getvalue())


def graphs_of(network: nn.Module, plain: bool = False) -> dict[str, onnx.ModelProto]:
    """`pyramid` and `decoder` graphs of a network in evaluation mode; of a PWC-Net, unless only `plain` ones are wanted, also
    both with the node's own operators: in 32 bits `pyramid_fused` and `fused`, and `pyramid_bf16` and `decoder_bf16`."""
    graphs = next(graphs for kind, graphs in GRAPHS.items() if isinstance(network, kind))
    frame, pair = (graph(network).eval() for graph in graphs)
    image = torch.rand(1, 3, GOLDEN_HEIGHT, GOLDEN_WIDTH)
    features = dict(zip(frame.names, frame(image)))
    inputs = {name: features[name.split("_", 1)[1]] for name in pair.names}

    def axes(name: str) -> dict:
        level = name[name.index("level") :]
        return {2: f"rows_{level}", 3: f"columns_{level}"}

    def pyramid(domains: dict | None = None) -> onnx.ModelProto:
        return traced(
            frame, (image,), ["image"], frame.names,
            {"image": {2: "height", 3: "width"}, **{name: axes(name) for name in frame.names}}, domains,
        )

    raster = {1: "rows_level2", 2: "columns_level2"}

    def decoder(domains: dict | None = None) -> onnx.ModelProto:
        return traced(
            pair, (*inputs.values(), torch.ones(2)), [*inputs, "scale"], ["flow", "uncertainty"],
            {"flow": raster, "uncertainty": raster, **{name: axes(name) for name in inputs}}, domains,
        )

    graphs = {"pyramid": pyramid(), "decoder": decoder()}
    if isinstance(network, PwcNet) and not plain:
        own = {DOMAIN: DOMAIN_VERSION}
        for bits, names in ((32, ("pyramid_fused", "fused")), (16, ("pyramid_bf16", "decoder_bf16"))):
            with fused(network, bits):
                graphs |= zip(names, (pyramid(own), decoder(own)))
    return {part: with_half_weights(graph) for part, graph in graphs.items()}


def upsampler_graph(upsampler: Upsampler) -> onnx.ModelProto:
    """The graph of an upsampler."""
    rows, columns = GOLDEN_HEIGHT // CELL, GOLDEN_WIDTH // CELL
    inputs = (torch.rand(1, 3, GOLDEN_HEIGHT, GOLDEN_WIDTH), torch.rand(1, rows, columns, 2), torch.rand(1, rows, columns) + 0.1)
    raster, whole = {1: "rows_level2", 2: "columns_level2"}, {1: "height", 2: "width"}
    axes = {"image": {2: "height", 3: "width"}, "flow": raster, "uncertainty": raster, "full_flow": whole, "full_uncertainty": whole}
    return with_half_weights(traced(UpsamplerGraph(upsampler).eval(), inputs, UpsamplerGraph.inputs, UpsamplerGraph.outputs, axes))


def session(graph: bytes | str, threads: int = 2) -> onnxruntime.InferenceSession:
    """A graph in ONNX Runtime."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])


class Exported:
    """The two graphs in ONNX Runtime, and the upsampler's if there is one."""

    def __init__(self, pyramid: bytes | str, decoder: bytes | str, threads: int = 2, upsampler: bytes | str | None = None):
        self.pyramid, self.decoder = session(pyramid, threads), session(decoder, threads)
        self.upsampler = upsampler and session(upsampler, threads)
        self.names = [output.name for output in self.pyramid.get_outputs()]

    def features(self, image: np.ndarray) -> dict[str, np.ndarray]:
        """Everything about one frame, by name."""
        return dict(zip(self.names, self.pyramid.run(self.names, {"image": image})))

    def flow(self, older: dict, newer: dict, scale=(1.0, 1.0)) -> list[np.ndarray]:
        """Flow [1, H/4, W/4, 2] and expected error [1, H/4, W/4]."""
        features = {f"{frame}_{n}": f for frame, given in zip(FRAMES, (older, newer)) for n, f in given.items()}
        feed = {i.name: features[i.name] for i in self.decoder.get_inputs() if i.name != "scale"}
        return self.decoder.run(["flow", "uncertainty"], feed | {"scale": np.array(scale, np.float32)})

    def full(self, image: np.ndarray, flow: np.ndarray, uncertainty: np.ndarray) -> list[np.ndarray]:
        """Flow [1, H, W, 2] and expected error [1, H, W] by the upsampler, all in pixels of the network's input."""
        feed = dict(zip(UpsamplerGraph.inputs, (image, flow, uncertainty)))
        return self.upsampler.run(UpsamplerGraph.outputs, feed)

    def __call__(self, older: np.ndarray, newer: np.ndarray, scale=(1.0, 1.0)) -> list[np.ndarray]:
        return self.flow(self.features(older), self.features(newer), scale)


def rounded(network: nn.Module) -> nn.Module:
    """The network as the files hold it: large weights through fp16 and back."""
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.numel() > 1024:
                parameter.copy_(parameter.half().float())
    return network


@torch.no_grad()
def parity(network: nn.Module, exported: Exported, older: np.ndarray, newer: np.ndarray) -> float:
    """Greatest difference in pixels between the graphs and PyTorch on one pair."""
    flows, expected = network(torch.from_numpy(older), torch.from_numpy(newer))
    flow, uncertainty = exported(older, newer)
    by_torch = network.weighed(flows)[-1][0].permute(0, 2, 3, 1).numpy()
    return max(np.abs(flow - by_torch).max(), np.abs(uncertainty - expected[:, 0].numpy()).max())


def moved(height: int, width: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A random smooth picture and the same moved by (3, 2) pixels: a pair at any size, for the parity check."""
    random = np.random.default_rng(seed)
    coarse = torch.from_numpy(random.random((1, 3, height // 4 + 2, width // 4 + 2), np.float32))
    picture = torch.nn.functional.interpolate(coarse, scale_factor=4, mode="bilinear").numpy()
    return tuple(np.ascontiguousarray(picture[:, :, y : y + height, x : x + width]) for y, x in ((4, 4), (2, 1)))


def macs(node: onnx.NodeProto, kernel: list[int]) -> float:
    """Multiply-adds for each cell that comes out of a convolution: every weight is multiplied once for it, or, in a
    transposed one, once for each cell that goes in."""
    strides = next(list(a.ints) for a in node.attribute if a.name == "strides")
    return np.prod(kernel) / (np.prod(strides) if node.op_type == "ConvTranspose" else 1)


def gigamacs(pyramid: Path, decoder: Path) -> float:
    """Multiply-adds of the convolutions of a step at 320 x 256, in 10^9: the shapes are asked of ONNX Runtime."""
    total, values = 0, {"image": np.zeros((1, 3, 256, 320), np.float32), "scale": np.ones(2, np.float32)}
    for path in (pyramid, decoder):
        model = onnx.load(path)
        weights = {tensor.name: tensor.dims for tensor in model.graph.initializer}
        # Weights of half as many bits stand behind a cast.
        weights |= {n.output[0]: weights[n.input[0]] for n in model.graph.node if n.input and n.input[0] in weights}
        convolutions = {n.output[0]: macs(n, weights[n.input[1]]) for n in model.graph.node if "Conv" in n.op_type}
        names = [output.name for output in model.graph.output]
        for name in convolutions.keys() - set(names):
            model.graph.output.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None))
        session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
        outputs = dict(zip((o.name for o in session.get_outputs()),
                           session.run(None, {i.name: values[i.name] for i in session.get_inputs()})))
        total += sum(each * outputs[name][0, 0].size for name, each in convolutions.items())
        values |= {f"{frame}_{name}": outputs[name] for frame in FRAMES for name in names}
    return total / 1e9


def manifest_entry(
    name: str, version: str, files: dict[str, Path], exported: Exported, stride: int = USUAL_STRIDE, precisions: Sequence[str] = ()
) -> str:
    """The manifest's tables for one network, whose inputs are multiples of `stride`, and which may run in these `precisions` beside
    fp32, with the golden output."""
    flow, uncertainty = exported(*golden_frames())
    rows, columns = np.ix_(GOLDEN_ROWS, GOLDEN_COLUMNS)
    lines = [f"[{name}]", 'kind = "pyramid_decoder"', f"opset = {OPSET}"]
    lines += [f"stride = {stride}"] if stride != USUAL_STRIDE else []
    lines += [f'version = "{version}"']
    lines += [f"gigamacs = {gigamacs(files['pyramid'], files['decoder']):.3f}"]
    lines += [f"precisions = {json.dumps(list(precisions))}"] if precisions else []
    for part, file in files.items():
        lines += [f"[{name}.{part}]", f'file = "{file.name}"']
        lines += [f'sha256 = "{hashlib.sha256(file.read_bytes()).hexdigest()}"']
    lines += [f"[{name}.golden]", f"height = {GOLDEN_HEIGHT}", f"width = {GOLDEN_WIDTH}"]
    lines += [f"tolerance = {GOLDEN_TOLERANCE}"]
    for key, values in (("flow", flow[0][rows, columns]), ("uncertainty", uncertainty[0][rows, columns])):
        lines += [f"{key} = [{', '.join(f'{v:.5f}' for v in values.flatten())}]"]
    return "\n".join(lines) + "\n"


def with_upsampler(entry: str, name: str, file: Path) -> str:
    """The manifest's entry of a network with its upsampler, in place of one that it may have."""
    parts = [part for part in entry.strip().split("\n[") if not part.startswith(f"{name}.upsampler]")]
    golden = next(i for i, part in enumerate(parts) if part.startswith(f"{name}.golden]"))
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    parts.insert(golden, f'{name}.upsampler]\nfile = "{file.name}"\nsha256 = "{sha256}"')
    return "\n[".join(parts) + "\n"


def held_entry(path: Path, name: str) -> str:
    """A network's entry as the manifest has it."""
    blocks = path.read_text().split("\n\n")
    return next(block for block in blocks if not block.startswith("#") and name in tomllib.loads(block))


@torch.no_grad()
def export_upsampler(arguments: argparse.Namespace, state: dict) -> None:
    """Writes, checks and enters the upsampler of a network that is in the manifest. It is not called as that network's graphs
    are, for `checkpoints.of_graphs` reads those."""
    network = Upsampled()
    network.load_state_dict(state["mean"])
    upsampler = rounded(network.upsampler.eval())
    graph, file = upsampler_graph(upsampler), arguments.models / f"upsampler_{arguments.name.removeprefix('pwcnet_')}.onnx"
    onnx.checker.check_model(graph)
    file.write_bytes(graph.SerializeToString())
    files = (str(arguments.models / f"{arguments.name}_{part}.onnx") for part in ("pyramid", "decoder"))
    exported = Exported(*files, upsampler=str(file))
    for height, width in ((128, 192), (256, 320), (512, 640)):
        older, newer = moved(height, width, height)
        given = exported(older, newer)
        by_torch = UpsamplerGraph(upsampler)(*map(torch.from_numpy, (older, *given)))
        worst = max(np.abs(found - wanted.numpy()).max() for found, wanted in zip(exported.full(older, *given), by_torch))
        print(f"{height}x{width}: graph and PyTorch differ by at most {worst:.1e} px")
        if worst > PARITY_PX:
            raise SystemExit(f"{height}x{width}: expected a graph within {PARITY_PX} px of PyTorch, got {worst}")
    manifest = arguments.models / "manifest.toml"
    write_manifest(manifest, arguments.name, with_upsampler(held_entry(manifest, arguments.name), arguments.name, file))


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
    parser.add_argument("--version", help="such as 2026-11-22.1; an upsampler has its network's")
    parser.add_argument("--models", type=Path, default=Path("../models"))
    parser.add_argument("--iterations", type=int, nargs="+", help="for RAFT-small: a network for each, as 8 4 12")
    parser.add_argument("--plain", action="store_true", help="only the two graphs of ONNX's own operators")
    parser.add_argument("--precisions", nargs="+", default=[], help="fewer bits that it was judged in by a ladder, as bf16")
    parser.add_argument("--fast", action="store_true", help="for PWC-Net: also NAME_fast, which ends at level 3")
    arguments = parser.parse_args()
    state = checkpoints.load(arguments.checkpoint)
    if (state["kind"] == "raftsmall") != bool(arguments.iterations):
        raise SystemExit(f"{arguments.checkpoint}: holds a {state['kind']}; --iterations is for raftsmall, and needed there")
    if state["kind"] == "upsampler":
        return export_upsampler(arguments, state)
    if not arguments.version:
        raise SystemExit(f"{arguments.checkpoint}: holds a {state['kind']}, which needs a --version, such as 2026-11-22.1")
    arguments.models.mkdir(parents=True, exist_ok=True)
    if state["kind"] == "pwcnet":
        dense = state.get("dense", False)
        export(arguments, PwcNet(dense=dense), state, arguments.name)
        if arguments.fast:
            export(arguments, PwcNet(fast=True, dense=dense), state, f"{arguments.name}_fast")
    if state["kind"] in KINDS:
        export(arguments, KINDS[state["kind"]](state["width"]), state, arguments.name)
    for iterations in arguments.iterations or []:
        first = iterations == arguments.iterations[0]
        export(arguments, RaftSmall(iterations), state, arguments.name if first else f"{arguments.name}_{iterations}")


def export(arguments: argparse.Namespace, network: nn.Module, state: dict, name: str) -> None:
    """Writes, checks and enters one network. Those with the same weights share the pyramid's file."""
    network.eval().load_state_dict(state["mean"])
    files = {}
    for part, graph in graphs_of(network, arguments.plain).items():
        # Those with the same weights share what looks at one frame.
        owner = arguments.name if part.startswith("pyramid") else name
        file = f"{owner}_{'decoder_fused' if part == 'fused' else part}"
        files[part] = arguments.models / f"{file}.onnx"
        onnx.checker.check_model(graph)
        written = graph.SerializeToString()
        if len(written) > LARGEST_FILE:
            raise SystemExit(f"{files[part].name}: expected at most {LARGEST_FILE} bytes, got {len(written)}")
        files[part].write_bytes(written)
    # The fused graph needs the node's operator: the node's tests compare it with the plain one.
    exported = Exported(str(files["pyramid"]), str(files["decoder"]))
    stride = STRIDE if isinstance(network, PwcNet) else USUAL_STRIDE
    for height, width in ((128, 192), (256, 320), (512, 640), (128 + stride, 192 + stride)):
        worst = parity(rounded(network), exported, *moved(height, width, height))
        print(f"{height}x{width}: graphs and PyTorch differ by at most {worst:.1e} px")
        if worst > PARITY_PX:
            raise SystemExit(f"{height}x{width}: expected graphs within {PARITY_PX} px of PyTorch, got {worst}")
    entry = manifest_entry(name, arguments.version, files, exported, stride, arguments.precisions)
    write_manifest(arguments.models / "manifest.toml", name, entry)


if __name__ == "__main__":
    main()
