"""Finds the people in a file or folder of a motion, and the arrays of each person by name.

Estimators store people in different ways: in dicts by number, in a list for each frame, along the
first axis of arrays, in a file for each person, or in a file for each frame. Some store the poses
of a person in several coordinate systems. Poses in the world's axes are preferred.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.data.formats import MOTIONS, ArrayKeys
from humangs_jax.io.arrays import ArrayFile, read_npy
from humangs_jax.io.reading import InvalidFileError, check_limit, open_file, read_json, visible
from humangs_jax.io.restricted_pickle import as_array, objects
from humangs_jax.io.tensors import read_values
from humangs_jax.motion import MotionError
from humangs_jax.motion.rules import ORTHONORMAL
from humangs_jax.motion.vectors import hint_for, values_of

_INSIDE = (
    "smpl_params_global",
    "smplx_world",
    "smpl_params_incam",
    "smplx_cam",
    "pred_smpl_params",
    "smpl_params",
    "smpl",
)
"""Keys that may hold the values of a person, the best first."""
_LISTS = ("people", "persons", "annots", "results")
"""Keys that may hold all people."""
_IDS = ("id", "smpl_id", "track_id", "personID", "person_id")
"""Keys that may hold the number of a person."""
_FRAMES = ("frame_ids", "frames", "frame", "frame_id")
"""Keys that may hold the frames in which a person was seen."""
_FOLDERS = ("", "smpl", "smplx", "smplfull", "hps", "results")
"""Sub-folders that may hold the files of a motion; "" is the folder itself."""
_OF_ONE = (".npy", ".smpl", ".pkl", ".pickle", ".pt", ".pth")
"""In a folder, each file with one of these suffixes has whole motions, usually that of one person.
Each file with another suffix has one frame.
"""
_DEEPEST = 6
"""Largest number of levels of lists and maps above the values of a person."""
SHOWN = 12
"""Largest number of keys or people that an error lists."""


class Person(NamedTuple):
    """A person in a file."""

    name: str
    """Name of the person. If each person has a file, it is the number in the file's name. Otherwise
    it is the name in the file, an index, or "".
    """
    values: Mapping[str, Any]
    """The values of the person, by the file's keys."""
    frames: np.ndarray | None = None
    """Numbers of the frames in which the person was seen. None if the file does not state them."""
    pickled: tuple[str, ...] = ()
    """Keys whose values are not read because they are pickled."""


def format_of(values: Mapping[Any, Any]) -> ArrayKeys | None:
    """Returns the first format whose keys are all among the values; None if there is none."""
    rows = (each.arrays for each in MOTIONS.values() if each.arrays is not None)
    return next((row for row in rows if all(key in values for key in row.keys)), None)


def read_people(path: Path) -> list[Person]:
    """Reads the people of a file or a folder.

    Raises: InvalidFileError if nothing in it has a known format, if there are too many files or
    people, or if a person lacks values in some frames. FileError or OSError if a file cannot be
    read.
    """
    files = _files(path) if path.is_dir() else [path]
    alone = not path.is_dir() and path.suffix.lower() != ".json"
    check_limit("frames", len(files), "files")
    if not alone and files[0].suffix.lower() not in _OF_ONE:
        people = _stacked(_frames(files))
    else:
        people = []
        for file in files:
            content, pickled = _content(file)
            found = _people(content, pickled)
            if alone and not found:
                values = content if isinstance(content, dict) else {}
                raise InvalidFileError(expected(values, pickled))
            name = (_numbers(file) or [file.stem])[-1]
            if len(found) == 1 and not alone:
                found = [found[0]._replace(name=name)]
            people += found
    if not people:
        raise InvalidFileError(expected({}))
    return people


def _content(file: Path) -> tuple[Any, tuple[str, ...]]:
    """Returns the content of a file, and the keys whose values are not read because they are
    pickled objects.
    """
    if file.suffix.lower() == ".json":
        return read_json(file), ()
    with open_file(file) as opened:
        start = opened.read(6)
    array = None
    if start == np.lib.format.MAGIC_PREFIX:
        array = read_npy(file)
    if array is not None:
        return values_of(array), ()
    archive = start.startswith(b"PK")
    if (archive or file.suffix.lower() == ".npz") and file.suffix.lower() not in (".pt", ".pth"):
        found = ArrayFile.open(file, MotionError)
        return found.values, found.pickled
    return read_values(file), ()


def _files(folder: Path) -> list[Path]:
    """Returns the files of a motion in a folder, in the order of the numbers in their names. All of
    them have the same suffix. camera.npy is left out.

    Raises: InvalidFileError if there are none.
    """

    def natural(file):
        return [int(x) if x.isdigit() else x for x in re.split(r"(\d+)", file.name)]

    for place in (folder / name for name in _FOLDERS):
        for suffix in (".json", ".npz", *_OF_ONE):
            files = [
                file for file in visible(place.glob("*" + suffix)) if file.name != "camera.npy"
            ]
            if files:
                return sorted(files, key=natural)
    raise InvalidFileError("no .json, .npz or other file of a motion in this folder")


def _numbers(file: Path) -> list[str]:
    return re.findall(r"\d+", file.stem)


# People in values
# --------------------------------------------------------------------------------------------------


def _people(content: Any, pickled: tuple[str, ...] = ()) -> list[Person]:
    """Returns the people in the content of a file. The content may have a list of people for each
    frame.
    """
    frames = _listed_frames(content)
    if frames is not None:
        return _stacked([(f"frame {i}", each) for i, each in enumerate(frames)])
    return [
        person._replace(frames=_frames_of(person.values), pickled=pickled)
        for person in _found(content, "", 0)
    ]


def _found(content: Any, name: str, depth: int) -> list[Person]:
    """Returns the people in some content.

    name: name of a person who has no name in the file. depth: number of levels above the content.
    Raises: InvalidFileError for more people than the limit.
    """
    content = objects(content)
    if depth > _DEEPEST:
        return []
    # a list of people, a person, a person one level deeper, or people by name
    if isinstance(content, dict):
        form = format_of(content)
        if form is not None:
            return _split(content, form, name)
        for key in _INSIDE:
            if isinstance(content.get(key), dict):
                beside = {other: value for other, value in content.items() if other not in _INSIDE}
                return _found(beside | content[key], name, depth + 1)
        for key in _LISTS:
            if isinstance(objects(content.get(key)), dict | list):
                return _found(content[key], name, depth + 1)
        named = [(str(key), each) for key, each in content.items()]
    elif isinstance(content, list | tuple):
        named = []
        for i, each in enumerate(content):
            key = _first(_IDS, each) if isinstance(each, dict) else None
            named.append((str(i) if key is None else _word(each[key]), each))
    else:
        return []
    found = [person for name, each in named for person in _found(each, name, depth + 1)]
    check_limit("people", len(found), "people")
    return found


def _first(keys: Sequence[str], values: Mapping[str, Any]) -> str | None:
    """Returns the first of some keys that the values have; None if they have none."""
    return next((key for key in keys if key in values), None)


def _word(value: Any) -> str:
    number = np.asarray(as_array(value)).reshape(-1)
    if number.size == 1 and number.dtype.kind in "iuf":
        return f"{number[0]:g}"
    return str(value)[:40]


def _split(values: Mapping[str, Any], form: ArrayKeys, name: str) -> list[Person]:
    """Returns the people in some values. There are several if the arrays have a first axis of
    people.

    form: the format of the values. name: name of the person, if there is only one.
    """
    place, poses = next(iter(form.poses.items()))
    if poses not in values or not _of_several(values[poses], place, form):
        return [Person(name, values)]
    # poses and positions have a row or a block for each person, all else is of everybody
    arrays = {}
    for key in (*form.poses.values(), *form.moves):
        if key in values:
            arrays[key] = as_array(values[key])
    shared = {key: value for key, value in values.items() if key not in arrays}
    # numbers of the people, where the file has one for each
    count = len(arrays[poses])
    numbers = np.arange(count)
    key = _first(_IDS, values)
    if key is not None and np.size(as_array(values[key])) == count:
        numbers = np.ravel(as_array(values[key]))
    people = []
    for i, number in enumerate(numbers.tolist()):
        own = {}
        for key, array in arrays.items():
            if len(array) == count:
                # roots come for all frames of a person, whole poses for one frame
                own[key] = array[i] if place == "root" else array[i : i + 1]
        people.append(Person(str(number), shared | own))
    return people


def _of_several(poses: Any, place: str, form: ArrayKeys) -> bool:
    """Says whether the first axis of an array of roots or of whole poses counts several people."""
    if place not in ("root", "all") or form.kind != "poses" or isinstance(poses, list):
        return False
    array = as_array(poses)
    if array.ndim != 3:
        return False
    if form.pivot == "head":
        return True
    # vectors of several frames each; 3 x 3 numbers may also be the matrices of one person
    _, frames, width = array.shape
    vectors = place == "root" and width == 3 and frames > 1
    matrices = frames == 3 and _off_rotations(array) < 0.1  # `ORTHONORMAL` is checked later
    return vectors and not matrices


def are_rotations(array: np.ndarray) -> bool:
    """Says whether an array (..., 3, 3) consists of rotation matrices, to within `ORTHONORMAL`."""
    return (
        array.shape[-2:] == (3, 3)
        and _off_rotations(array) < ORTHONORMAL
        and bool((np.linalg.det(array) > 0).all())
    )


def _off_rotations(array: np.ndarray) -> float:
    """Returns the largest difference of R R^T from the identity; infinite if the array does not
    hold real numbers.
    """
    if array.dtype.kind not in "fiu":
        return np.inf
    return float(np.abs(array @ np.swapaxes(array, -1, -2) - np.eye(3)).max(initial=0))


def _frames_of(values: Mapping[str, Any]) -> np.ndarray | None:
    """Returns the numbers of the frames in which a person was seen; None if the file has none."""
    key = _first(_FRAMES, values)
    if key is None:
        return None
    try:
        return np.ravel(as_array(values[key]))
    except ValueError:
        return None


# Frames with people
# --------------------------------------------------------------------------------------------------


def _listed_frames(content: Any) -> list[list[Person]] | None:
    """Returns the people of each frame, if the content has a list for each frame.

    The content may be a list of lists, or PHALP's dict by image. None: it is neither.
    """
    content = objects(content)
    if (
        isinstance(content, list)
        and content
        and all(isinstance(objects(each), list) for each in content)
    ):
        return [_found(each, "", 1) for each in content]
    images = []
    if isinstance(content, dict):
        images = list(content.values())
    if not images or not all(
        isinstance(each, dict) and isinstance(objects(each.get("smpl")), list) for each in images
    ):
        return None
    return [_tracked(each) for each in images]


def _tracked(image: Mapping[str, Any]) -> list[Person]:
    """Returns the people that PHALP follows in an image. The image has lists with one entry for
    each person.
    """
    lists = {key: objects(image.get(key)) for key in ("smpl", "tid", "camera")}
    tracks, cameras = lists["tid"], lists["camera"]
    people = []
    for i, values in enumerate(lists["smpl"]):
        if isinstance(values, dict):
            if isinstance(tracks, list) and i < len(tracks):
                name = _word(tracks[i])
            else:
                name = str(i)
            camera = {}
            if isinstance(cameras, list) and i < len(cameras):
                camera = {"camera": cameras[i]}
            people.append(Person(name, values | camera))
    return people


def _frames(files: Sequence[Path]) -> list[tuple[str, list[Person]]]:
    """Returns the people of each frame: (name of its first file, people).

    The names of files may end in two numbers, of the frame and of the person. This is assumed if
    all names have at least two numbers and the last but one is not the same in all. Otherwise a
    file has all people of one frame. Files without people give a frame of nobody.

    Raises: FileNotFoundError or FileError for a file that cannot be read; MotionError if its
    content is neither an object nor a list; InvalidFileError for too many people, or if the only
    file is an object without people.
    """
    numbers = [_numbers(file) for file in files]
    apart = all(len(each) > 1 for each in numbers) and len({each[-2] for each in numbers}) > 1
    frames: dict[str, tuple[str, list[Person]]] = {}
    for file, number in zip(files, numbers, strict=True):
        content = _content(file)[0]
        if not isinstance(content, dict | list):
            raise MotionError(file, "", f"expected a JSON object, got {type(content).__name__}")
        people = _found(content, "", 0)
        if apart:
            people = [person._replace(name=number[-1]) for person in people]
        frames.setdefault(number[-2] if apart else str(file), (file.name, []))[1].extend(people)
        if not people and isinstance(content, dict) and len(files) == 1:
            raise InvalidFileError(expected(content))
    return list(frames.values())


def _stacked(frames: Sequence[tuple[str, list[Person]]]) -> list[Person]:
    """Returns the people of a motion, each with the values of all frames that show the person.

    frames: for each frame, its name and its people.
    Raises: InvalidFileError if a person lacks a value in a frame, but has it in the first frame
    that shows the person.
    """
    people: dict[str, list[tuple[int, Mapping[str, Any]]]] = {}
    for i, (_, found) in enumerate(frames):
        for person in found:
            people.setdefault(person.name, []).append((i, person.values))
    stacked = []
    for name, seen in people.items():
        begin, first = seen[0]
        form = format_of(first)
        assert form is not None
        # what is there for each frame: poses, positions, rates, and two more
        kept = (*form.poses.values(), *form.moves, *form.rates, "cam2world", "pred_global_rots")
        keys = [key for key in kept if key in first]
        for i, values in seen:
            missing = set(keys) - set(values)
            if missing:
                raise InvalidFileError(
                    f"{frames[i][0]}: {min(missing)}: missing, but {frames[begin][0]} has it"
                )
        values = {key: [objects(values[key]) for _, values in seen] for key in keys}
        values = {
            k: [x if isinstance(x, list | int | float) else as_array(x) for x in each]
            for k, each in values.items()
        }
        stacked.append(Person(name, values, np.asarray([i for i, _ in seen])))
    return stacked


def expected(values: Mapping[Any, Any], pickled: Sequence[str] = ()) -> str:
    """Returns the text of an error about values that have no known format. pickled: keys of values
    that are not read because they are pickled.
    """
    # other files of ours, by keys that they have
    if {"header", "skinning_weights", "means"} <= values.keys():
        return "no motion: this is an avatar: expected a motion to play with it"
    if {"points", "confidences", "set"} <= values.keys():
        return "no motion: these are keypoints, which `humangs fit` makes poses of"
    first_keys = dict.fromkeys(
        row.arrays.keys[0] for row in MOTIONS.values() if row.arrays is not None
    )
    # that of a single array
    first = ", ".join(key for key in first_keys if not key.startswith("("))
    unread = [f"{key} (a pickled object, which is never read)" for key in pickled]
    keys = ", ".join([*unread, *sorted(map(str, values))][:SHOWN]) or "none"
    return f"no motion: expected one of the keys {first}, got {keys}{hint_for(values)}"
