"""An autopilot's end of a MAVLink line, by pymavlink: mavlink_read.py udp|serial

Prints where it listens ("at PLACE"), then each message as one line of JSON with its name, sender, length and time of
arrival; what is not a number is null. "timesync" on standard input asks the sender for its clock.
"""

import json
import math
import os
import select
import socket
import sys
import time
import tty

os.environ["MAVLINK20"] = "1"
from pymavlink.dialects.v20 import common  # noqa: E402


class Udp:
    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.place = "127.0.0.1:%d" % self.socket.getsockname()[1]
        self.peer = None

    def fileno(self):
        return self.socket.fileno()

    def read(self):
        data, self.peer = self.socket.recvfrom(2048)
        return data

    def write(self, data):
        self.socket.sendto(data, self.peer)


class Serial:
    """A pseudo-terminal; a bare one, so that no byte is taken for a command."""

    def __init__(self):
        self.ours, self.theirs = os.openpty()
        tty.setraw(self.theirs)
        self.place = os.ttyname(self.theirs)

    def fileno(self):
        return self.ours

    def read(self):
        return os.read(self.ours, 4096)

    def write(self, data):
        os.write(self.ours, data)


def plain(value):
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


line = {"udp": Udp, "serial": Serial}[sys.argv[1]]()
# The autopilot is component 1 of the same system.
mavlink = common.MAVLink(line, srcSystem=1, srcComponent=1)
mavlink.robust_parsing = True
print(f"at {line.place}", flush=True)
while True:
    ready, _, _ = select.select([line, sys.stdin], [], [])
    if line in ready:
        arrived = time.monotonic()
        for message in mavlink.parse_buffer(line.read()) or []:
            told = {name: plain(getattr(message, name)) for name in message.get_fieldnames()}
            header = message.get_header()
            told |= {
                "name": message.get_type(),
                "from": [header.srcSystem, header.srcComponent],
                "version": 2 if message.get_msgbuf()[0] == 0xFD else 1,
                "arrived": arrived,
                "bytes": len(message.get_msgbuf()),
            }
            print(json.dumps(told, allow_nan=False), flush=True)
    if sys.stdin in ready:
        asked = sys.stdin.readline()
        if not asked:
            break
        mavlink.timesync_send(0, time.monotonic_ns())
