"""Reads Nightflow's results with eclipse-zenoh and rosbags: zenoh_results.py ENDPOINT STYLE DOMAIN NAMESPACE MSGS

STYLE is plain or rmw; MSGS is the folder of nightflow_msgs. Prints "listening", then "done" when enough of each topic came
and all of it was right: key, type hash, attachment, tokens and every field.
"""

import pathlib
import struct
import sys
import time

import xxhash
from results import Results
from zenoh_session import dds_type, open_session, typestore

endpoint, style, domain, namespace, msgs = sys.argv[1:6]
store = typestore(pathlib.Path(msgs))
session = open_session("connect", endpoint)
results = Results(namespace)
arrived = []
subscribers = []
keys = {}
for topic, kind in results.kinds.items():
    key = topic.lstrip("/")
    if style == "rmw":
        key = f"{domain}/{key}/{dds_type(kind)}/{store.hash_rihs01(kind)}"
    keys[key] = topic
    subscribers.append(session.declare_subscriber(key, arrived.append))
print("listening", flush=True)


class Attachments:
    """Sequences count up (a congested link may drop some); the publisher is the hash of its token."""

    def __init__(self):
        self.last = {}
        self.gids = {}

    def check(self, topic, attachment):
        if style == "plain":
            assert attachment is None, attachment
            return
        bytes_ = attachment.to_bytes()
        assert len(bytes_) == 33 and bytes_[16] == 16, bytes_
        sequence, source_ns = struct.unpack("<qq", bytes_[:16])
        assert abs(time.time_ns() - source_ns) < 60e9, source_ns
        assert sequence > self.last.get(topic, 0), (topic, sequence, self.last)
        self.last[topic] = sequence
        self.gids[topic] = bytes_[17:]


attachments = Attachments()


def read():
    until = time.monotonic() + 60
    while not results.done():
        if time.monotonic() > until:
            raise SystemExit(f"not within 60 s: {results.missing()}")
        while arrived:
            sample = arrived.pop(0)
            topic = keys[str(sample.key_expr)]
            attachments.check(topic, sample.attachment)
            payload = sample.payload.to_bytes()
            assert payload[:4] == b"\x00\x01\x00\x00", payload[:4]
            results.check(topic, store.deserialize_cdr(payload, results.kinds[topic]))
        time.sleep(0.005)

    tokens = [str(reply.ok.key_expr) for reply in session.liveliness().get(f"@ros2_lv/{domain}/**", timeout=5)]
    if style == "plain":
        assert not tokens, tokens
    else:
        nodes = [token for token in tokens if token.split("/")[5] == "NN"]
        assert len(nodes) == 1 and nodes[0].endswith("/NN/%/%/nightflow"), nodes
        for topic, kind in results.kinds.items():
            end = f"/MP/%/%/nightflow/{topic.replace('/', '%')}/{dds_type(kind)}/{store.hash_rihs01(kind)}/::,10:,:,:,,"
            [token] = [token for token in tokens if token.endswith(end)]
            digest = xxhash.xxh3_128_intdigest(token.encode())
            assert attachments.gids[topic] == digest.to_bytes(16, "little"), (topic, token)
        assert len(tokens) == 1 + len(results.kinds), tokens


try:
    read()
finally:
    # Also after a failure: an open session would keep the script alive.
    session.close()
print("done", flush=True)
