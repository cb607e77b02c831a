"""Reads and writes the layout of the published network's data: lists of scenes with cameras, and
the body of each frame as arrays.

    train.json, test.json   [{"scene_name", "mesh_transform" 4 x 4,
                              "frames": [{"image_path", "w2c" 4 x 4 OpenCV, "fxfycxcy",
                              "smpl_path"}]}]
    smpl_path               npz of v_posed (n, 3), v_cano (n, 3), faces (f, 3), joint_transforms
                            (55, 4, 4)
    evaluation_N.json       {scene: {"context": [views], "target": [views]}}, N input views

Paths are relative to the list. Images are square, on white. The arrays are in the units of the
scene. Except for pose correctives, `v_posed` is `v_cano` moved by `joint_transforms`.

The reader recovers unit, shape and pose from the arrays, and converts cameras to metres. So lists
of other programs need nothing more. We also write `mask_path`. If it is missing, the alpha channel
is the mask; without one, the pixels that are not white, and those that they enclose, show the
person.
"""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.data.cameras import intrinsics
from humangs_jax.data.capture_checks import (
    CaptureError,
    checked_camera,
    checked_json,
    checked_path,
    expect,
    members,
)
from humangs_jax.data.datasets.subject import (
    STORED_SIZE,
    BodyParameters,
    FileBody,
    Person,
    Subject,
    checked_numbers,
    open_arrays,
    recover_pose,
    recover_shape,
)
from humangs_jax.data.photos import read_checked
from humangs_jax.io.arrays import write_npz
from humangs_jax.io.images import image_size, read_grey, read_image
from humangs_jax.io.reading import shown

LISTS = ("train.json", "test.json")
WHITE = 250 / 255
"""If there is neither a mask nor an alpha channel, a pixel belongs to the person if one of its
channels is below this. White pixels may be a little below 1, since JPEG compression changes them by
a few of 255 levels.
"""
KEPT_FRAMES = 64
"""Largest number of poses of a scene that are kept in memory."""
SIGNIFICANT = 9
"""Digits of the numbers in lists, as many as float32 has."""


class SceneFrame(NamedTuple):
    """A view of a scene. Paths are relative to the list."""

    image: str
    """The path of the photo."""
    cam_from_world: Float[np.ndarray, "4 4"]
    """From the world to the camera, (4, 4)."""
    K: Float[np.ndarray, "3 3"]
    """The camera matrix, (3, 3), pixels."""
    arrays: str
    """The path of the arrays of the body that the view shows."""
    mask: str | None = None
    """The path of the mask; None: the list names none."""


def find_scene_list(path: str | Path) -> tuple[Path, ...]:
    """Returns the path, as a tuple of one, if it is a .json file or a folder with a train.json or
    test.json; else an empty tuple. The file is not read.
    """
    path = Path(path)
    found = (path.is_file() and path.suffix == ".json") or any(
        (path / name).is_file() for name in LISTS
    )
    return (path,) if found else ()


def _list_of(path: str | Path) -> Path:
    """Returns the JSON file of a list. Of a folder this is train.json, or test.json if there is
    none.
    """
    file = Path(path)
    if file.is_dir():
        return next((file / name for name in LISTS if (file / name).is_file()), file / LISTS[0])
    return file


def read_scene_list(path: str | Path) -> dict[str, dict[str, Any]]:
    """Returns the JSON objects of the scenes of a list, by name. Only the names are checked. path:
    the JSON file, or a folder (train.json, else test.json).

    Raises: CaptureError naming the file, and the key if a value is wrong.
    """
    file, scenes = _list_of(path), {}
    content = checked_json(file)
    if not isinstance(content, list) or not content:
        raise CaptureError(file, "", f"expected a list of scenes, got {shown(content)}")
    for i, scene in enumerate(content):
        (name,) = members(scene, file, f"[{i}]", scene_name=str)
        if name in scenes:
            raise CaptureError(
                file,
                f"[{i}].scene_name",
                f"expected a name no other scene has, got {shown(name)}",
            )
        scenes[name] = scene
    return scenes


def open_scene_list(
    path: str | Path, body: FileBody, size: int | None = None
) -> tuple[Person, ...]:
    """Returns the people of a list. Each person is opened at the first use.

    size: the side of the stored squares, pixels. None: the longer side of the first image that
    exists among the first images of the scenes, or `STORED_SIZE` if none of these exists.

    Raises: CaptureError if the list cannot be read, or the image that gives the size.
    """
    file = _list_of(path)
    scenes = read_scene_list(file)
    if size is None:
        # scenes without frames are refused when they are opened, and not all of the list
        listed = (
            scene["frames"] for scene in scenes.values() if isinstance(scene.get("frames"), list)
        )
        firsts = (frames[0] for frames in listed if frames and isinstance(frames[0], dict))
        images = (file.parent / str(frame.get("image_path")) for frame in firsts)
        first = next((image for image in images if image.is_file()), None)
        size = STORED_SIZE
        if first is not None:
            size = max(read_checked(image_size, first))

    def opened(name, scene):
        return functools.partial(_open_scene, file, name, scene, body)

    return tuple(
        Person(f"{file}: {name}", opened(name, scene), size) for name, scene in scenes.items()
    )


def _open_scene(file: Path, name: str, scene: Mapping[str, Any], body: FileBody) -> Subject:
    """Open one scene of a list, in metres. Views whose image or arrays do not exist are left out
    and counted.

    Raises: CaptureError.
    """
    # views that share a file of arrays show the same frame
    views, missing = _present(file, name, scene)
    smpl, frames = np.unique([view.arrays for view in views], return_inverse=True)
    arrays = [_inside(file, name, path) for path in smpl.tolist()]
    first = open_arrays(arrays[0])
    # the arrays hold meshes alone: shape and unit are recovered from that in the T-pose
    scale, betas = recover_shape(body, first.numbers("v_cano", (None, 3)), first.path)

    @functools.lru_cache(maxsize=KEPT_FRAMES)
    def pose(frame: int):
        values = open_arrays(arrays[frame])
        transforms = values.numbers("joint_transforms", (len(body.model.parents), 4, 4))
        return recover_pose(body, betas, scale, transforms, values.path)

    def parameters(chosen: Sequence[int]) -> BodyParameters:
        poses = [pose(frame) for frame in chosen]
        joints = len(body.model.parents)
        rotations = np.asarray([rotation for rotation, _ in poses]).reshape(-1, joints, 3)
        return BodyParameters(betas, rotations, np.asarray([t for _, t in poses]).reshape(-1, 3))

    # all images have one size; cameras go from the units of the scene to metres
    sizes = np.asarray([read_checked(image_size, _inside(file, name, views[0].image))] * len(views))
    K = np.stack([view.K for view in views])
    poses = np.stack([view.cam_from_world for view in views])
    for i in range(len(views)):
        checked_camera(K[i], poses[i], *sizes[i].tolist(), file, f"{name}.frames[{i}]")
    poses[:, :3, 3] /= scale
    return Subject(
        name=f"{file}: {name}",
        K=K,
        cam_from_world=poses,
        sizes=sizes,
        frames=frames.astype(np.int32),
        frame_count=len(arrays),
        view_name=lambda view: f"{view:05d}",
        read=lambda view: _read_view(file, name, views[view]),
        parameters=parameters,
        missing=missing,
    )


def _scene_frames(file: Path, name: str, scene: Mapping[str, Any]) -> list[SceneFrame]:
    """Returns the frames of a scene after checking them.

    Raises: CaptureError naming file and key.
    """
    views, (frames,) = [], members(scene, file, name, frames=list)
    for i, frame in enumerate(frames):
        at = f"{name}.frames[{i}]"
        image, arrays, pose, inner = members(
            frame, file, at, image_path=str, smpl_path=str, w2c=list, fxfycxcy=list
        )
        K = intrinsics(*checked_numbers(inner, file, f"{at}.fxfycxcy", (4,)).tolist())
        views.append(
            SceneFrame(
                image,
                checked_numbers(pose, file, f"{at}.w2c", (4, 4)),
                K,
                arrays,
                frame.get("mask_path"),
            )
        )
    if not views:
        raise CaptureError(file, f"{name}.frames", "expected at least one frame")
    return views


def _present(
    file: Path, name: str, scene: Mapping[str, Any]
) -> tuple[list[SceneFrame], dict[str, int]]:
    """Returns the frames whose image and arrays exist, and how many are left out for each
    reason.
    """
    views, missing = [], {"no image": 0, "no smpl_path": 0}
    is_there = functools.lru_cache(None)(lambda path: _inside(file, name, path).is_file())
    for view in _scene_frames(file, name, scene):
        if not is_there(view.arrays):
            missing["no smpl_path"] += 1
        elif not is_there(view.image):
            missing["no image"] += 1
        else:
            views.append(view)
    if not views:
        raise CaptureError(file, name, f"no view with its image and arrays ({missing})")
    return views, {reason: count for reason, count in missing.items() if count}


def _inside(file: Path, name: str, path: Any) -> Path:
    return checked_path(file.parent, path, f"{file}: {name}")


def _read_view(
    file: Path, name: str, view: SceneFrame
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "mask_h mask_w"]]:
    path = _inside(file, name, view.image)
    image, alpha = read_checked(read_image, path)
    if view.mask is not None:
        return image, read_checked(read_grey, _inside(file, name, view.mask))
    if alpha is not None:
        return image * alpha[..., None] + (1 - alpha[..., None]), alpha
    return image, _not_white(image).astype(np.float32)


def _not_white(image: Float[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Returns which pixels of an image on white show the person: those below `WHITE`, and the
    pixels that these enclose.
    """
    from scipy.ndimage import binary_fill_holes

    return np.asarray(binary_fill_holes(image.min(axis=-1) < WHITE))


# Writing
# --------------------------------------------------------------------------------------------------


def scene_entry(
    name: str, mesh_transform: Float[np.ndarray, "4 4"], frames: Sequence[SceneFrame]
) -> dict[str, Any]:
    """Returns the JSON object of a scene, for train.json or test.json. Numbers are rounded to
    `SIGNIFICANT` digits.
    """
    return {
        "scene_name": name,
        "mesh_transform": rounded(mesh_transform),
        "frames": [
            {
                "image_path": frame.image,
                **({} if frame.mask is None else {"mask_path": frame.mask}),
                "w2c": rounded(frame.cam_from_world),
                "fxfycxcy": rounded(frame.K[[0, 1, 0, 1], [0, 1, 2, 2]]),
                "smpl_path": frame.arrays,
            }
            for frame in frames
        ],
    }


def rounded(array: Float[np.ndarray, "..."]) -> Any:
    """Returns nested lists of the numbers of an array, rounded to `SIGNIFICANT` digits."""

    def short(x):
        if isinstance(x, list):
            return [short(row) for row in x]
        return float(f"{x:.{SIGNIFICANT}g}")

    return short(array.tolist())


def write_arrays(
    path: Path,
    posed: Float[np.ndarray, "n 3"],
    rest: Float[np.ndarray, "n 3"],
    faces: np.ndarray,
    joint_transforms: Float[np.ndarray, "j 4 4"],
) -> None:
    """Write the npz of a frame. posed, rest: the vertices, written as v_posed and v_cano. All
    lengths are in units of the scene.
    """
    arrays = {"v_posed": posed, "v_cano": rest, "joint_transforms": joint_transforms}
    write_npz(
        path,
        {name: array.astype(np.float32) for name, array in arrays.items()}
        | {"faces": faces.astype(np.int32)},
    )


def read_evaluation(path: str | Path) -> dict[str, dict[str, list[int]]]:
    """Returns the numbers of the context and target views of each scene, by its name, from an
    evaluation_N.json.

    Raises: CaptureError naming the file, and the key if a value is wrong.
    """
    file = Path(path)
    content = checked_json(file)
    for name, views in expect(content, dict, file, "").items():
        for key, chosen in zip(
            ("context", "target"),
            members(views, file, name, context=list, target=list),
            strict=True,
        ):
            if not chosen or not all(type(view) is int and view >= 0 for view in chosen):
                raise CaptureError(
                    file, f"{name}.{key}", f"expected numbers of views, got {shown(chosen)}"
                )
    return content
