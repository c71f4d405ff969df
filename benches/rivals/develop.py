"""The exposure stage's steps in numpy and OpenCV, as fast as their whole-array calls allow.

Usage: develop.py IMAGE.f32 PART   (what the bench developed from the same frames, to compare with: the planar image
and the part of it that is saturated)
"""

import sys
import time

import cv2
import numpy as np

WIDTH, HEIGHT, BLACK, WHITE, DEPTH = 1280, 1024, 64, 4095, 12
OUT = (320, 256)
TARGET, GAIN_MAX, BAND, SMOOTHING, STEP = 0.4, 1000.0, 0.1, 0.2, 2.0
HOT, FLOOR = 8.0, 4


def scene(seed):
    """The bench's frame, by the same formula."""
    x = np.arange(WIDTH, dtype=np.uint32)[None, :]
    y = np.arange(HEIGHT, dtype=np.uint32)[:, None]
    z = x * np.uint32(0x9E3779B9) ^ y * np.uint32(0x85EBCA6B) ^ np.uint32(seed * 0xC2B2AE35 & 0xFFFFFFFF)
    z = (z ^ (z >> 16)) * np.uint32(0x7FEB352D)
    z = (z ^ (z >> 15)) * np.uint32(0x846CA68B)
    z ^= z >> 16
    noise = (z & 15) + (z >> 4 & 15)
    ground = 20 + 60 * ((x // 64 + y // 64) % 2)
    counts = BLACK + ground + noise - 15
    counts[(x % 160 == 97) & (y % 128 == 33)] = 3000
    counts[500:540, 600:640] = WHITE
    return counts.astype("<u2").tobytes()


def offsets(*pairs):
    return np.array([dx for dx, _ in pairs]), np.array([dy for _, dy in pairs])


RING = offsets((-2, -2), (0, -2), (2, -2), (-2, 0), (2, 0), (-2, 2), (0, 2), (2, 2))
ROWS, ROWS_BESIDE = offsets((-1, 0), (1, 0)), offsets((-1, -2), (1, -2), (-1, 2), (1, 2))
COLUMNS, COLUMNS_BESIDE = offsets((0, -1), (0, 1)), offsets((-2, -1), (2, -1), (-2, 1), (2, 1))


def repair(raw):
    """Hot pixels: a whole-array screen by rows, then the few suspects all at once."""
    noise = cv2.reduce(cv2.absdiff(raw[:, :-2], raw[:, 2:]), 1, cv2.REDUCE_AVG, dtype=cv2.CV_32F)[:, 0]
    above = np.maximum((HOT * noise).astype(np.uint16), FLOOR)
    excess = cv2.subtract(raw[:, 2:-2], cv2.max(raw[:, :-4], raw[:, 4:]))
    rows = np.flatnonzero(excess.max(axis=1) > above)
    y, x = np.nonzero(excess[rows] > above[rows, None])
    y, x = rows[y], x + 2
    inside = (y >= 3) & (y < HEIGHT - 3) & (x >= 3) & (x < WIDTH - 3)
    y, x = y[inside], x[inside]
    at = lambda where: raw[y[:, None] + where[1], x[:, None] + where[0]].astype(int)
    around = np.sort(at(RING), axis=1)
    count, darkest, brightest = raw[y, x].astype(int), around[:, 0], around[:, 7]
    stands = count > brightest + np.maximum(above[y], 2 * (brightest - darkest))
    rise = np.maximum(
        at(ROWS).max(axis=1) - at(ROWS_BESIDE).max(axis=1),
        at(COLUMNS).max(axis=1) - at(COLUMNS_BESIDE).max(axis=1),
    )
    hot = stands & (np.maximum(rise, 0) <= (count - brightest) / 8 + 2 * noise[y])
    if not hot.any():
        return raw
    repaired = raw.copy()
    repaired[y[hot], x[hot]] = (around[hot, 3] + around[hot, 4] + 1) // 2
    return repaired


BLOCK = np.ones((4, 4), np.uint8)


class Developer:
    def __init__(self):
        self.raw = self.reduced = self.rgb = self.older = None
        self.gain = self.smoothed = 0.0
        self.mean = 0.0

    def develop(self, message):
        raw = np.frombuffer(message, "<u2").reshape(HEIGHT, WIDTH)
        bits = np.bitwise_or.reduce(raw, axis=None)
        if bits >> DEPTH:
            raise ValueError("counts above the bit depth")
        if bits and not bits & 15:
            raise ValueError("low bits are zero")
        frozen = self.raw is not None and np.array_equal(self.raw, raw)
        self.raw = raw
        repaired = repair(raw)
        planes = [
            cv2.resize(repaired[dy::2, dx::2].astype(np.float32), OUT, interpolation=cv2.INTER_AREA)
            for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1))
        ]
        reduced = np.empty((3, OUT[1], OUT[0]), np.float32)
        reduced[0], reduced[2] = planes[0], planes[3]
        cv2.addWeighted(planes[1], 0.5, planes[2], 0.5, 0, dst=reduced[1])
        reduced -= BLACK
        reduced *= 1.0 / (WHITE - BLACK)
        saturated = np.zeros((OUT[1], OUT[0]), np.uint8)
        if repaired.max() >= WHITE:
            full = cv2.dilate(cv2.compare(repaired, WHITE, cv2.CMP_GE), BLOCK, anchor=(0, 0))
            saturated = cv2.resize(full, OUT, interpolation=cv2.INTER_NEAREST) & 1
        self.mask = saturated
        mean = float(reduced.mean(dtype=np.float64))
        gain = self.choose(mean)
        if self.reduced is not None and gain != self.gain:
            self.older = np.clip(self.reduced * gain, 0, 1)
        else:
            self.older = self.rgb
        self.rgb = np.multiply(reduced, np.float32(gain))
        np.clip(self.rgb, 0, 1, out=self.rgb)
        self.reduced, self.gain, self.mean = reduced, gain, mean
        return frozen, saturated.mean()

    def choose(self, mean):
        mean = max(mean, TARGET / GAIN_MAX)
        if not self.gain:
            self.smoothed = mean
            return TARGET / mean
        both = (mean * max(self.mean, TARGET / GAIN_MAX)) ** 0.5
        self.smoothed += SMOOTHING * (mean - self.smoothed)
        off = TARGET / self.smoothed / self.gain
        if off > 1 + BAND or off * (1 + BAND) < 1:
            self.smoothed = both
            return TARGET / both
        return self.gain


def main():
    # As many as the other side has; more only wait for each other at these sizes.
    cv2.setNumThreads(1)
    messages = [scene(1), scene(2)]
    developer = Developer()
    times = []
    for i in range(200):
        start = time.perf_counter()
        _, saturated = developer.develop(messages[i % 2])
        times.append(time.perf_counter() - start)
    theirs = np.fromfile(sys.argv[1], "<f4").reshape(developer.rgb.shape)
    worst = float(np.abs(theirs - developer.rgb).max())
    print(f"numpy {np.__version__}, OpenCV {cv2.__version__} on {cv2.getNumThreads()} thread")
    print(f"largest difference between the images {worst:.2e}")
    if not worst < 1e-4:
        sys.exit("the images differ")
    theirs, ours = float(sys.argv[2]), saturated
    if abs(theirs - ours) > 1e-6:
        sys.exit(f"the saturated parts differ: {theirs} and {ours}")
    print(f"best_ms {min(times) * 1e3:.3f}")
    print(f"median_ms {np.median(times) * 1e3:.3f}")


if __name__ == "__main__":
    main()
