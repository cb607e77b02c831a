"""Sets written by `humangs synth`: a folder of captures with a manifest that tells whose people they are."""

from pathlib import Path

from humangs_jax.data.loading.captures import find_captures
from humangs_jax.people.manifest import MANIFEST, read_manifest
from humangs_jax.people.seeds import split_of


def find_people(root: str | Path, split: str | None = "train") -> tuple[Path, ...]:
    """The capture folders in `root`, sorted by name; where a manifest says that they are synthetic, only of one split.

    Folders without a manifest (real captures) are taken as they are. split None: any.
    Raises: ValueError if a written set holds a subject of another split, or there is no capture.
    """
    root = Path(root)
    folders = find_captures(root)
    if split is not None and (root / MANIFEST).is_file():
        read_manifest(root)
        for folder in folders:
            if folder.name.isdigit() and split_of(int(folder.name)) != split:
                other = split_of(int(folder.name))
                raise ValueError(f"{folder}: a subject of the split '{other}', where '{split}' was expected")
    return folders
