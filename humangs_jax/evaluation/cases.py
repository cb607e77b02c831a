"""The people of an evaluation, from captures, data sets or a `Source`, and the methods that predict
their views. The simplest method comes last.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import capture_renderings
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel, BodyPose, RestBody, pose_body, shape_body
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.arrays import from_host, joined
from humangs_jax.core.compiled import compiled
from humangs_jax.core.processes import Call
from humangs_jax.data.capture import Capture, load_capture
from humangs_jax.data.datasets.subject import FileBody, open_people
from humangs_jax.data.loading.captures import find_captures
from humangs_jax.data.loading.examples import Source
from humangs_jax.data.photos import capture_folder
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.images import PHOTO_SUFFIXES, read_image
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.parts import Variables
from humangs_jax.network.reader import photo_colors, project_vertices, visible_vertices
from humangs_jax.network.weights import load_weights
from humangs_jax.rendering.mesh.rasterizer import interpolate_attributes, rasterize_mesh

HELD_OUT = "held_out"
"""The name of a folder in a capture folder. It holds a second capture of the person, whose views
are never inputs. `humangs synth` writes such folders.
"""
DEFAULT_INPUTS = 4
MOST_TARGETS = 2000
"""Largest number of views of one person of a data set that are compared. The views are in memory
together.
"""
Indices = Mapping[str, Mapping[str, Sequence[int]]]
"""For each person the numbers of views in the capture: "context" are the inputs, "target" the views
to compare with.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """One person to score a method on."""

    name: str
    """The name of the person."""
    truth: Capture
    """The views to compare with."""
    inputs: Capture | None = None
    """The photos that a reconstruction may see; None: not known."""


class Choice(NamedTuple):
    """The rule by which input views are chosen, see `find_people`."""

    inputs: int | None = None
    """How many photos are inputs; None: see `find_people`."""
    indices: Indices | None = None
    """The numbers of the inputs and targets of each person; None: inputs are evenly spaced."""
    reconstructs: bool = True
    """Whether the method needs inputs."""


ANY = Choice()


class People(NamedTuple):
    """The people of an evaluation. Each case is loaded when it is asked for."""

    names: tuple[str, ...]
    """The names of the people."""
    load: Callable[[int], Case]
    """Loads the case with a number, an index into `names`."""


class Predicted(NamedTuple):
    """The images that a method predicts for views of a case."""

    images: Float[np.ndarray, "v h w 3"]
    """The predicted images of v views, (v, h, w, 3), in [0, 1]."""
    alpha: Float[np.ndarray, "v h w"] | None
    """Coverage by the person in these images, (v, h, w); None: not known."""
    views: tuple[int, ...]
    """The numbers of these views in the truth of the case."""
    missing: tuple[str, ...] = ()
    """The files that were not found."""


Method = Callable[[Case, float], Predicted]
"""A function that takes a case and the grey value of the background, and returns its predictions.
"""


def find_people(
    source: str | Path | Capture | Case | Source | Iterable[Case],
    inputs: int | None = None,
    indices: Indices | None = None,
    body: BodyModel | str | Path | None = None,
    reconstructs: bool = True,
) -> People:
    """Returns the people of a source.

    Arguments:
        source: a capture folder, or a folder of capture folders; a scene list, or a data set of
            `data.formats.DATASETS`; a `Capture`; cases; or a `Source`. The examples of a `Source`
            give inputs and targets.
        body: the body model that the parameters belong to, or its file. None: the body that a
            capture folder names; for data sets and a `Source` the body that comes with the package.
            It is ignored for a `Capture` and for cases, which contain their body.
        inputs: the number of photos that are inputs, see `spread_views`. None: 4. There are two
            exceptions. If a capture with a folder held_out has fewer than 4 views of the first
            view's frame, all of these are inputs. If a `Source` has no examples with 4 inputs, its
            first number of inputs is taken.
        indices: the inputs and targets of each person of captures and data sets, in place of
            `inputs`.
        reconstructs: whether the method needs inputs. If it does not, and neither `inputs` nor
            `indices` is given, all views of a capture or of a person of a data set are compared. A
            capture with a folder held_out is an exception: only the views in that folder are
            compared.

    Raises: ValueError, which names what is wrong; TypeError for cases that are no `Case`; as
    `load_body` for the file of a body. `People.load` raises ValueError if a case cannot be loaded.
    """
    if indices is not None and not isinstance(source, Capture | str | Path):
        raise ValueError(
            "indices: expected none, since cases and sources say what is input and what is compared"
        )
    if isinstance(source, Case):
        return People((source.name,), lambda index: source)
    # captures: one, or a folder of them
    choice = Choice(inputs, indices, reconstructs)
    if isinstance(source, Capture):
        return People(("capture",), lambda index: _split("capture", source, choice))
    if isinstance(source, str | Path):
        path = capture_folder(source)
        if not (path / "capture.json").is_file() and not any(path.glob("*/capture.json")):
            return _find_in_data_set(path, choice, body)
        body, folders = _model(body), find_captures(path)
        names = tuple(folder.name for folder in folders)
        unknown = [name for name in indices or () if name not in names]
        if unknown:
            raise ValueError(f"indices: {unknown[0]!r} is no capture in {source}")
        return People(names, lambda index: _load(folders[index], choice, body))
    # what training reads
    if isinstance(source, Source):
        names = tuple(f"{index:04d}" for index in range(len(source)))
        return People(
            names, lambda index: _from_source(source, index, names[index], inputs, _model(body))
        )
    # cases as they are
    cases = list(source)
    others = [type(case).__name__ for case in cases if not isinstance(case, Case)]
    if others:
        raise TypeError(f"evaluate: source: expected Cases, got a {others[0]} among them")
    return People(tuple(case.name for case in cases), cases.__getitem__)


def _load(folder: Path, choice: Choice, body: BodyModel | None) -> Case:
    capture, held_out = load_capture(folder, body=body), folder / HELD_OUT
    if choice.indices is not None or not (held_out / "capture.json").is_file():
        return _split(folder.name, capture, choice)
    first = int(np.sum(np.asarray(capture.frames) == capture.frames[0]))
    if choice.inputs is None:
        count = min(DEFAULT_INPUTS, first)
    else:
        count = choice.inputs
    chosen = spread_views(
        folder.name, capture.frames, np.asarray(capture.cameras.cam_from_world), count
    )
    return Case(folder.name, load_capture(held_out, body=capture.body), capture.select(chosen))


def _model(body: BodyModel | str | Path | None) -> BodyModel | None:
    if isinstance(body, str | Path):
        return load_body(body)
    return body


def _find_in_data_set(path: Path, choice: Choice, body: BodyModel | str | Path | None) -> People:
    """Returns the people of a data set. Photos are read when a case is loaded."""
    if isinstance(body, BodyModel):
        file_body = FileBody(body)
    else:
        file_body = FileBody.load(body)
    people = open_people(path, file_body)
    names = _short_names([Path(person.name.rpartition(": ")[2]) for person in people])

    def load(index: int) -> Case:
        subject, size, name = people[index].subject, people[index].size, names[index]
        chosen, targets = choose_views(name, subject.frames, subject.cam_from_world, choice)
        if len(targets) > MOST_TARGETS:
            raise ValueError(
                f"{name}: {len(targets)} views to compare with, at most {MOST_TARGETS}: choose some"
                " by indices"
            )
        seen = None
        if chosen:
            seen = subject.capture(chosen, file_body, size)
        return Case(name, subject.capture(targets, file_body, size), seen)

    return People(names, load)


def _short_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """Returns a name for each path: its last parts, as many as are needed so that no two names are
    equal. If no number of parts suffices, names are numbers. ActorsHQ, for example, has a Sequence1
    of every actor.
    """
    for parts in range(1, 1 + max(len(path.parts) for path in paths)):
        names = tuple("_".join(path.parts[-parts:]) for path in paths)
        if len(set(names)) == len(names):
            return names
    return tuple(f"{index:04d}" for index in range(len(paths)))


def _split(name: str, capture: Capture, choice: Choice) -> Case:
    """Returns the case of a capture, whose views are split into inputs and targets."""
    chosen, targets = choose_views(
        name, capture.frames, np.asarray(capture.cameras.cam_from_world), choice
    )
    inputs = capture.select(chosen) if chosen else None
    return Case(name, capture.select(targets), inputs)


def choose_views(
    name: str,
    frames: Int[np.ndarray, " v"],
    cam_from_world: Float[np.ndarray, "v 4 4"],
    choice: Choice = ANY,
) -> tuple[list[int], list[int]]:
    """Returns the numbers of the views that are inputs, and of the views to compare with. name: the
    name of the person, as `Choice.indices` has it.

    If there are `choice.indices`, they decide: a person without "context" there has no inputs.
    Otherwise `choice.inputs` views are taken as in `spread_views` (None: `DEFAULT_INPUTS`), and all
    others are compared. If `choice.inputs` is None and `choice.reconstructs` is False, there are no
    inputs, and all views are compared.

    Raises: ValueError, which names the person, if `indices` lacks the person, has no target, or has
    a view that does not exist; if too few views show the first frame; or if no view is left to
    compare with.
    """
    count, (inputs, indices, reconstructs) = len(frames), choice
    if indices is not None:
        if name not in indices:
            raise ValueError(f"indices: {name!r} is missing")
        chosen, targets = (list(indices[name].get(key, ())) for key in ("context", "target"))
        if not targets or not all(0 <= i < count for i in (*chosen, *targets)):
            raise ValueError(
                f"indices: {name}: expected views from 0 to {count - 1} and at least one target"
            )
        return chosen, targets
    if inputs is None and not reconstructs:
        return [], list(range(count))
    wanted = DEFAULT_INPUTS if inputs is None else inputs
    chosen = spread_views(name, frames, cam_from_world, wanted)
    targets = [i for i in range(count) if i not in chosen]
    if not targets:
        raise ValueError(f"{name}: {count} views, all of them inputs: none is left to compare with")
    return chosen, targets


def spread_views(
    name: str, frames: Int[np.ndarray, " v"], cam_from_world: Float[np.ndarray, "v 4 4"], count: int
) -> list[int]:
    """Returns the numbers of `count` views that show the first view's frame, in ascending order.
    The views of this frame are sorted by their azimuth around the middle of the cameras, beginning
    with the first view. From this order, `count` views at even distances are taken, again beginning
    with the first.

    Raises: ValueError if too few views show this frame.
    """
    same = np.flatnonzero(np.asarray(frames) == frames[0])
    if not 1 <= count <= len(same):
        raise ValueError(f"{name}: {count} inputs, but {len(same)} views show the first frame")
    centers = -np.einsum("vji,vj->vi", cam_from_world[same, :3, :3], cam_from_world[same, :3, 3])
    away = centers - centers.mean(axis=0)
    azimuths = np.arctan2(away[:, 0], away[:, 2])
    around = same[np.argsort((azimuths - azimuths[0]) % (2 * np.pi), kind="stable")]
    return sorted(int(around[i * len(same) // count]) for i in range(count))


def _from_source(
    source: Source, index: int, name: str, inputs: int | None, body: BodyModel | None
) -> Case:
    usual = source.input_counts[0]
    if DEFAULT_INPUTS in source.input_counts:
        usual = DEFAULT_INPUTS
    count = inputs or usual
    example = source.example(0, index, count)
    if body is None:
        body = load_body()
    return Case(name, capture_of(example.targets, body), capture_of(example.inputs, body))


def capture_of(views: SubjectViews, body: BodyModel) -> Capture:
    """Returns views of a source as a capture. Views with equal poses show one frame, and the names
    of the views are numbers.
    """
    views = jax.tree.map(np.asarray, views)
    if views.view_count is None:
        count = len(views.images)
    else:
        count = int(views.view_count)
    poses = np.concatenate(
        [views.rotations.reshape(len(views.images), -1), views.translations], axis=1
    )[:count]
    _, first, frames = np.unique(poses, axis=0, return_index=True, return_inverse=True)
    numbers = np.argsort(np.argsort(first))  # frames in the order in which they appear
    first = np.sort(first)
    return Capture(
        images=np.asarray(views.images[:count], np.float32),
        masks=np.asarray(views.masks[:count], np.float32),
        cameras=jax.tree.map(lambda leaf: jnp.asarray(leaf[:count]), views.cameras),
        frames=numbers[frames.ravel()].astype(np.int32),
        body=body,
        betas=views.betas,
        poses=jax.vmap(BodyPose)(
            jnp.asarray(views.rotations[first]), jnp.asarray(views.translations[first])
        ),
        names=tuple(f"{i:03d}" for i in range(count)),
    )


# Methods
# --------------------------------------------------------------------------------------------------


def predict_views(avatar: Avatar, views: Capture, background: float = 1.0) -> Predicted:
    """Returns images of an avatar in the poses and from the cameras of a capture. background: the
    grey value behind the avatar.
    """
    drawn = capture_renderings(avatar, views, from_host(np.full(3, background), np.float32))[1]
    images = np.stack([np.clip(np.asarray(rendering.rgb), 0, 1) for rendering in drawn])
    alpha = np.stack([np.asarray(rendering.alpha) for rendering in drawn])
    return Predicted(images, alpha, tuple(range(len(images))))


def _avatar_method(avatar: str | Path | Avatar, people: int) -> Method:
    """Returns the method that draws one avatar, or for each person the avatar PERSON.npz of a
    folder. If a person has no such file, there are no images, and the file is listed as missing.

    Raises: ValueError for one avatar and several people, and as `Avatar.load`; FileNotFoundError if
    the file of one avatar does not exist.
    """
    folder = None
    if not isinstance(avatar, Avatar):
        folder = Path(avatar)
    if folder is None or not folder.is_dir():
        if people != 1:
            raise ValueError(
                f"one avatar for {people} people: expected a folder with PERSON.npz for each"
            )
        if isinstance(avatar, Avatar):
            loaded = avatar
        else:
            loaded = Avatar.load(avatar)
        return lambda case, background: predict_views(loaded, case.truth, background)

    def one_of(case: Case, background: float) -> Predicted:
        file = folder / f"{case.name}.npz"
        if file.is_file():
            return predict_views(Avatar.load(file), case.truth, background)
        return _nothing(case, (str(file),))

    return one_of


def _weights_method(variables: Variables, config: HumanGSConfig) -> Method:
    """Returns the method that reconstructs an avatar from the inputs of a case and draws it. If the
    network has a driver, the driver makes the images.
    """

    def method(case: Case, background: float) -> Predicted:
        if case.inputs is None:
            raise ValueError(f"{case.name}: no inputs to reconstruct from")
        driver = config.architecture.driver
        if driver is not None:
            images, alpha = driver.show(variables, config, case.inputs, case.truth, background)
            return Predicted(images, alpha, tuple(range(len(images))))
        return predict_views(reconstruct(variables, config, case.inputs), case.truth, background)

    return method


def predictions_method(folder: str | Path, people: int) -> Method:
    """Returns the method that reads the images of another program: FOLDER/PERSON/VIEW.png, or
    FOLDER/VIEW.png if there is one person and no folder FOLDER/PERSON. The suffix may be any suffix
    of photos.

    VIEW is the file name of the true photo without its suffix, or view_NNN as `humangs render`
    numbers them. An alpha channel is the coverage, and its image is put on the background. An image
    without alpha is taken to be on the protocol's background already.

    Raises: FileNotFoundError if the folder does not exist. The method raises ValueError if an image
    cannot be read or has another size than the true photo, or if only some of a person's images
    have an alpha channel.
    """
    root = Path(folder)
    if not root.is_dir():
        raise FileNotFoundError(f"{root}: no such folder of predictions")

    def method(case: Case, background: float) -> Predicted:
        place, files = _predictions_of(case, root, people), prediction_files(root, case, people)
        missing = tuple(str(place / f"{name}.png") for name, file in files.items() if file is None)
        found = [(i, file) for i, file in enumerate(files.values()) if file is not None]
        if not found:
            return _nothing(case, missing)
        # alpha channels are the coverage: all images have one, or none
        size = case.truth.images.shape[1:3]
        read = [_read_prediction(file, size, background) for _, file in found]
        coverage = [alpha for _, alpha in read if alpha is not None]
        if coverage and len(coverage) < len(read):
            counts = f"{len(coverage)} of {len(read)} images"
            raise ValueError(f"{place}: {counts} have an alpha channel: expected all or none")
        images = np.stack([image for image, _ in read])
        alpha = np.stack(coverage) if coverage else None
        return Predicted(images, alpha, tuple(i for i, _ in found), missing)

    return method


def _predictions_of(case: Case, root: Path, people: int) -> Path:
    if people > 1 or (root / case.name).is_dir():
        return root / case.name
    return root


def prediction_files(root: Path, case: Case, people: int) -> dict[str, Path | None]:
    """Returns the file of the predicted image for each view of a case, by the name of the view;
    None where there is no file. root: the folder of predictions.
    """
    place = _predictions_of(case, root, people)
    return {name: _prediction(place, name, i) for i, name in enumerate(case.truth.names)}


def _prediction(place: Path, name: str, index: int) -> Path | None:
    stems = (name, f"view_{index:03d}")
    candidates = (place / f"{stem}{suffix}" for stem in stems for suffix in PHOTO_SUFFIXES)
    return next((file for file in candidates if file.is_file()), None)


def _read_prediction(
    file: Path, size: tuple[int, int], background: float
) -> tuple[np.ndarray, np.ndarray | None]:
    image, alpha = read_image(file)
    if image.shape[:2] != size:
        sizes = " x ".join(map(str, image.shape[1::-1])), " x ".join(map(str, size[::-1]))
        raise ValueError(
            f"{file}: size {sizes[0]}, but the true image has {sizes[1]}: expected the same"
        )
    if alpha is not None:
        image = image * alpha[..., None] + background * (1 - alpha[..., None])
    return image, alpha


def _nothing(case: Case, missing: tuple[str, ...]) -> Predicted:
    return Predicted(case.truth.images[:0], None, (), missing)


@functools.cache
def shipped_weights() -> tuple[Variables, HumanGSConfig]:
    """Returns the network that comes with the package."""
    return load_weights()


def choose_method(
    people: int,
    avatar: str | Path | Avatar | None = None,
    weights: str | Path | tuple[Variables, HumanGSConfig] | None = None,
    predictions: str | Path | None = None,
    method: Method | None = None,
) -> tuple[str, Method]:
    """Returns the name of the method that is asked for, as reports show it, and the method. If
    nothing is given, the shipped weights are used.

    Raises: ValueError if more than one is given, if one avatar is given for several people, or if
    the file of an avatar or of weights is damaged; FileNotFoundError if a file or the folder of
    predictions does not exist.
    """
    given: dict[str, Any] = {
        "avatar": avatar,
        "weights": weights,
        "predictions": predictions,
        "method": method,
    }
    asked = [name for name, value in given.items() if value is not None]
    if len(asked) > 1:
        raise ValueError(f"{' and '.join(asked)}: expected one of them")
    if avatar is not None:
        name = "avatar"
        if not isinstance(avatar, Avatar):
            name = Path(avatar).name
        return name, _avatar_method(avatar, people)
    if predictions is not None:
        return Path(predictions).name, predictions_method(predictions, people)
    if method is not None:
        return getattr(method, "__name__", "method"), method
    if weights is None:
        return "shipped weights", _weights_method(*shipped_weights())
    if isinstance(weights, str | Path):
        return Path(weights).name, _weights_method(*load_weights(weights))
    return "weights", _weights_method(*weights)


def painted_body(inputs: Capture) -> Float[Array, "n 3"]:
    """Returns a color for each vertex of the body: the mean color over the photos that see it, grey
    where none does.
    """
    body = inputs.body
    rest = shape_body(body, from_host(inputs.betas))
    seen = [
        _seen(body, rest, inputs.pose(int(frame)), inputs.cameras[i])
        for i, frame in enumerate(inputs.frames)
    ]
    pixels, visible = (joined(x) for x in zip(*seen, strict=True))
    return _photo_colors(from_host(inputs.images), pixels, visible, "half_pixel")


_photo_colors = compiled(static=["grid"])(photo_colors)


@compiled()
def _seen(
    body: BodyModel, rest: RestBody, pose: BodyPose, camera: Camera
) -> tuple[Float[Array, "n 2"], Bool[Array, " n"]]:
    """Returns the pixels at which a camera shows the vertices of a posed body, (n, 2), and whether
    it sees each vertex, (n,).
    """
    vertices = pose_body(body, rest, pose).vertices
    pixels, depths = project_vertices(camera, vertices)
    depth_map = rasterize_mesh(vertices, body.faces, camera).depth
    size = (camera.width, camera.height)
    return pixels, visible_vertices(pixels, depths, depth_map, size, "half_pixel")


def calls_of_painted_body(inputs: Capture, views: Capture) -> Iterator[Call]:
    """Yields a call of `_seen`, as `painted_body` makes it, and one of `_painted`, as
    `draw_painted_body` makes it. The colors are zeros.
    """
    body = inputs.body
    rest = shape_body(body, from_host(inputs.betas))
    first, drawn = inputs.pose(int(inputs.frames[0])), views.pose(int(views.frames[0]))
    yield _seen, (body, rest, first, inputs.cameras[0])
    colors = np.zeros(body.template.shape, np.float32)
    yield _painted, (body, rest, drawn, views.cameras[0], colors)


def draw_painted_body(colors: Float[Array, "n 3"], views: Capture) -> Float[np.ndarray, "v h w 3"]:
    """Returns images of the body on white, with a color for each vertex, in the poses and from the
    cameras of a capture.
    """
    body = views.body
    rest = shape_body(body, from_host(views.betas))

    images = [
        _painted(body, rest, views.pose(int(frame)), views.cameras[i], colors)
        for i, frame in enumerate(views.frames)
    ]
    return np.stack(images)


@compiled()
def _painted(
    body: BodyModel, rest: RestBody, pose: BodyPose, camera: Camera, colors: Float[Array, "n 3"]
) -> Float[Array, "h w 3"]:
    vertices = pose_body(body, rest, pose).vertices
    fragments = rasterize_mesh(vertices, body.faces, camera)
    return interpolate_attributes(fragments, body.faces, colors, jnp.ones(3))
