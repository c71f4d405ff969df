"""Reads the flow of a running node out of shared memory with PyPI's iceoryx2 and NumPy, without a copy.

    pip install iceoryx2==0.10.0 numpy
    python examples/python/read_flow.py [prefix] [steps]
"""

import ctypes
import sys

import iceoryx2 as iox
import numpy


class FlowHeader(ctypes.Structure):
    """Field by field as `nightflow::publish::shared::FlowHeader`; stamps are nanoseconds since the epoch."""

    _fields_ = [
        ("older_ns", ctypes.c_int64),
        ("newer_ns", ctypes.c_int64),
        ("published_ns", ctypes.c_int64),
        ("step", ctypes.c_uint64),
        ("displaced", ctypes.c_uint64),
        ("lost", ctypes.c_uint64),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("camera_width", ctypes.c_uint32),
        ("camera_height", ctypes.c_uint32),
        ("scale_x", ctypes.c_float),
        ("scale_y", ctypes.c_float),
        ("state", ctypes.c_uint32),  # 0 ok, 1 degraded, 2 blind
        ("cause", ctypes.c_uint32),  # 0 none, 1 dark, 2 saturated, 3 gain step, 4 unsure, 5 frozen, 6 noisy
        ("gain", ctypes.c_float),
        ("raw_mean", ctypes.c_float),
        ("saturated", ctypes.c_float),
        ("confidence", ctypes.c_float),
    ]

    @staticmethod
    def type_name():
        return "nightflow::FlowHeader"


class VelocitySample(ctypes.Structure):
    """Field by field as `nightflow::publish::shared::VelocitySample`; without a velocity `valid` is 0, numbers NaN."""

    _fields_ = [
        ("older_ns", ctypes.c_int64),
        ("newer_ns", ctypes.c_int64),
        ("published_ns", ctypes.c_int64),
        ("step", ctypes.c_uint64),
        ("linear", ctypes.c_double * 3),  # body frame, FLU: m/s, or 1/s when scale is 1
        ("angular", ctypes.c_double * 3),  # rad/s
        ("covariance", ctypes.c_double * 36),
        ("distance", ctypes.c_double),
        ("valid", ctypes.c_uint32),
        ("scale", ctypes.c_uint32),
        ("state", ctypes.c_uint32),
        ("cause", ctypes.c_uint32),
        ("lack", ctypes.c_uint32),
        ("samples", ctypes.c_uint32),
        ("inliers", ctypes.c_uint32),
        ("quality", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name():
        return "nightflow::VelocitySample"


class ObstaclesSample(ctypes.Structure):
    """Field by field as `nightflow::publish::shared::ObstaclesSample`; where nothing is known `valid` is 0."""

    _fields_ = [
        ("older_ns", ctypes.c_int64),
        ("newer_ns", ctypes.c_int64),
        ("published_ns", ctypes.c_int64),
        ("step", ctypes.c_uint64),
        ("heading", ctypes.c_double * 3),  # level body frame, unit length
        ("heading_sd", ctypes.c_double),
        ("speed", ctypes.c_double),  # m/s, NaN when not metric
        ("horizon_s", ctypes.c_double),
        ("delay_s", ctypes.c_double),
        ("valid", ctypes.c_uint32),
        ("state", ctypes.c_uint32),
        ("cause", ctypes.c_uint32),
        ("sight", ctypes.c_uint32),  # 0 seen, below 64 as lack, 64 not asked for, 65 bare, 66 no parallax
        ("ttc_s", ctypes.c_float * 72),  # sector k looks along -pi + k 2 pi / 72, counter-clockwise
        ("distance_m", ctypes.c_float * 72),
        ("confidence", ctypes.c_float * 72),
        ("sector", ctypes.c_uint8 * 72),  # 0 unknown, 1 free, 2 occupied
    ]

    @staticmethod
    def type_name():
        return "nightflow::ObstaclesSample"


def floats(sample):
    """The payload as a NumPy array over the shared memory itself; it holds until `sample.delete()`.

    The binding's `Slice.len()` counts bytes and its `as_memory_view()` reads past the end (0.10), so the length comes
    from the header and the address from `payload_ptr`.
    """
    length = sample.header.number_of_elements
    return numpy.ctypeslib.as_array((ctypes.c_float * length).from_address(sample.payload_ptr))


def open_floats(node, name):
    service = node.service_builder(iox.ServiceName.new(name))
    service = service.publish_subscribe(iox.Slice[ctypes.c_float]).user_header(FlowHeader).open()
    return service.subscriber_builder().create()


def open_plain(node, name, kind):
    service = node.service_builder(iox.ServiceName.new(name))
    return service.publish_subscribe(kind).open().subscriber_builder().create()


def main(prefix="nightflow", steps="0"):
    iox.set_log_level_from_env_or(iox.LogLevel.Error)
    node = iox.NodeBuilder.new().create(iox.ServiceType.Ipc)
    flow, confidence = open_floats(node, f"{prefix}/flow"), open_floats(node, f"{prefix}/confidence")
    velocity = open_plain(node, f"{prefix}/velocity", VelocitySample)
    obstacles = open_plain(node, f"{prefix}/obstacles", ObstaclesSample)
    wake = node.service_builder(iox.ServiceName.new(f"{prefix}/flow")).event().open().listener_builder().create()
    print("reading", flush=True)

    seen = 0
    while int(steps) == 0 or seen < int(steps):
        wake.timed_wait(iox.Duration.from_millis(1000))
        # The node sends a step's flow last, so whoever holds it finds the step's confidence and velocity there.
        while (sample := flow.receive()) is not None:
            header = sample.user_header().contents
            vectors = floats(sample).reshape(header.height, header.width, 2)
            u, v = vectors.reshape(-1, 2).mean(axis=0)
            corner = vectors[-1, -1]
            print(f"flow {header.step} {header.width}x{header.height} state {header.state} mean {u:.4f} {v:.4f}",
                  f"corner {corner[0]:.4f} {corner[1]:.4f} sum {vectors.sum(dtype=numpy.float64):.4f}", flush=True)
            step = header.step
            sample.delete()
            show_confidence(confidence, step)
            show_velocity(velocity, step)
            show_obstacles(obstacles, step)
            seen += 1


def show_confidence(confidence, step):
    while (sample := confidence.receive()) is not None:
        header, sure = sample.user_header().contents, floats(sample)
        if header.step == step:
            print(f"confidence {step} {len(sure)} cells mean {sure.mean():.4f}", flush=True)
        reached = header.step >= step
        sample.delete()
        if reached:
            return


def show_velocity(velocity, step):
    while (sample := velocity.receive()) is not None:
        found = sample.payload().contents
        if found.step == step:
            # No velocity is not standing still: nothing is known.
            numbers = " ".join(f"{x:.4f}" for x in found.linear) if found.valid else "none"
            print(f"velocity {step} {numbers} covariance {found.covariance[35]:.4f} quality {found.quality}", flush=True)
        reached = found.step >= step
        sample.delete()
        if reached:
            return


def show_obstacles(obstacles, step):
    while (sample := obstacles.receive()) is not None:
        found = sample.payload().contents
        if found.step == step:
            kinds = list(found.sector)
            occupied = [k for k, kind in enumerate(kinds) if kind == 2]
            # Unknown is not free: a planner keeps out of both unknown and occupied sectors.
            if not found.valid:
                said = "unknown"
            elif occupied:
                k = min(occupied, key=lambda k: found.ttc_s[k])
                said = f"nearest sector {k} in {found.ttc_s[k]:.4f} s at {found.distance_m[k]:.4f} m,"
                said += f" {kinds.count(1)} free, {kinds.count(0)} unknown"
            else:
                said = f"nothing near, {kinds.count(1)} free, {kinds.count(0)} unknown"
            print(f"obstacles {step} {said}", flush=True)
        reached = found.step >= step
        sample.delete()
        if reached:
            return


if __name__ == "__main__":
    main(*sys.argv[1:])
