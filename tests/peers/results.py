"""What tests/it/results.rs sends, and so what must arrive: step n is fine for n % 3 == 0, degraded and without a distance for
1, blind for 2. Works on the messages of CycloneDDS and of rosbags alike."""

import math
import struct

ENOUGH = 3
STEP_NS = 20_000_000
# The network's own size: flow of 655 kB, which DDS has to take apart.
WIDTH, HEIGHT = 320, 256
IMAGE_NS_MIN = 500_000_000


def ns(stamp):
    return stamp.sec * 10**9 + stamp.nanosec


def close(a, b):
    return math.isclose(a, b, rel_tol=1e-6)


def hues():
    """The Middlebury benchmark's colorcode.cpp."""
    table = []
    for count, start, moving, rising in [(15, (255, 0, 0), 1, 1), (6, (255, 255, 0), 0, 0), (4, (0, 255, 0), 2, 1),
                                         (11, (0, 255, 255), 1, 0), (13, (0, 0, 255), 0, 1), (6, (255, 0, 255), 2, 0)]:
        for i in range(count):
            colour = list(start)
            colour[moving] = 255 * i // count if rising else 255 - 255 * i // count
            table.append(colour)
    return table


def wheel(u, v, longest, table=hues()):
    u, v = u / longest, v / longest
    radius = math.hypot(u, v)
    place = (math.atan2(-v, -u) / math.pi + 1) / 2 * (len(table) - 1)
    low, part = int(place), place % 1
    full = [((1 - part) * a + part * b) / 255 for a, b in zip(table[low], table[(low + 1) % len(table)])]
    return [int(255 * (1 - radius * (1 - c) if radius <= 1 else c * 0.75)) for c in full]


class Results:
    def __init__(self, namespace):
        self.counts = {}
        self.last_image = {}
        images = ["flow", "flow_confidence", "flow_preview"]
        self.kinds = {
            f"{namespace}/velocity": "geometry_msgs/msg/TwistWithCovarianceStamped",
            f"{namespace}/ego_motion": "nightflow_msgs/msg/EgoMotion",
            f"{namespace}/proximity": "sensor_msgs/msg/LaserScan",
            f"{namespace}/step": "nightflow_msgs/msg/Step",
            f"{namespace}/status": "nightflow_msgs/msg/Status",
            "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
            **{f"{namespace}/{name}": "sensor_msgs/msg/Image" for name in images},
        }
        self.states = set()

    def missing(self):
        return {topic: self.counts.get(topic, 0) for topic in self.kinds if self.counts.get(topic, 0) < ENOUGH}

    def done(self):
        return not self.missing() and self.states == {0, 1, 2}

    def check(self, topic, message):
        self.counts[topic] = self.counts.get(topic, 0) + 1
        getattr(self, topic.rsplit("/", 1)[1])(message)

    def step_of(self, message, frame):
        """The step that the message belongs to, from its stamp alone."""
        assert message.header.frame_id == frame, message.header
        step, rest = divmod(ns(message.header.stamp) - 10**9, STEP_NS)
        assert rest == 0 and step >= 1, message.header
        return step - 1

    def velocity(self, message):
        assert self.step_of(message, "base_link") % 3 == 0, "a velocity although there was none to be trusted"
        self.motion(message.twist)

    def motion(self, twist):
        linear, angular = twist.twist.linear, twist.twist.angular
        assert (linear.x, linear.y, linear.z) == (1.5, -0.25, 0.125), linear
        assert (angular.x, angular.y, angular.z) == (0.01, 0.02, -0.03), angular
        assert [float(c) for c in twist.covariance] == [float(i) for i in range(36)], twist.covariance

    def ego_motion(self, message):
        step = self.step_of(message, "base_link")
        assert step % 3 in (0, 1), "a motion although the step was blind"
        assert ns(message.older_stamp) == ns(message.header.stamp) - STEP_NS
        assert message.scale == step % 3
        assert message.distance == 12.5 if message.scale == 0 else math.isnan(message.distance), message
        assert (message.samples, message.inliers, message.quality) == (500, 400, 200), message
        self.motion(message.twist)

    def proximity(self, message):
        step = self.step_of(message, "base_link")
        increment = 2 * math.pi / 72
        assert close(message.angle_min, -math.pi) and close(message.angle_increment, increment), message
        assert close(message.angle_max, math.pi - increment) and close(message.scan_time, 0.02), message
        ranges, intensities = list(message.ranges), list(message.intensities)
        assert len(ranges) == len(intensities) == 72, message
        if step % 3 != 0:
            assert all(math.isnan(value) for value in ranges) and not any(intensities), "what is unknown isn't free"
            return
        assert message.range_max == 24, message
        assert (ranges[35], ranges[36], intensities[35], intensities[36]) == (math.inf, 6, 0.75, 0.875), message
        assert all(math.isnan(value) for k, value in enumerate(ranges) if k not in (35, 36)), message

    def step(self, message):
        step = self.step_of(message, "camera_optical")
        assert message.step == step and message.state == step % 3, message
        self.states.add(message.state)
        assert ns(message.older_stamp) == ns(message.header.stamp) - STEP_NS
        cause = ["", "the light changed by a factor of 2.50 between the frames",
                 "too dark: raw mean 0.00010 of white, at least 0.00100 is needed"]
        lacks = ["", "no range was received", "blind"]
        assert (message.cause, message.velocity_lacks) == (cause[step % 3], lacks[step % 3]), message
        assert (message.width, message.height, message.scale_x, message.scale_y) == (WIDTH, HEIGHT, 2.0, 4.0), message
        for value, expected in [(message.gain, 20), (message.raw_mean, 0.02), (message.saturated, 0.01)]:
            assert close(value, expected), message
        assert message.confidence == 0.75, message

    def status(self, message):
        assert (message.state, message.cause) == (1, "the lamp flickers"), message
        counters = (message.frames, message.displaced, message.steps, message.spoiled, message.unpaired, message.lost)
        assert counters == (2**40, 2, 3, 4, 5, 6), message
        assert message.last_error == "short by 3 bytes", message
        assert (message.rate, message.latency_ms, message.step_ms) == (30.5, 12.25, 8.0), message
        noise = (message.noise_a, message.noise_b, message.snr_db, message.noise_level)
        assert noise == (0.25, -0.125, 6.5, 12.0), message

    def diagnostics(self, message):
        [status] = message.status
        assert status.level in (1, b"\x01") and "nightflow" in status.name, status
        assert status.message == "degraded: the lamp flickers", status
        values = {value.key: value.value for value in status.values}
        assert (values["displaced"], values["rate"], values["last_error"]) == ("2", "30.50", "short by 3 bytes"), values

    def image(self, message, name, encoding, cell_bytes):
        self.step_of(message, "camera_optical")
        stamp = ns(message.header.stamp)
        assert stamp - self.last_image.get(name, 0) >= IMAGE_NS_MIN, "images come too often"
        self.last_image[name] = stamp
        assert (message.width, message.height, message.encoding) == (WIDTH, HEIGHT, encoding), message
        assert (message.step, message.is_bigendian) == (WIDTH * cell_bytes, 0), message
        data = bytes(message.data)
        assert len(data) == WIDTH * HEIGHT * cell_bytes
        return data

    def flow(self, message):
        data = self.image(message, "flow", "32FC2", 8)
        expected = [x for i in range(WIDTH * HEIGHT) for x in (i % WIDTH, -0.5 * (i // WIDTH))]
        assert list(struct.unpack(f"<{WIDTH * HEIGHT * 2}f", data)) == expected

    def flow_confidence(self, message):
        data = self.image(message, "confidence", "32FC1", 4)
        assert list(struct.unpack(f"<{WIDTH * HEIGHT}f", data)) == [i % 64 / 64 for i in range(WIDTH * HEIGHT)]

    def flow_preview(self, message):
        data = self.image(message, "preview", "rgb8", 3)
        longest = math.hypot(WIDTH - 1, 0.5 * (HEIGHT - 1))
        # The first row lies on the seam of the wheel, where the sign of zero decides.
        for i in range(WIDTH, WIDTH * HEIGHT, 97):
            expected = wheel(i % WIDTH, -0.5 * (i // WIDTH), longest)
            assert all(abs(a - b) <= 1 for a, b in zip(data[3 * i : 3 * i + 3], expected)), (i, expected)
