"""Sets written by `humangs synth`: the manifest with the settings and the finished subjects, and how a set is found.

{"format": "humangs-synthetic", "version": 2, "generator_version": ..., "split": ..., "settings": {...}, "subjects": [...]}
"""

from pathlib import Path
from typing import Any

from humangs_jax.data.loading.captures import find_captures
from humangs_jax.io.text import read_json, write_json
from humangs_jax.people.seeds import GENERATOR_VERSION, split_of

MANIFEST = "manifest.json"
FORMAT, VERSION = "humangs-synthetic", 2


def read_manifest(folder: str | Path) -> dict[str, Any]:
    """What a set was made with. Raises: ValueError, one line naming the file, if it is no manifest of this format."""
    file = Path(folder) / MANIFEST
    content = read_json(file)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"{file}: format: expected a manifest of {FORMAT!r}")
    if content.get("version") not in (1, VERSION):
        raise ValueError(f"{file}: version: expected {VERSION}, got {content.get('version')!r}")
    return {"generator_version": 1, "split": None} | content


def begin_set(folder: str | Path, split: str, settings: dict[str, Any]) -> None:
    """Start a set in a folder, or check that the one that is there can be continued.

    Raises: ValueError if it was made by another version of the generator, of another split, or with other settings.
    """
    folder = Path(folder)
    if not (folder / MANIFEST).is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_manifest(folder, split, settings)
        return
    earlier, file = read_manifest(folder), folder / MANIFEST
    pairs = {name: (earlier["settings"].get(name), settings.get(name)) for name in {**settings, **earlier["settings"]}}
    changed = [f"{name} {old} -> {new}" for name, (old, new) in sorted(pairs.items()) if old != new]
    version, problem = earlier["generator_version"], ""
    if version != GENERATOR_VERSION:
        problem = f"written by version {version} of the generator, this is version {GENERATOR_VERSION}"
    elif earlier["split"] != split:
        problem = f"people of the split '{earlier['split']}', now asked for '{split}'"
    elif changed:
        problem = f"written with settings other than asked for now ({', '.join(changed)})"
    if problem:
        raise ValueError(f"{file}: {problem}: choose another folder")


def write_manifest(folder: str | Path, split: str, settings: dict[str, Any]) -> None:
    """List the finished subjects; written aside, then renamed, so that it is never half there."""
    folder = Path(folder)
    content = {
        "format": FORMAT,
        "version": VERSION,
        "generator_version": GENERATOR_VERSION,
        "split": split,
        "settings": settings,
        "subjects": sorted(file.parent.name for file in folder.glob("[0-9]*/capture.json")),
    }
    write_json(folder / MANIFEST, content)


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
