"""Keeps the scores of finished people in a folder, so that an interrupted evaluation can be
continued.

    folder/manifest.json           what the evaluation is made with, see `data.sets`
    folder/person_NAME_KEY.json    the scores of one person; KEY: a checksum of all that they
                                   depend on

The key of a person depends on names and on contents: photos, masks, cameras, poses and body, and
the weights, avatar or images that are compared. Scores of other contents are not reused. See
`method_key` for what is known of a function.
"""

import inspect
import json
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from humangs_jax import __version__
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import BodyModel
from humangs_jax.data.capture import Capture
from humangs_jax.data.sets import SCORES, SETTINGS, begin_set
from humangs_jax.evaluation.cases import Case, Method, prediction_files, shipped_weights
from humangs_jax.io.arrays import SHORT, checksum, file_checksum
from humangs_jax.io.reading import read_json, write_json

LONGEST_NAME = 40
"""Largest number of characters of a person's name in a file name. The name is for readers; the key
tells people apart.
"""

CaseKey = Callable[[Case], str]
"""A function that takes a case, and returns a key of the files from which only this case is
predicted: an avatar or images. The key is "" if there are no such files.
"""


class KeptScores:
    """Keeps the scores of an evaluation in a folder.

    method: returns a key for each case, see `CaseKey`. ordered: whether the results of a person
    also depend on the people before. They do if a page with the worst images is made.
    Raises: CaptureError if the folder has scores that were made with other settings.
    """

    def __init__(
        self, folder: Path, settings: Mapping[str, Any], method: CaseKey, ordered: bool
    ) -> None:
        begin_set(folder, SCORES, {SETTINGS: {"version": __version__, **settings}})
        self._folder, self._method, self._ordered = folder, method, ordered
        self._before = checksum({}, repr(sorted(settings.items())))

    def __call__(
        self, case: Case, score: Callable[[], dict[str, Any]]
    ) -> tuple[dict[str, Any], bool]:
        """Returns the results of a person, and whether they were read from the folder. If the
        folder does not have them, `score` computes them, and they are kept.

        Raises: FileError for a damaged file in the folder; OSError; anything that `score` raises.
        """
        key = checksum({}, self._before, case_key(case), self._method(case))
        if self._ordered:
            self._before = key
        name = re.sub(r"[^\w.-]+", "-", case.name)[:LONGEST_NAME]
        file = self._folder / f"person_{name}_{key[:SHORT]}.json"
        if file.is_file():
            return read_json(file), True
        person = score()
        file.parent.mkdir(exist_ok=True)  # gone, where the same call in another process has ended
        write_json(file, person)
        return person, False


def _tree_key(tree: Any) -> str:
    """Returns a checksum of the arrays of a pytree and of its structure."""
    leaves, structure = jax.tree.flatten(tree)
    return checksum({str(i): np.asarray(leaf) for i, leaf in enumerate(leaves)}, str(structure))


def _file_key(file: Path) -> str:
    """Returns a checksum of the bytes of a file; "none" if there is no such file."""
    if file.is_file():
        return file_checksum(file)
    return "none"


def case_key(case: Case) -> str:
    """Returns a checksum of the name of a case and of its captures, with all fields that a
    reconstruction or a score depends on: all but `body_file`.
    """
    inputs = "none"
    if case.inputs is not None:
        inputs = _capture_key(case.inputs)
    return checksum({}, case.name, _capture_key(case.truth), inputs)


def _capture_key(capture: Capture) -> str:
    arrays = {
        "images": capture.images,
        "masks": capture.masks,
        "frames": capture.frames,
        "betas": capture.betas,
    }
    optional = {name: getattr(capture, name) for name in ("displacement", "unknown", "gains")}
    known = {
        name: np.asarray(array)
        for name, array in {**arrays, **optional}.items()
        if array is not None
    }
    placed = _tree_key((capture.cameras, capture.poses))
    others = repr((capture.names, capture.calibrated))
    return checksum(known, placed, _tree_key(capture.body), others)


def indices_key(indices: Mapping[str, Any] | None) -> str | None:
    """Returns a short checksum of the choice of inputs and targets; None if nothing was chosen."""
    if indices is None:
        return None
    plain = {
        name: {key: [int(view) for view in views] for key, views in each.items()}
        for name, each in indices.items()
    }
    return checksum({}, json.dumps(plain, sort_keys=True))[:SHORT]


def body_key(body: BodyModel | str | Path | None) -> str | None:
    """Returns a short checksum of a body model or of its file; None if no body is given."""
    if body is None:
        return None
    if isinstance(body, BodyModel):
        return _tree_key(body)[:SHORT]
    return _file_key(Path(body))[:SHORT]


def networks_key(networks: Mapping[str, Any]) -> list[str]:
    """Returns the names and short checksums of loss networks, sorted by name."""
    return [f"{name} {_tree_key(network)[:SHORT]}" for name, network in sorted(networks.items())]


def method_key(
    people: int,
    avatar: str | Path | Avatar | None,
    weights: Any,
    predictions: str | Path | None,
    method: Method | None,
) -> tuple[str, CaseKey]:
    """Returns two keys of the method that `choose_method` would return. The first is a short text
    that changes with what the predictions of all people depend on, such as weights. The second is a
    `CaseKey`, for what the prediction of one case depends on, such as images.

    A `method` is known by its name and source alone, not by the values of variables that it reads.
    """
    nothing: CaseKey = lambda case: ""
    if method is not None:
        return _source_key(method)[:SHORT], nothing
    if predictions is not None:
        root = Path(predictions)
        return "images", lambda case: _files_key(
            file for file in prediction_files(root, case, people).values() if file
        )
    if isinstance(avatar, Avatar):
        return _tree_key(avatar)[:SHORT], nothing
    if avatar is not None:
        place = Path(avatar)
        if place.is_dir():
            return "avatars", lambda case: _file_key(place / f"{case.name}.npz")
        return _file_key(place)[:SHORT], nothing
    if isinstance(weights, str | Path):
        return _file_key(Path(weights))[:SHORT], nothing
    if weights is None:
        variables, config = shipped_weights()
    else:
        variables, config = weights
    return checksum({}, _tree_key(variables), repr(config))[:SHORT], nothing


def _files_key(files: Iterable[Path]) -> str:
    return checksum({}, *(f"{file.name} {_file_key(file)}" for file in files))


def _source_key(method: Method) -> str:
    qualified = getattr(method, "__qualname__", type(method).__qualname__)
    name = f"{getattr(method, '__module__', '')}.{qualified}"
    try:
        source = inspect.getsource(method)
    except (OSError, TypeError):  # written in a prompt, or an object that is called
        source = ""
    return checksum({}, name, source)
