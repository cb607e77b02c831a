"""Reading a hostile file ends with one line that names it, within bounds of memory and time.

tests/io/test_atomic.py checks that nothing is half-written.
"""

import os
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))

from attacks import ATTACKS
from readers import FORMATS
from watch import outcome


def write_huge(file):
    with file.open("wb") as stream:
        stream.truncate(1 << 40)  # takes no space


NONSENSE = {
    "empty": b"",
    "zeros": bytes(4096),
    "a web page": b"<!DOCTYPE html><html><body>404 Not Found</body></html>\n",
}
PLACES = {
    "missing": lambda file: None,
    "a folder": lambda file: file.mkdir(),
    "a pipe": os.mkfifo,
    "a link to an endless device": lambda file: file.symlink_to("/dev/zero"),
    "a link to itself": lambda file: file.symlink_to(file),
    "a terabyte": write_huge,
}
MAY_BE_MISSING = {
    *("log", "missing photos", "scene arrays", "preprocessed scene", "skipped subject", "start"),
    *("splat", "manifest", "EasyMocap", "Human3R", "LHM", "TRAM", "cameras with lenses"),
}
"""Readers whose file may be missing, or may be one of several; zeros are Gaussians of a `.splat`.
"""
HEAVY = (
    *("million", "300,000 frames", "flipped bit", "900 folders", "5,000 photos", "white photos"),
    *("4,000 times", "100 MB"),
)
"""Words in the names of attacks that take more than 0.4 s of the processor."""
QUICK = [each for each in ATTACKS if not any(word in each.name for word in HEAVY)]


def test_every_row_of_the_table_has_its_own_name():
    names = [each.name for each in ATTACKS]
    assert len(names) == len(set(names))


@pytest.mark.parametrize("reader", FORMATS)
def test_a_valid_file_is_read_and_nonsense_in_its_place_is_refused(reader, tmp_path):
    form = FORMATS[reader]
    damages = {
        kind: lambda file, data=data: file.write_bytes(data) for kind, data in NONSENSE.items()
    }
    for kind, damage in ({"valid": None} | damages | PLACES).items():
        folder = tmp_path / kind.replace(" ", "_")
        folder.mkdir()
        path = form.make(folder)
        if damage is not None:
            form.damaged(path).unlink()
            damage(form.damaged(path))
        found = outcome(form.read, path, folder)
        assert damage is None or found == "refused" or reader in MAY_BE_MISSING, kind
        assert damage is not None or found == "read"


# Pillow warns of damaged tags, which count as none
@pytest.mark.filterwarnings("ignore::UserWarning:PIL.TiffImagePlugin")
@pytest.mark.parametrize(
    "attack",
    [
        pytest.param(each, id=each.name, marks=[] if each in QUICK else pytest.mark.slow)
        for each in ATTACKS
    ],
)
def test_an_attack_ends_in_one_line(attack, tmp_path):
    found = outcome(FORMATS[attack.reader].read, attack.make(tmp_path), tmp_path)
    assert attack.expect in (found, "either")
