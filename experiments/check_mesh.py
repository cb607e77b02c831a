"""`experiments/paper/check_mesh.py` with the same arguments, under its name of version 0.1."""

import runpy
from pathlib import Path

if __name__ == "__main__":
    runpy.run_path(str(Path(__file__).parent / "paper/check_mesh.py"), run_name="__main__")
