"""Prints every message type of ROS 2 Jazzy, as rosbags knows it: name, schema, hash; one JSON object a line."""

import json

from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)
for name in sorted(store.fielddefs):
    print(json.dumps({"name": name, "schema": store.generate_msgdef(name, 2)[0], "hash": store.hash_rihs01(name)}))
