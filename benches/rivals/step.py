"""One step of a rival at a time, for `nightflow bench --rivals`, which lets this and its own steps run in turns.

    python step.py WIDTH HEIGHT THREADS

answers each line of JSON on standard input with one on standard output:
- {"need": PACKAGE} of PACKAGES: {"version": TEXT}, or {"missing": what pip installs, "why": TEXT};
- {"open": NAME, "kind": "openvino", "bits": "f32" or "bf16", "pyramid": FILE, "decoder": FILE}, or
  {"open": NAME, "kind": "dis" or "farneback"}: {"opened": NAME};
- {"step": NAME}: {"ms": what it took, from a new frame in memory to its flow in memory}.
What can't be done is answered with {"error": TEXT}.

The frames are those that nightflow makes, by the same formula. The same graphs run in OpenVINO with the size of the images
fixed, which favours it; DIS and Farnebäck get 8-bit grey and the settings of flow.py.
"""

import importlib
import json
import os
import sys
import time

NUMPY = "numpy==2.4.6"
PACKAGES = {"openvino": f"{NUMPY} openvino==2026.4.1", "cv2": f"{NUMPY} opencv-python-headless==5.0.0.93"}
# Sides of images are made multiples of this, as nightflow does.
STRIDE = 64
FRAMES = 4


def picture(width, height, number):
    """Frame [3, height, width] of a moving pattern, by nightflow's formula."""
    import numpy as np

    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    x, y = x + 2 * number, y + number
    plane = 0.4 + 0.2 * np.sin(0.31 * x + 0.17 * y) * np.cos(0.23 * y - 0.11 * x)
    plane += 0.1 * np.sin(0.9 * x) * np.sin(0.7 * y)
    return np.stack([plane] * 3).astype(np.float32)


class OpenVino:
    """The same pyramid and decoder: one frame is looked at a step, the other's features are kept, nothing is copied."""

    def __init__(self, width, height, threads, asked):
        import openvino

        bits = asked["bits"]
        settings = {
            "PERFORMANCE_HINT": "LATENCY", "NUM_STREAMS": 1, "INFERENCE_NUM_THREADS": threads,
            "INFERENCE_PRECISION_HINT": bits,
        }
        core = openvino.Core()
        if bits == "bf16" and "BF16" not in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES"):
            raise RuntimeError("this processor has no bf16")
        width, height = (-(-side // STRIDE) * STRIDE for side in (width, height))
        model = core.read_model(asked["pyramid"])
        model.reshape({"image": [1, 3, height, width]})
        pyramid = core.compile_model(model, "CPU", settings)
        # A port may have several names.
        shapes = {name: list(port.shape) for port in pyramid.outputs for name in port.get_names()}
        model = core.read_model(asked["decoder"])
        names = [port.get_any_name() for port in model.inputs]
        model.reshape({name: [2] if name == "scale" else shapes[name.split("_", 1)[1]] for name in names})
        decoder = core.compile_model(model, "CPU", settings)
        self.pyramids = [pyramid.create_infer_request() for _ in range(2)]
        # The newer frame of a step is the older one of the next, so two decoders are wired, each for one of the turns.
        self.decoders = [decoder.create_infer_request() for _ in range(2)]
        for newer, request in enumerate(self.decoders):
            request.get_tensor("scale").data[:] = 4.0
            for name in names:
                if name != "scale":
                    frame, feature = name.split("_", 1)
                    place = newer if frame == "newer" else 1 - newer
                    request.set_tensor(name, self.pyramids[place].get_tensor(feature))
        self.frames = [picture(width, height, number) for number in range(FRAMES)]
        self.number = 0
        self.look(0)

    def look(self, place):
        """Features of the frame whose turn it is."""
        self.pyramids[place].get_tensor("image").data[0] = self.frames[self.number % FRAMES]
        self.pyramids[place].infer()

    def step(self):
        """Features of a new frame, and the flow to it."""
        self.number += 1
        self.look(self.number % 2)
        self.decoders[self.number % 2].infer()


class Classic:
    """OpenCV's DIS (preset medium) or Farnebäck."""

    def __init__(self, width, height, threads, asked):
        import cv2

        cv2.setNumThreads(threads)
        self.frames = [(255 * picture(width, height, number)[0]).astype("u1") for number in range(FRAMES)]
        self.number = 0
        if asked["kind"] == "dis":
            dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
            self.between = lambda older, newer: dis.calc(older, newer, None)
        else:
            window = cv2.OPTFLOW_FARNEBACK_GAUSSIAN
            self.between = lambda older, newer: cv2.calcOpticalFlowFarneback(
                older, newer, None, 0.5, 5, 15, 3, 7, 1.5, window
            )

    def step(self):
        """The flow to a new frame."""
        self.number += 1
        self.between(self.frames[(self.number - 1) % FRAMES], self.frames[self.number % FRAMES])


KINDS = {"openvino": OpenVino, "dis": Classic, "farneback": Classic}


def answered(asked, opened, width, height, threads):
    """What is to be said to a line."""
    if "need" in asked:
        try:
            # Its version comes with numpy or not at all.
            importlib.import_module("numpy")
            return {"version": importlib.import_module(asked["need"]).__version__}
        except ImportError as error:
            return {"missing": PACKAGES[asked["need"]], "why": str(error)}
    if "open" in asked:
        opened[asked["open"]] = KINDS[asked["kind"]](width, height, threads, asked)
        return {"opened": asked["open"]}
    entrant = opened[asked["step"]]
    start = time.perf_counter()
    entrant.step()
    return {"ms": 1e3 * (time.perf_counter() - start)}


def main():
    """Answers until nothing more is asked."""
    width, height, threads = (int(word) for word in sys.argv[1:4])
    # What libraries print must not get between the answers.
    answers = os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8")
    os.dup2(2, 1)
    opened = {}
    for line in sys.stdin:
        try:
            answer = answered(json.loads(line), opened, width, height, threads)
        except Exception as error:  # whatever a rival fails with, the others go on
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers)


if __name__ == "__main__":
    main()
