"""Prints, for every line of a requirements file, whether that very version is installed."""

import sys
from importlib.metadata import PackageNotFoundError, version

for line in open(sys.argv[1]):
    name, _, wanted = line.strip().partition("==")
    if not wanted:
        continue
    try:
        found = version(name)
    except PackageNotFoundError:
        found = "nothing"
    print("ok" if found == wanted else "wrong", name, wanted, found)
