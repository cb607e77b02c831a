"""Which layout a folder has, and its people, ready to be trained on or to be looked at."""

import functools
from collections.abc import Callable
from pathlib import Path

from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.datasets.actorshq import find_actorshq, open_actorshq
from humangs_jax.data.datasets.avatarrex import find_avatarrex, open_avatarrex
from humangs_jax.data.datasets.bodies import FileBody
from humangs_jax.data.datasets.dna_rendering import find_dna_rendering, open_dna_rendering
from humangs_jax.data.datasets.scene_list import is_scene_list, open_scene_list
from humangs_jax.data.datasets.subject import STORED_SIZE, Person, Subject
from humangs_jax.data.datasets.thuman4 import find_thuman4, open_thuman4

VIDEOS: dict[str, tuple[Callable[[Path], tuple[Path, ...]], Callable[[Path, FileBody], Subject]]] = {
    "thuman4": (find_thuman4, open_thuman4),
    "avatarrex": (find_avatarrex, open_avatarrex),
    "actorshq": (find_actorshq, open_actorshq),
    "dna-rendering": (find_dna_rendering, open_dna_rendering),
}
"""Layout -> (its subjects in a folder, how one is opened)."""


def open_people(path: str | Path, body: FileBody, size: int | None = None) -> tuple[Person, ...]:
    """The people of a data set of any layout that has photos; each is opened when it is asked for.

    Arguments: size: pixels a side of the stored squares; None: that of the images of a scene list, else `STORED_SIZE`.
    Raises: CaptureError if the folder has none of the layouts.
    """
    path = Path(path)
    if is_scene_list(path):
        return open_scene_list(path, body, size)
    for find, open_one in VIDEOS.values():
        if folders := find(path):
            opened = lambda folder, open_one=open_one: functools.partial(open_one, folder, body)
            return tuple(Person(str(folder), opened(folder), size or STORED_SIZE) for folder in folders)
    if (path / "model").is_dir() and (path / "smplx").is_dir():
        raise CaptureError(path, "", "scans have no photos: make some with `humangs preprocess thuman`")
    raise CaptureError(path, "", f"no captures, scene list or data set of {', '.join(VIDEOS)} (docs/datasets.md)")
