"""Runs the example that users are pointed to, as it stands: `iox_read.py PREFIX STEPS`."""

import runpy
from pathlib import Path

example = Path(__file__).parents[2] / "examples" / "python" / "read_flow.py"
runpy.run_path(str(example), run_name="__main__")
