"""`experiments/splatting/benchmark.py` with the same arguments, under its name of version 0.1."""

import runpy
from pathlib import Path

if __name__ == "__main__":
    runpy.run_path(str(Path(__file__).parent / "splatting/benchmark.py"), run_name="__main__")
