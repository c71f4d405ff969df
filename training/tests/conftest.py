"""Stand-ins for the photographs, which are not in the repository."""

from pathlib import Path

import numpy as np
import pytest
import torch


@pytest.fixture(scope="session")
def packed(tmp_path_factory) -> Path:
    """Forty squares of smoothed noise with sharp blotches, packed as `scenes.pack` packs photographs."""
    random = np.random.default_rng(3)
    squares = []
    for _ in range(40):
        coarse = torch.from_numpy(random.random((1, 3, 64, 64), np.float32))
        picture = torch.nn.functional.interpolate(coarse, scale_factor=8, mode="bicubic")[0].clamp(0, 1)
        squares.append((picture.permute(1, 2, 0).numpy() * 255).astype(np.uint8))
    target = tmp_path_factory.mktemp("photographs") / "photographs.npz"
    np.savez(target, squares=np.stack(squares), owners=np.arange(40), names=[f"{i}" for i in range(40)])
    return target
