"""Scenes and noise: the flow is exact, the noise is the one that is said, held-out photographs stay unseen."""

import struct
import sys

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image

import scenes
from pairs import (MEAN_LEVEL, RECIPES, HeldOut, Stream, authors, authors_drawn, batch_of, linear, noisy, public_pairs,
                   read_flo, unprocess, unprocess_drawn)
from scenes import Bank, Textures, homographies, mapped, scene


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


def test_a_bank_shows_its_scenes_in_windows_and_mirrors(packed):
    torch.manual_seed(2)
    bank = Bank.made(Textures(packed, held_out=False), 9, 96, 128, mixture=[(1.0, 2.0, 5.0)])
    assert bank.frames.shape == (9, 2, 3, 96, 128) and bank.flow.shape == (9, 2, 96, 128)
    first, second, flow = batch_of(bank, 64, 96, None, batch=64)
    assert first.shape == second.shape == (64, 3, 64, 96) and flow.shape == (64, 2, 64, 96)
    first, second, flow = bank.draw(64, 64, 96)
    y, x = torch.meshgrid(torch.arange(64), torch.arange(96), indexing="ij")
    there = torch.stack([x, y])[None] + flow
    grid = torch.stack([(there[:, 0] + 0.5) * 2 / 96 - 1, (there[:, 1] + 0.5) * 2 / 64 - 1], -1)
    back = F.grid_sample(second, grid, align_corners=False)
    inside = (grid.abs() < 0.98).all(-1)
    # Of every mirror image too: a sign that were wrong would be seen in three quarters of them.
    of = lambda other: torch.stack([e[seen].mean() for e, seen in zip((other - first).abs().mean(1), inside)])
    right, still = of(back), of(second)
    told = still > 0.02
    assert told.sum() > 32 and (right < 0.5 * still)[told].float().mean() > 0.9
    shown = {tuple(window.flatten()[:50].tolist()) for window in flow}
    assert len(shown) > 9 * 4


def test_a_kept_bank_is_shared_and_another_is_refused(packed, tmp_path):
    textures, file = Textures(packed, held_out=False), tmp_path / "bank.pt"
    described = {"count": 3, "height": 64, "width": 64, "mixture": [[1.0, 0.5, 2.0]]}
    before = torch.get_rng_state()
    made = Bank.kept(file, textures, 5, **described)
    again = Bank.kept(file, textures, 5, **described)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(made.frames, again.frames) and torch.equal(made.flow, again.flow)
    with pytest.raises(ValueError, match="expected a bank of .*'seed': 6.*, found one of .*'seed': 5"):
        Bank.kept(file, textures, 6, **described)


def test_no_motion_means_equal_frames_and_zero_flow(packed):
    torch.manual_seed(0)
    first, second, flow = scene(Textures(packed, held_out=False), 2, 64, 64, mixture=[(1.0, 0.0, 0.0)])
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


def test_what_a_gpu_fetches_is_what_a_cpu_fetches(packed):
    textures = Textures(packed, held_out=False)
    torch.manual_seed(3)
    cut = textures.draw(5, 64)
    textures.words = torch.nn.functional.pad(textures.squares, (0, 1)).view(torch.int32).flatten()
    torch.manual_seed(3)
    assert torch.equal(textures.draw(5, 64), cut)
    bank = Bank.made(textures, 4, 64, 128)
    which, down, right = torch.tensor([2, 0, 2]), torch.tensor([0, 5, 16]), torch.tensor([64, 0, 7])
    gathered = bank.gathered(which, down[:, None] + torch.arange(48), right[:, None] + torch.arange(64))
    for one, other in zip(gathered, bank.windows(which, down, right, 48, 64)):
        assert one.shape == other.shape and torch.equal(one, other)


def test_shapes_that_move_apart_are_fast_over_a_still_ground(packed):
    textures, still = Textures(packed, held_out=False), ((1.0, 0.0, 0.0),)
    torch.manual_seed(3)
    _, _, together = scenes.scene(textures, 4, 64, 64, still, shapes=3)
    assert together.abs().max() < 1e-3
    _, _, apart = scenes.scene(textures, 8, 64, 64, still, shapes=3, apart=((0.5, 8.0, 16.0), (0.5, 0.0, 1.0)))
    speed = apart.norm(dim=1)
    assert (speed > 2).float().mean() > 0.05 and (speed < 1e-3).float().mean() > 0.3


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


def stream_of(tmp_path, count, height=4, width=6, version=1):
    """A command that writes a stream of the documented layout, and its records."""
    head = struct.pack("<8s6I3Q", b"NFPAIRS\0", version, 96, width, height, 2, 40 + height * width * 11, 7, 100, count)
    head += b"paper".ljust(16, b"\0") + b"mixed".ljust(16, b"\0") + bytes(8)
    rng = np.random.default_rng(1)
    body = b""
    for index in range(count):
        frames = rng.integers(0, 256, (2, height, width, 3), dtype=np.uint8)
        flow = rng.integers(-40, 40, (height, width, 2)).astype("<f2")
        valid = rng.integers(0, 2, (height, width), dtype=np.uint8)
        body += struct.pack("<Q7fI", 100 + index, 1, 2, 3, 4, 5, 6, 10.5, 0)
        body += frames.tobytes() + flow.tobytes() + valid.tobytes()
    path = tmp_path / "stream"
    path.write_bytes(head + body)
    copy = "import shutil, sys; shutil.copyfileobj(open(sys.argv[1], 'rb'), sys.stdout.buffer)"
    return [sys.executable, "-c", copy, str(path)], body


def test_a_stream_becomes_batches_and_ends(tmp_path):
    command, body = stream_of(tmp_path, 5)
    stream = Stream(command)
    assert (stream.recipe, stream.preset, stream.seed, stream.first, stream.count) == ("paper", "mixed", 7, 100, 5)
    older, newer, flow, valid, level = stream.batch(2)
    assert older.shape == newer.shape == (2, 3, 4, 6) and flow.shape == (2, 2, 4, 6) and valid.shape == (2, 1, 4, 6)
    first = np.frombuffer(body[40 : 40 + 72], np.uint8).reshape(4, 6, 3)
    assert torch.equal((older[0] * 255).round().byte(), torch.from_numpy(first.copy()).permute(2, 0, 1))
    vectors = np.frombuffer(body[40 + 144 : 40 + 144 + 96], "<f2").reshape(4, 6, 2)
    assert (flow[0].permute(1, 2, 0).numpy() == vectors).all() and (level == 10.5).all()
    assert list(stream.records(9)["index"]) == [102, 103, 104]
    with pytest.raises(EOFError, match="all 5 pairs"):
        stream.records(1)
    stream.close()


def test_a_torn_or_foreign_stream_is_refused(tmp_path):
    command, _ = stream_of(tmp_path, 2)
    path = tmp_path / "stream"
    path.write_bytes(path.read_bytes()[:-1])
    stream = Stream(command)
    with pytest.raises(EOFError, match="expected"):
        stream.batch(2)
    command, _ = stream_of(tmp_path, 1, version=2)
    with pytest.raises(ValueError, match="version 2"):
        Stream(command)


def test_pairs_in_the_layout_of_flyingchairs_are_read(tmp_path):
    flow = np.ones((2, 3, 2), np.float32)
    (tmp_path / "00001_flow.flo").write_bytes(
        np.float32(202021.25).tobytes() + np.array([3, 2], "<i4").tobytes() + flow.tobytes()
    )
    for i in (1, 2):
        Image.fromarray(np.full((2, 3, 3), 60 * i, np.uint8)).save(tmp_path / f"00001_img{i}.ppm")
    ((name, older, newer, read),) = public_pairs(tmp_path)
    assert name == "00001" and read.shape == (1, 2, 2, 3) and (newer == 2 * older).all()


@pytest.mark.parametrize("grey", [0, 60, 200])
def test_the_authors_noise_has_the_moments_of_its_definition(grey):
    torch.manual_seed(0)
    a, b, gain = torch.tensor([0.0, 0.02]), torch.tensor([4.0, 3.0]), torch.tensor([[1.0, 0.9137, 1.0713]] * 2)
    clean = torch.full((2, 3, 256, 256), grey / 255)
    older, newer = authors(clean, clean, a, b, gain)
    draws = torch.linspace(-6, 6, 20001, dtype=torch.double)
    weights = torch.exp(-(draws**2) / 2) / torch.exp(-(draws**2) / 2).sum()
    for pair in range(2):
        for colour in range(3):
            # The definition, cut for cut, summed over the normal curve.
            seen = (grey + (a[pair] * grey + b[pair]).double() * draws).clamp(0, 255).trunc()
            seen = (seen * gain[pair, colour]).clamp(0, 255).trunc()
            mean = (weights * seen).sum()
            variance = (weights * (seen - mean) ** 2).sum()
            for frame in (older, newer):
                values = 255 * frame[pair, colour].double()
                assert (values - values.round()).abs().max() < 1e-4
                assert abs(values.mean() - mean) < 5 * (variance / values.numel()).sqrt() + 1e-3
                assert values.var() == pytest.approx(variance.item(), rel=0.04)
    assert not torch.equal(older, newer)


def test_the_authors_figures_are_drawn_as_they_said():
    torch.manual_seed(0)
    a, b, gain = authors_drawn(20000)
    # The mean of |N(0, s)| is s times the root of 2/pi.
    for values, deviation in ((a, 19.5 / 255), (b, 38.25)):
        assert values.min() >= 0 and values.mean() == pytest.approx(deviation * (2 / np.pi) ** 0.5, rel=0.02)
    assert gain.shape == (20000, 3) and (1 / gain).mean() == pytest.approx(1, abs=2e-3)
    assert (1 / gain).std() == pytest.approx(0.05, rel=0.02)


@pytest.mark.parametrize("grey", [120, 200])
def test_unprocessed_greys_have_the_moments_of_the_definition(grey):
    torch.manual_seed(0)
    matrix, gain, _, _ = unprocess_drawn(2)
    a, b = torch.tensor([1e-3, 2e-3]), torch.tensor([1e-5, 4e-5])
    clean = torch.full((2, 3, 256, 256), grey / 255)
    frames = unprocess(clean, clean, matrix, gain, a, b)
    # By halving, where the code has a closed form: the x of 3 x^2 - 2 x^3 = y.
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if middle * middle * (3 - 2 * middle) < grey / 255 else (low, middle)
    for pair in range(2):
        for colour in range(3):
            # A camera's rows sum to one, so that a grey stays the same grey.
            mean = low**2.2 * gain[pair, colour].item()
            variance = (a[pair] * mean + b[pair]).item() + 1 / 12 / 255**2
            assert mean - 4 * variance**0.5 > 0, "nothing is clipped"
            for frame in frames:
                values = frame[pair, colour].double()
                assert abs(values.mean() - mean) < 5 * (variance / values.numel()) ** 0.5
                assert values.var() == pytest.approx(variance, rel=0.04)
    assert not torch.equal(*frames)


def test_unprocessed_highlights_stay_white():
    white = torch.ones(1, 3, 4, 4)
    matrix, gain, *_ = unprocess_drawn(1)
    frames = unprocess(white, white, matrix, gain, torch.zeros(1), torch.zeros(1))
    assert all((frame == 1).all() for frame in frames)


def test_unprocess_draws_cameras_gains_and_noise_of_the_published_ranges():
    torch.manual_seed(0)
    matrix, gain, a, b = unprocess_drawn(20000)
    torch.testing.assert_close(matrix.sum(2), torch.ones(20000, 3))
    own = matrix.diagonal(dim1=1, dim2=2)
    assert 0.4 < own.min() and own.max() < 1.2
    assert gain[:, 1].mean() == pytest.approx(0.8, abs=3e-3) and gain[:, 1].std() == pytest.approx(0.1, rel=0.02)
    for colour, (least, most) in ((0, (1.9, 2.4)), (2, (1.5, 1.9))):
        undone = gain[:, 1] / gain[:, colour]
        assert least <= undone.min() + 1e-4 and undone.max() <= most + 1e-4
        assert undone.mean() == pytest.approx((least + most) / 2, rel=0.01)
    ln_a, ln_b = a.log(), b.log()
    assert 0.0001 <= a.min() * 1.0001 and a.max() <= 0.012 * 1.0001
    assert ln_a.mean() == pytest.approx(np.log(0.0001 * 0.012) / 2, abs=0.05)
    left = ln_b - 2.18 * ln_a - 1.20
    assert left.mean() == pytest.approx(0, abs=0.01) and left.std() == pytest.approx(0.26, rel=0.02)


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_makes_batches(packed, recipe):
    torch.manual_seed(0)
    level = torch.full((2,), 10.0) if recipe == "paper" else None
    older, newer, flow = batch_of(Textures(packed, held_out=False), 64, 64, level, batch=2, recipe=recipe)
    assert older.shape == newer.shape == (2, 3, 64, 64) and flow.shape == (2, 2, 64, 64)
    assert 0 <= older.min() and older.max() <= 1 and older.isfinite().all() and older.std() > 0.01
