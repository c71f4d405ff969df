"""Scenes and noise: the flow is exact, the noise is the one that is said, held-out photographs stay unseen."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

import scenes
from pairs import HeldOut, MEAN_LEVEL, linear, noisy, read_flo
from scenes import Textures, homographies, mapped, scene


def test_flow_carries_the_second_frame_back_onto_the_first(packed):
    torch.manual_seed(2)
    height, width = 128, 192
    first, second, flow = scene(Textures(packed, held_out=False), 8, height, width)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    there = torch.stack([x, y])[None] + flow
    grid = torch.stack([(there[:, 0] + 0.5) * 2 / width - 1, (there[:, 1] + 0.5) * 2 / height - 1], -1)
    back = F.grid_sample(second, grid, align_corners=False)
    inside = (grid.abs() < 0.98).all(-1)
    right = (back - first).abs().mean(1)[inside]
    still = (second - first).abs().mean(1)[inside]
    # Occlusions spoil some pixels, so medians; without the flow the difference is several times as large.
    assert right.median() < 0.004
    assert right.median() < 0.3 * still.median()


def test_no_motion_means_equal_frames_and_zero_flow(packed, monkeypatch):
    monkeypatch.setattr(scenes, "magnitudes", torch.zeros)
    torch.manual_seed(0)
    first, second, flow = scene(Textures(packed, held_out=False), 2, 64, 64)
    assert flow.abs().max() < 1e-3
    assert (first - second).abs().max() < 5e-3


def test_displacements_are_as_large_as_asked(packed):
    torch.manual_seed(0)
    centre, points = torch.full((400,), 100.0), torch.tensor([[[[100.0]], [[100.0]]]])
    motion = homographies(torch.full((400,), 10.0), centre, centre, 120.0)
    moved = (mapped(motion, points) - points).norm(dim=1)
    assert 1.9 < moved.min() and moved.max() < 10.1 and 5.0 < moved.mean() < 7.0


@pytest.mark.parametrize("level", [0, 10, 30])
def test_noise_has_the_deviation_that_its_level_says(level):
    torch.manual_seed(0)
    grey = torch.full((64, 3, 32, 32), MEAN_LEVEL)
    older, newer = noisy(grey, grey, level)
    for frame in (older, newer):
        deviations = (frame - grey).std((2, 3)) * 255
        assert abs(deviations.mean() - level) <= 0.05 * level
        assert (deviations <= 1.45 * level + 1e-3).all()
    if level:
        correlation = ((older - grey) * (newer - grey)).mean() / ((older - grey).std() * (newer - grey).std())
        assert abs(correlation) < 0.01


def test_linear_frames_share_one_gain_and_have_the_nodes_mean():
    torch.manual_seed(0)
    first = torch.rand(4, 3, 32, 32) * 0.5
    older, newer = linear(first, first * 0.9, jitter=False)
    torch.testing.assert_close(older.mean((1, 2, 3)), torch.full((4,), MEAN_LEVEL), rtol=0.05, atol=0)
    unclipped = (older < 0.999) & (newer > 1e-4)
    torch.testing.assert_close(newer[unclipped], older[unclipped] * 0.9**2.2, rtol=1e-3, atol=1e-4)


def test_held_out_photographs_are_never_trained_on(packed):
    seen, unseen = (Textures(packed, held_out=h).squares for h in (False, True))
    assert len(seen) == 20 and len(unseen) == scenes.HELD_OUT
    assert not any((u == s).all() for u in unseen for s in seen)


def test_held_out_pairs_are_the_same_every_time(packed):
    before = torch.get_rng_state()
    one, two = (HeldOut(packed, count=3, height=64, width=64) for _ in range(2))
    assert torch.equal(before, torch.get_rng_state())
    assert torch.equal(one.flow, two.flow) and torch.equal(one.at(20)[0], two.at(20)[0])
    assert not torch.equal(one.at(20)[0], one.at(20)[1])


def test_flo_files_are_read_and_wrong_ones_refused(tmp_path):
    flow = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
    flow[0, 0] = 2e9
    good = np.float32(202021.25).tobytes() + np.array([3, 2], "<i4").tobytes() + flow.tobytes()
    (tmp_path / "good.flo").write_bytes(good)
    read = read_flo(tmp_path / "good.flo")
    assert np.isnan(read[0, 0]).all() and (read[1] == flow[1]).all()
    wrong = (("magic", b"RIFF" * 5, "magic"), ("short", good[:-4], "expected 12 values, found 11"))
    for name, content, message in wrong:
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=message):
            read_flo(tmp_path / name)
