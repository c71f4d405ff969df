"""Checkpoints in pieces of at most 16 MB, so that they travel and can be kept beside the code.

A state is one `torch.save` stream, cut into `checkpoint.0`, `checkpoint.1`, … The first piece begins with a line of
JSON that says how many bytes and pieces there are and what their sha256 is, so that a missing or torn piece is named
instead of loaded.
"""

import hashlib
import io
import json
import shutil
from pathlib import Path

import onnx
import torch

PIECE = 16_000_000
PIECES_MAX = 8


def save(state: dict, folder: Path, piece: int = PIECE) -> None:
    """Writes beside and renames, so that a leg cut short leaves the former checkpoint whole."""
    stream = io.BytesIO()
    torch.save(state, stream)
    body = stream.getvalue()
    heading = {"bytes": len(body), "sha256": hashlib.sha256(body).hexdigest()}
    # The heading's own length depends on the number of pieces by a digit at most; it is padded to stay the same.
    pieces = -(-(len(body) + 256) // piece)
    if pieces > PIECES_MAX:
        raise ValueError(f"expected a checkpoint of at most {PIECES_MAX} pieces of {piece} bytes, this one has {pieces}")
    line = json.dumps(heading | {"pieces": pieces}).ljust(255).encode() + b"\n"
    whole, beside = line + body, folder.with_name(folder.name + ".part")
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir(parents=True)
    for i in range(pieces):
        (beside / f"checkpoint.{i}").write_bytes(whole[i * piece : (i + 1) * piece])
    former = folder.with_name(folder.name + ".former")
    shutil.rmtree(former, ignore_errors=True)
    if folder.exists():
        folder.rename(former)
    beside.rename(folder)
    shutil.rmtree(former, ignore_errors=True)


def exists(folder: Path) -> bool:
    """Whether there is anything to go on from."""
    return (folder / "checkpoint.0").exists()


def load(folder: Path) -> dict:
    """Reads what `save` wrote; on the CPU, wherever it came from."""
    first = (folder / "checkpoint.0").read_bytes()
    heading = json.loads(first[:256])
    missing = [i for i in range(heading["pieces"]) if not (folder / f"checkpoint.{i}").exists()]
    if missing:
        raise ValueError(f"{folder}: expected {heading['pieces']} pieces, without {missing} there is no checkpoint")
    body = first[256:] + b"".join((folder / f"checkpoint.{i}").read_bytes() for i in range(1, heading["pieces"]))
    found = hashlib.sha256(body).hexdigest()
    if (len(body), found) != (heading["bytes"], heading["sha256"]):
        raise ValueError(
            f"{folder}: expected {heading['bytes']} bytes with sha256 {heading['sha256']}, found {len(body)} with {found}"
        )
    return torch.load(io.BytesIO(body), weights_only=True, map_location="cpu")


def of_graphs(name: Path) -> dict[str, torch.Tensor]:
    """The weights that the graphs `NAME_*.onnx` hold, by their names in PyTorch."""
    found = {}
    for file in sorted(name.parent.glob(f"{name.name}_*.onnx")):
        for tensor in onnx.load(file).graph.initializer:
            # RAFT-small is exported as a part of what calls it.
            known = tensor.name.removesuffix("_half").removeprefix("network.")
            # A copy, for what onnx gives may not be written to.
            found[known] = torch.tensor(onnx.numpy_helper.to_array(tensor)).float()
    if not found:
        raise FileNotFoundError(f"expected graphs {name}_*.onnx, found none")
    return found
