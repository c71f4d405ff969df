"""OpenCV's DIS and Farnebäck on the pairs that `nightflow eval ladder --write DARK` wrote, for the same tables.

    python flow.py DARK RESULTS

reads DARK/ENHANCER/CONDITION/PAIR_img1.png and _img2.png and writes RESULTS/METHOD/ENHANCER/CONDITION/PAIR_flow.flo.
Methods, on the grey of the 8-bit frames (OpenCV's weights):
- dis: Dense Inverse Search, preset medium.
- farneback: pyramid scale 0.5, 5 levels, window 15, 3 iterations, polynomials over 7 pixels with sigma 1.5, Gaussian
  window.
- cvnlm_dis: as dis after OpenCV's own fastNlMeansDenoisingColored (h 10, 10, 7, 21); only on frames without enhancer.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np


def grey(frame: np.ndarray) -> np.ndarray:
    """Luma of a BGR frame."""
    return cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)


def dis(older: np.ndarray, newer: np.ndarray) -> np.ndarray:
    """Dense Inverse Search (Kroeger et al. 2016)."""
    return cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(grey(older), grey(newer), None)


def farneback(older: np.ndarray, newer: np.ndarray) -> np.ndarray:
    """Polynomial expansion (Farnebäck 2003)."""
    window = cv2.OPTFLOW_FARNEBACK_GAUSSIAN
    return cv2.calcOpticalFlowFarneback(grey(older), grey(newer), None, 0.5, 5, 15, 3, 7, 1.5, window)


def cvnlm_dis(older: np.ndarray, newer: np.ndarray) -> np.ndarray:
    """Non-local means first."""
    return dis(*(cv2.fastNlMeansDenoisingColored(frame, None, 10, 10, 7, 21) for frame in (older, newer)))


METHODS = {"dis": dis, "farneback": farneback, "cvnlm_dis": cvnlm_dis}


def write_flo(path: Path, flow: np.ndarray) -> None:
    """Middlebury's format."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = flow.shape[:2]
    with open(path, "wb") as file:
        file.write(b"PIEH" + np.array([width, height], "<i4").tobytes() + flow.astype("<f4").tobytes())


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dark", type=Path, help="folder that nightflow wrote")
    parser.add_argument("results", type=Path, help="folder to write into")
    parser.add_argument("--methods", default="dis,farneback", help=f"of {', '.join(METHODS)}")
    arguments = parser.parse_args()
    firsts = sorted(arguments.dark.glob("*/*/*_img1.png"))
    if not firsts:
        raise SystemExit(f"{arguments.dark}: expected ENHANCER/CONDITION/PAIR_img1.png, found none")
    for first in firsts:
        second = first.with_name(first.name.replace("_img1.png", "_img2.png"))
        frames = [cv2.imread(str(path)) for path in (first, second)]
        if any(frame is None for frame in frames):
            print(f"{first}: left out, a frame of it can't be read")
            continue
        enhancer, condition = first.parts[-3:-1]
        for name in arguments.methods.split(","):
            if name == "cvnlm_dis" and enhancer != "none":
                continue
            target = arguments.results / name / enhancer / condition / first.name.replace("_img1.png", "_flow.flo")
            write_flo(target, METHODS[name](*frames))
    print(f"{len(firsts)} pairs by {arguments.methods} into {arguments.results}")


if __name__ == "__main__":
    main()
