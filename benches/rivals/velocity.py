"""OpenCV's sparse Lucas–Kanade or DIS for `cargo bench --bench velocity`, pair after pair over standard in and out.

    python velocity.py lk|dis

A pair comes as two little-endian u32 (columns, rows) and two grey images of 8 bits, linear with a mean of 0.4, as the
network sees them. An answer is, for every cell of 4 × 4 pixels row by row, (u, v) in pixels, then for every cell an
expected error in pixels: all alike, and a thousand where a track was lost.

- lk: pyramids of four levels, windows of 21, from the cells' centres; a track that does not come back to within half a
  pixel when it is followed backwards is lost.
- dis: Dense Inverse Search, preset medium, sampled at the cells' centres.
"""

import struct
import sys

import cv2
import numpy as np

LOST = 1000.0
WINDOW = {"winSize": (21, 21), "maxLevel": 4}


def lk(older: np.ndarray, newer: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tracks from the centres, there and back."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(older, newer, centres, None, **WINDOW)
    back, kept, _ = cv2.calcOpticalFlowPyrLK(newer, older, there, None, **WINDOW)
    good = (found[:, 0] == 1) & (kept[:, 0] == 1) & (np.linalg.norm(back - centres, axis=1) < 0.5)
    return np.where(good[:, None], there - centres, 0.0), np.where(good, 1.0, LOST)


def dis(older: np.ndarray, newer: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dense flow at the centres, which lie between four pixels."""
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(older, newer, None)
    at = np.floor(centres).astype(int)
    x, y = at[:, 0], at[:, 1]
    return (flow[y, x] + flow[y, x + 1] + flow[y + 1, x] + flow[y + 1, x + 1]) / 4, np.ones(len(centres))


def main() -> None:
    """Answers until the input ends."""
    cv2.setNumThreads(1)
    method = {"lk": lk, "dis": dis}[sys.argv[1]]
    stream = sys.stdin.buffer
    while len(head := stream.read(8)) == 8:
        columns, rows = struct.unpack("<II", head)
        images = [np.frombuffer(stream.read(columns * rows), np.uint8).reshape(rows, columns) for _ in range(2)]
        row, column = np.mgrid[0 : rows // 4, 0 : columns // 4].astype(np.float32)
        centres = np.stack([4 * column + 1.5, 4 * row + 1.5], axis=-1).reshape(-1, 2)
        flow, error = method(*images, centres)
        sys.stdout.buffer.write(flow.astype("<f4").tobytes() + error.astype("<f4").tobytes())
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
