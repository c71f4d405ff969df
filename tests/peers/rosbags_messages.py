"""Reads our CDR with rosbags, and gives back what rosbags itself makes of the same values.

Standard input: one JSON object a line with the type's name, our schema, our CDR in hex and the value that it holds.
Standard output: for each one JSON object with rosbags' hash and its CDR in both byte orders.
"""

import json
import sys

import numpy
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

jazzy = get_typestore(Stores.ROS2_JAZZY)


def plain(value, store):
    """A deserialised message as JSON has it."""
    if isinstance(value, numpy.ndarray):
        return value.tolist()
    if isinstance(value, list):
        return [plain(element, store) for element in value]
    if hasattr(value, "__msgtype__"):
        # The dataclass holds constants too; the definition alone knows the fields.
        fields = store.fielddefs[value.__msgtype__][1]
        found = {name: plain(getattr(value, name), store) for name, _ in fields}
        # An octet has no sign, but rosbags shows it as an int8.
        octets = [name for name, kind in fields if kind[1] == ("byte", 0)]
        return found | {name: found[name] % 256 for name in octets}
    return value


for line in sys.stdin:
    case = json.loads(line)
    name = case["name"]
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(case["schema"], name))
    digest = store.hash_rihs01(name)
    if name in jazzy.fielddefs:
        assert digest == jazzy.hash_rihs01(name), f"{name}: the schema is not Jazzy's"

    message = store.deserialize_cdr(bytes.fromhex(case["cdr"]), name)
    found = plain(message, store)
    assert found == case["value"], f"{name}: expected {case['value']}, found {found}"
    answer = {"hash": digest}
    for order, little in ("little", True), ("big", False):
        answer[order] = bytes(store.serialize_cdr(message, name, little_endian=little)).hex()
    print(json.dumps(answer))
