"""Prints, for every line of a requirements file, whether that very version is installed."""

import platform
import sys
from importlib.metadata import PackageNotFoundError, version

for line in open(sys.argv[1]):
    requirement, _, only = line.strip().partition(";")
    name, _, wanted = requirement.strip().partition("==")
    if not wanted:
        continue
    # The one condition in use: a package that PyPI has for one kind of machine only.
    if only.strip() and only.strip() != f'platform_machine == "{platform.machine()}"':
        print("ok", name, "is for other machines")
        continue
    try:
        found = version(name)
    except PackageNotFoundError:
        found = "nothing"
    print("ok" if found == wanted else "wrong", name, wanted, found)
