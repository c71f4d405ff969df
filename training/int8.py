"""Quantises a network's graphs to int8 (QDQ, weights per channel), calibrated on FCDN pairs over all noise levels, into a
folder with a manifest of its own: `nightflow eval ladder --models NAME_int8=FOLDER/NAME_int8` and
`nightflow bench --config` (with `[flow] models = "FOLDER"`) say what it costs and what it brings."""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import onnx
import torch
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from export import FRAMES, Exported, manifest_entry, write_manifest
from pairs import batch_of
from scenes import Textures

DARKEST = 70.0
METHODS = {"minmax": CalibrationMethod.MinMax, "percentile": CalibrationMethod.Percentile, "entropy": CalibrationMethod.Entropy}


class Given(CalibrationDataReader):
    """Inputs one after the other."""

    def __init__(self, feeds: list[dict]):
        self.feeds = iter(feeds)

    def get_next(self) -> dict | None:
        """The next one, and nothing at the end."""
        return next(self.feeds, None)


def feeds(graphs: Exported, packed: Path, count: int) -> tuple[list[dict], list[dict]]:
    """What pyramid and decoder are fed with on training pairs of 192×256, at evenly spread noise levels."""
    torch.manual_seed(3)
    textures, images, features = Textures(packed, held_out=False), [], []
    wanted = [i.name for i in graphs.decoder.get_inputs()]
    for level in torch.linspace(0, DARKEST, count):
        older, newer, _ = batch_of(textures, 192, 256, level[None])
        pair = [older.numpy(), newer.numpy()]
        images += [{"image": frame} for frame in pair]
        known = {f"{f}_{n}": v for f, image in zip(FRAMES, pair) for n, v in graphs.features(image).items()}
        features.append({name: known[name] for name in wanted if name != "scale"} | {"scale": np.ones(2, np.float32)})
    return images, features


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="to be written")
    parser.add_argument("--name", default="pwcnet_fcdn")
    parser.add_argument("--models", type=Path, default=Path("../models"))
    parser.add_argument("--photographs", type=Path, default=Path("runs/photographs.npz"))
    parser.add_argument("--count", type=int, default=48, help="pairs to calibrate on")
    parser.add_argument("--keep", nargs="*", default=[], help="convolutions whose name holds this stay in fp32")
    parser.add_argument("--method", choices=METHODS, default="percentile")
    arguments = parser.parse_args()
    parts = {part: arguments.models / f"{arguments.name}_{part}.onnx" for part in ("pyramid", "decoder")}
    given = feeds(Exported(*map(str, parts.values())), arguments.photographs, arguments.count)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    name, files = f"{arguments.name}_int8", {}
    for (part, source), fed in zip(parts.items(), given):
        files[part] = arguments.folder / f"{name}_{part}.onnx"
        with tempfile.TemporaryDirectory() as beside:
            whole = Path(beside) / "whole.onnx"
            # Weights are stored in half as many bits behind a cast; the quantiser wants to see them.
            quant_pre_process(str(source), str(whole), skip_symbolic_shape=True)
            held = [node.name for node in onnx.load(whole).graph.node if any(part in node.name for part in arguments.keep)]
            quantize_static(
                str(whole), str(files[part]), Given(fed), quant_format=QuantFormat.QDQ, op_types_to_quantize=["Conv"],
                nodes_to_exclude=held, per_channel=True, activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8,
                calibrate_method=METHODS[arguments.method],
            )
        kinds = [node.op_type for node in onnx.load(files[part]).graph.node]
        print(f"{part}: {kinds.count('Conv')} convolutions, {kinds.count('QuantizeLinear')} activations in int8")
    entry = manifest_entry(name, f"int8-{arguments.method}", files, Exported(*map(str, files.values())))
    write_manifest(arguments.folder / "manifest.toml", name, entry)


if __name__ == "__main__":
    main()
