"""Dark pairs as numpy and OpenCV make them, on all cores: what `benches/fcdn.rs` is measured against.

Usage: fcdn.py FROM TO CORES. Every way is timed twice over all pairs, in processes that are warm; the shorter time counts.
"""

import multiprocessing
import os
import shutil
import sys
import time

import cv2
import numpy as np

SOURCE, TARGET, CORES = sys.argv[1], sys.argv[2], int(sys.argv[3])
NOISE_A, NOISE_B = 0.01, 0.0005


def path(folder, name, part):
    return os.path.join(folder, f"{name}_{part}")


def authors_script(name):
    """The authors' script of 2021, line by line."""
    img1, img2 = (cv2.imread(path(SOURCE, name, f"img{k}.ppm")) for k in (1, 2))
    a, b = abs(np.random.normal(0, 19.5 / 255.0)), abs(np.random.normal(0, 38.25))
    sd1, sd2 = abs(a * img1 + b), abs(a * img2 + b)
    noisy1, noisy2 = img1 + np.random.normal(0, sd1), img2 + np.random.normal(0, sd2)
    noisy1, noisy2 = np.clip(noisy1.astype(int), 0, 255), np.clip(noisy2.astype(int), 0, 255)
    gains = np.array([[[1.0 / np.random.normal(1.0, 0.05) for _ in range(3)]]])
    out1, out2 = np.multiply(noisy1, gains), np.multiply(noisy2, gains)
    out1, out2 = np.clip(out1.astype(int), 0, 255), np.clip(out2.astype(int), 0, 255)
    cv2.imwrite(path(TARGET, name, "img1.ppm"), out1.astype(np.uint8))
    cv2.imwrite(path(TARGET, name, "img2.ppm"), out2.astype(np.uint8))


def paper_plain(name):
    """The paper's text in the style of that script."""
    gamma = np.random.uniform(1.0, 2.4, (1, 1, 3))
    for k in (1, 2):
        clean = (cv2.imread(path(SOURCE, name, f"img{k}.ppm")) / 255.0) ** gamma
        noisy = clean + np.random.normal(0, np.sqrt(NOISE_A * clean + NOISE_B))
        out = (np.clip(noisy, 0, 1) * 255 + 0.5).astype(np.uint8)
        cv2.imwrite(path(TARGET, name, f"img{k}.ppm"), out)


def tables(gamma):
    """Mean and deviation of every byte, a column a colour."""
    mean = (np.arange(256, dtype=np.float64)[:, None] / 255) ** gamma
    sigma = np.sqrt(NOISE_A * mean + NOISE_B)
    return tuple((255 * table)[None].astype(np.float32) for table in (mean, sigma))


def paper_tuned(name, kept={}):
    """As fast as numpy can: tables for all but the draw, single precision, the fastest generator, arrays kept."""
    rng = kept.setdefault("rng", np.random.Generator(np.random.SFC64()))
    mean_of, sigma_of = tables(rng.uniform(1.0, 2.4, 3))
    for k in (1, 2):
        image = cv2.imread(path(SOURCE, name, f"img{k}.ppm"))
        mean, sigma, noise = kept.setdefault(image.shape, [np.empty(image.shape, np.float32) for _ in range(3)])
        cv2.LUT(image, mean_of, mean)
        cv2.LUT(image, sigma_of, sigma)
        rng.standard_normal(out=noise, dtype=np.float32)
        cv2.multiply(noise, sigma, noise)
        cv2.add(noise, mean, noise)
        # Rounds and clips to a byte.
        cv2.imwrite(path(TARGET, name, f"img{k}.ppm"), cv2.add(noise, 0.0, dtype=cv2.CV_8U))


def copy_flow(name):
    shutil.copyfile(path(SOURCE, name, "flow.flo"), path(TARGET, name, "flow.flo"))


def warm(_):
    cv2.setNumThreads(1)
    np.random.seed(os.getpid())
    time.sleep(0.2)


def main():
    names = sorted(f[: -len("_flow.flo")] for f in os.listdir(SOURCE) if f.endswith("_flow.flo"))
    with multiprocessing.Pool(CORES) as pool:
        pool.map(warm, range(CORES), chunksize=1)
        for way in (authors_script, paper_plain, paper_tuned, copy_flow):
            seconds = []
            for _ in range(2):
                start = time.perf_counter()
                pool.map(way, names, chunksize=4)
                seconds.append(time.perf_counter() - start)
            print(f"{way.__name__} {1e3 * min(seconds) / len(names):.4f}", flush=True)


if __name__ == "__main__":
    main()
