"""Reads the flow files that Nightflow wrote, with OpenCV alone, and writes its own: FOLDER holds ours.flo and ours.png."""

import sys
from pathlib import Path

import cv2
import numpy as np

folder = Path(sys.argv[1])
flow = cv2.readOpticalFlow(str(folder / "ours.flo"))
known = (np.abs(flow) < 1e9).all(2)
kitti = cv2.imread(str(folder / "ours.png"), cv2.IMREAD_UNCHANGED)[:, :, ::-1]
assert kitti.dtype == np.uint16, kitti.dtype
assert (kitti[:, :, 2].astype(bool) == known).all()
vectors = (kitti[:, :, :2].astype(np.float64) - 2**15) / 64
assert np.abs(vectors - flow)[known].max() <= 1 / 128
print(flow.shape[1], flow.shape[0], int(known.sum()), f"{flow[known].astype(np.float64).sum():.3f}")
cv2.writeOpticalFlow(str(folder / "theirs.flo"), flow)
cv2.imwrite(str(folder / "theirs.png"), kitti[:, :, ::-1])
