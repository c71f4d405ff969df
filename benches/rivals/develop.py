"""The exposure stage's steps in numpy and OpenCV, as fast as their whole-array calls allow.

Usage: develop.py IMAGE.f32   (the planar image that the bench developed from the same frames, to compare with)
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


RING = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
FAR = [(-1, -2), (1, -2), (-1, 2), (1, 2)]


def repair(raw):
    """Hot pixels; only the few candidates of a whole-array screen are looked at one by one."""
    left, right = raw[:, :-2], raw[:, 2:]
    noise = cv2.absdiff(left, right).mean(axis=1)
    above = np.maximum((HOT * noise).astype(np.uint16), FLOOR)
    middle = raw[:, 2:-2]
    excess = cv2.subtract(middle, cv2.max(raw[:, :-4], raw[:, 4:]))
    found = None
    for y, x in zip(*np.nonzero(excess > above[:, None])):
        x = x + 2
        if not (3 <= y < HEIGHT - 3 and 3 <= x < WIDTH - 3):
            continue
        ring = np.sort(np.delete(raw[y - 2 : y + 3 : 2, x - 2 : x + 3 : 2].ravel(), 4)).astype(int)
        count, limit = int(raw[y, x]), int(above[y])
        if count <= ring[7] + max(limit, 2 * (ring[7] - ring[0])):
            continue
        rows = max(int(raw[y, x - 1]), int(raw[y, x + 1]))
        rows -= max(int(raw[y + dy, x + dx]) for dx, dy in FAR)
        columns = max(int(raw[y - 1, x]), int(raw[y + 1, x]))
        columns -= max(int(raw[y + dx, x + dy]) for dx, dy in FAR)
        if max(rows, columns, 0) <= (count - ring[7]) / 8 + 2 * noise[y]:
            found = raw.copy() if found is None else found
            found[y, x] = (ring[3] + ring[4] + 1) // 2
    return raw if found is None else found


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
            full = (repaired >= WHITE).view(np.uint8)
            saturated = full.reshape(OUT[1], 4, OUT[0], 4).max(axis=(1, 3))
        mean = float(reduced.mean(dtype=np.float64))
        gain = self.choose(mean)
        if self.reduced is not None and gain != self.gain:
            self.older = np.clip(self.reduced * gain, 0, 1)
        else:
            self.older = self.rgb
        self.rgb = np.multiply(reduced, gain)
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
    messages = [scene(1), scene(2)]
    developer = Developer()
    times = []
    for i in range(200):
        start = time.perf_counter()
        developer.develop(messages[i % 2])
        times.append(time.perf_counter() - start)
    theirs = np.fromfile(sys.argv[1], "<f4").reshape(developer.rgb.shape)
    worst = float(np.abs(theirs - developer.rgb).max())
    print(f"numpy {np.__version__}, OpenCV {cv2.__version__} on {cv2.getNumThreads()} threads")
    print(f"largest difference between the images {worst:.2e}")
    if not worst < 1e-4:
        sys.exit("the images differ")
    print(f"median_ms {np.median(times) * 1e3:.3f}")


if __name__ == "__main__":
    main()
