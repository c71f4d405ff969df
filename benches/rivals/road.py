"""A step's work beside the network in numpy and OpenCV: develop, judge, find the velocity, publish.

Usage: road.py VECTORS.f32   (what the network is taken to have found: 64 x 80 x (u, v), then 64 x 80 uncertainties)
"""

import struct
import sys
import time
from multiprocessing import shared_memory

import cv2
import numpy as np

import develop

COLUMNS, ROWS, SCALE = 80, 64, 16.0
K = np.array([[900.0, 0.0, 639.5], [0.0, 900.0, 511.5], [0.0, 0.0, 1.0]])
D = np.array([-0.02, 0.005, 0.0, 0.0, 0.0])
MOUNT = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
CONFIDENCE_MIN, SAMPLES_MAX, INLIERS_MIN, PART_MIN = 0.05, 1200, 60, 0.25
SEED_RAD, AGREE_RAD, SHARED_PX, GRAZING = 0.004, 0.015, 0.02, 0.1
CUT, ROUNDS, GUESSES, JURY, MEDIAN_LENGTH, SPREAD_MIN = 4.685, 10, 64, 240, 1.177410022515, 5e-5
INTERVAL, RANGE = 0.033333333, 5.0
# OpenCV's own five rounds leave 0.06 px at the corners of an ordinary lens, which is 0.1 m/s of climb.
ROUNDS_OF_LENS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-6)


class Judge:
    """Confidence, masks and state."""

    def __init__(self):
        rows, columns = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float32)
        self.middle = np.stack([(columns + 0.5) * 4, (rows + 0.5) * 4], axis=-1)

    def judge(self, flow, uncertainty, older, newer):
        if not (np.isfinite(flow).all() and np.isfinite(uncertainty).all()):
            raise ValueError("not finite")
        confidence = 1.0 - np.exp(-1.0 / np.maximum(uncertainty, 1e-6))
        to = self.middle + flow * np.float32(0.25)
        u, v = to[..., 0], to[..., 1]
        inside = (u >= 0) & (v >= 0) & (u < 320) & (v < 256)
        if older.any() or newer.any():
            covered = older.reshape(ROWS, 4, COLUMNS, 4).max(axis=(1, 3)) > 0
            x, y = np.clip(u, 0, 319).astype(np.intp), np.clip(v, 0, 255).astype(np.intp)
            inside &= ~(covered | (newer[y, x] != 0))
        confidence *= inside
        return confidence, float(confidence.mean(dtype=np.float64))


def turn(stamps, rates, older, newer):
    """The gyro integrated over the interval, interpolated at both ends (Rodrigues, one step a sample)."""
    inner = (stamps > older) & (stamps < newer)
    at = lambda t: np.array([np.interp(t, stamps, rates[:, i]) for i in range(3)])
    times = np.concatenate([[older], stamps[inner], [newer]])
    values = np.vstack([at(older), rates[inner], at(newer)])
    steps = np.diff(times)
    rotation = np.eye(3)
    for a, b, h in zip(values[:-1], values[1:], steps):
        rotation = rotation @ cv2.Rodrigues((a + b) * (0.5 * h) + np.cross(a, b) * (h * h / 12))[0]
    return rotation


class Odometer:
    def __init__(self):
        step = 1
        while -(-COLUMNS // step) * -(-ROWS // step) > SAMPLES_MAX:
            step += 1
        self.at = np.s_[step // 2 :: step, step // 2 :: step]
        rows, columns = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float64)
        pixels = np.stack([(columns + 0.5) * SCALE - 0.5, (rows + 0.5) * SCALE - 0.5], axis=-1)[self.at]
        self.shape = pixels.shape[:2]
        self.pixels = np.ascontiguousarray(pixels.reshape(-1, 1, 2))
        self.older = cv2.undistortPoints(self.pixels, K, D, None, None, None, ROUNDS_OF_LENS)[:, 0]
        self.draws = np.random.default_rng(1)

    def velocity(self, flow, confidence, rotation):
        confidence = confidence[self.at].reshape(-1).astype(np.float64)
        vectors = flow[self.at].reshape(-1, 1, 2).astype(np.float64)
        newer = cv2.undistortPoints(self.pixels + vectors, K, D, None, None, None, ROUNDS_OF_LENS)[:, 0]
        back = MOUNT.T @ rotation @ MOUNT
        turned = newer @ back[:, :2].T + back[:, 2]
        normal = MOUNT.T @ np.array([0.0, 0.0, -1.0])
        slope = self.older @ normal[:2] + normal[2]
        length = np.sqrt((self.older * self.older).sum(axis=1) + 1)
        offered = (confidence >= CONFIDENCE_MIN) & (slope >= GRAZING * length) & (turned[:, 2] >= 0.1)
        index = np.flatnonzero(offered)
        older, slope, confidence = self.older[index], slope[index], confidence[index]
        newer = turned[index, :2] / turned[index, 2:]
        weight = -2.0 * np.log(1.0 - np.minimum(confidence, 0.999))
        motion = newer - older
        # Two equations a vector: motion = A τ.
        A = np.zeros((len(index), 2, 3))
        A[:, 0, 0] = A[:, 1, 1] = -1.0
        A[:, :, 2] = newer
        A *= slope[:, None, None]
        needed = max(INLIERS_MIN, int(np.ceil(len(index) * PART_MIN)))
        tau = self.guess(A, motion)
        residual, measured = self.measure(A, motion, tau, weight, np.inf)
        flat, right = A.reshape(-1, 3), motion.reshape(-1)
        for _ in range(ROUNDS):
            pull = np.repeat(weight * self.tukey(residual, weight, measured), 2)
            weighted = flat * pull[:, None]
            found = np.linalg.solve(weighted.T @ flat, weighted.T @ right)
            moved = np.linalg.norm(found - tau)
            tau = found
            residual, measured = self.measure(A, motion, tau, weight, CUT * measured)
            if moved < 1e-12:
                break
        agrees = (self.tukey(residual, weight, measured) > 0) & (np.linalg.norm(residual, axis=1) <= AGREE_RAD)
        if agrees.sum() < needed:
            raise ValueError("disagreement")
        covariance = self.covariance(index, agrees, A, residual, weight, measured, older, newer, tau)
        scale = RANGE / INTERVAL
        to_body = rotation.T @ MOUNT * scale
        return to_body @ tau, to_body @ covariance @ to_body.T

    def guess(self, A, motion):
        """All guesses at once: two vectors each, scored on a jury by the truncated squares."""
        pick = self.draws.integers(0, len(A), (GUESSES, 2))
        equations, right = A[pick].reshape(GUESSES, 4, 3), motion[pick].reshape(GUESSES, 4)
        normal = np.einsum("gij,gik->gjk", equations, equations)
        sound = np.abs(np.linalg.det(normal)) > 1e-12 * (np.trace(normal, axis1=1, axis2=2) / 3) ** 3
        taus = np.linalg.solve(normal[sound], np.einsum("gij,gi->gj", equations, right)[sound][..., None])[..., 0]
        stride = -(-len(A) // JURY)
        jury, wanted = A[::stride].reshape(-1, 3), motion[::stride].reshape(-1)
        off = wanted[None] - taus @ jury.T
        squares = (off * off).reshape(len(taus), -1, 2).sum(axis=2)
        return taus[np.minimum(squares, SEED_RAD**2).sum(axis=1).argmin()]

    def measure(self, A, motion, tau, weight, cut):
        residual = motion - A @ tau
        length = np.sqrt((residual * residual).sum(axis=1))
        scaled = length * np.sqrt(weight)
        near = scaled[(length <= AGREE_RAD) & (scaled <= cut)]
        return residual, max(np.median(near) / MEDIAN_LENGTH, SPREAD_MIN) if len(near) else SPREAD_MIN

    def tukey(self, residual, weight, spread):
        squares = (residual * residual).sum(axis=1)
        part = weight * squares / (CUT * spread) ** 2
        return np.where((part < 1) & (squares <= AGREE_RAD**2), (1 - part) ** 2, 0.0)

    def covariance(self, index, agrees, A, residual, weight, spread, older, newer, tau):
        A, r, w = A[agrees], residual[agrees], weight[agrees]
        cut = (CUT * spread) ** 2
        part = w * (r * r).sum(axis=1) / cut
        bend = np.einsum("ni,nj->nij", r, r) * (4 * (1 - part) * w / cut)[:, None, None]
        slope = (np.eye(2) * ((1 - part) ** 2)[:, None, None] - bend) * w[:, None, None]
        bent = np.einsum("nji,njk->nik", A, slope)
        inverse = np.linalg.inv(np.einsum("nij,njk->ik", bent, A))
        pull = np.einsum("nji,nj->ni", A, r) * (w * (1 - part) ** 2)[:, None]
        noise = pull.T @ pull * self.likeness(index[agrees], r, w)
        x, y = newer[agrees].T
        rates = np.stack([np.stack([-x * y, 1 + x * x, -y], 1), np.stack([-(1 + y * y), x * y, x], 1)], 1)
        by_turn = inverse @ np.einsum("nij,njk->ik", bent, rates)
        by_shift = inverse @ bent.sum(axis=0)
        per_slope = np.stack([-tau[0] + x * tau[2], -tau[1] + y * tau[2]], 1)
        rays = np.column_stack([older[agrees], np.ones(len(r))])
        by_normal = inverse @ (np.einsum("nij,nj->ni", bent, per_slope).T @ rays)
        covariance = inverse @ noise @ inverse.T
        covariance += by_shift @ by_shift.T * (SHARED_PX / 900.0) ** 2
        covariance += by_turn @ by_turn.T * 1e-8 + by_normal @ by_normal.T * 0.05**2
        return covariance

    def likeness(self, index, r, w):
        """First-order autoregression along columns and rows."""
        raster, weights = np.zeros((*self.shape, 2)), np.zeros(self.shape)
        raster.reshape(-1, 2)[index] = r
        weights.reshape(-1)[index] = w
        squares = weights * (raster * raster).sum(axis=2)
        factor = 1.0
        for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
            both = (weights[a] > 0) & (weights[b] > 0)
            product = (np.sqrt(weights[a] * weights[b]) * (raster[a] * raster[b]).sum(axis=2)).sum()
            square = 0.5 * ((squares[a] + squares[b]) * both).sum()
            correlation = min(max(product / square, 0.0), 0.95)
            factor *= (1 + correlation) / (1 - correlation)
        return factor


class Memory:
    """Shared memory with a header: two copies and a struct."""

    def __init__(self):
        self.block = shared_memory.SharedMemory(create=True, size=256 + 12 * COLUMNS * ROWS)
        self.flow = np.frombuffer(self.block.buf, "<f4", 2 * COLUMNS * ROWS, 256).reshape(ROWS, COLUMNS, 2)
        self.confidence = np.frombuffer(self.block.buf, "<f4", COLUMNS * ROWS, 256 + 8 * COLUMNS * ROWS)

    def publish(self, step, flow, confidence, velocity, covariance, gain, mean):
        self.flow[...] = flow
        self.confidence[...] = confidence.reshape(-1)
        struct.pack_into("<qqd3d9df", self.block.buf, 0, step, time.time_ns(), gain, *velocity, *covariance.reshape(-1), mean)

    def close(self):
        self.flow = self.confidence = None
        self.block.close()
        self.block.unlink()


def main():
    cv2.setNumThreads(1)
    values = np.fromfile(sys.argv[1], "<f4")
    flow = values[: 2 * COLUMNS * ROWS].reshape(ROWS, COLUMNS, 2)
    uncertainty = values[2 * COLUMNS * ROWS :].reshape(ROWS, COLUMNS)
    messages = [develop.scene(1), develop.scene(2)]
    developer, judge, odometer, memory = develop.Developer(), Judge(), Odometer(), Memory()
    stamps = np.arange(0, 0.05, 0.005)
    rates = np.tile([0.02, -0.01, 0.0], (len(stamps), 1))
    older = np.zeros((256, 320), np.uint8)
    times, laps = [], []
    for i in range(200):
        start = time.perf_counter()
        _, saturated = developer.develop(messages[i % 2])
        developed = time.perf_counter()
        confidence, mean = judge.judge(flow, uncertainty, older, developer.mask)
        judged = time.perf_counter()
        velocity, covariance = odometer.velocity(flow, confidence, turn(stamps, rates, 0.0, INTERVAL))
        moved = time.perf_counter()
        memory.publish(i, flow, confidence, velocity, covariance, developer.gain, mean)
        end = time.perf_counter()
        older = developer.mask
        times.append(end - start)
        laps.append((developed - start, judged - developed, moved - judged, end - moved))
    memory.close()
    print(f"numpy {np.__version__}, OpenCV {cv2.__version__} on {cv2.getNumThreads()} thread")
    stages = np.median(np.array(laps), axis=0) * 1e3
    print("stages of the rival, medians: " + ", ".join(f"{n} {t:.2f} ms" for n, t in zip(("develop", "judge", "velocity", "publish"), stages)))
    print(f"best_and_median_ms {min(times) * 1e3:.4f} {np.median(times) * 1e3:.4f}")
    print("velocity", *(f"{v:.6f}" for v in velocity))


if __name__ == "__main__":
    main()
