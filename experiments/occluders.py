"""Measures what something in front of a person costs an avatar, where it is taken for background
and where it is known to be unknown.
"""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, KDTree

from experiments.harness import Run, entry
from experiments.results import markdown_table
from experiments.subjects import People, Start
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.model import BodyModel
from humangs_jax.capture.fitting.silhouette_fit import posed_vertices
from humangs_jax.core.array_types import Bool, Float
from humangs_jax.data.capture import Capture
from humangs_jax.data.hidden import with_hidden_parts
from humangs_jax.data.view_choice import view_quality
from humangs_jax.data.views import to_network_views
from humangs_jax.evaluation.cases import predict_views
from humangs_jax.geometry.camera import Camera
from humangs_jax.refinement.config import ITERATIONS_ALONE
from humangs_jax.refinement.refine import refine
from humangs_jax.synthetic.subject import make_subject, pose_subject
from humangs_jax.synthetic.writer import View, capture_views, sample_pose

PHOTOS = 4
"""Number of photos around the person. The first is the most frontal one."""
CASES = ("table", "posts", "person")
"""What is in front: boxes, or another synthetic person."""
STATES = ("background", "found", "given", "nothing in front")
"""How the pixels in front are treated: as background, because masks are cut there; as unknown where
the body shows that something covers it (`data/hidden.py`); as unknown where a mask of the object is
given; and photos without the object.
"""
NEAR, BESIDE = 0.5, 0.35
"""Metres from the middle of the person to the other person, towards the first camera and beside."""
OTHERS = 500
"""Difference between the seeds of the other person and of the person."""


@entry
def occluders(
    run: Run,
    people: People = People(5, held_out=4, poses=0, pose_views=1),
    kinds: tuple[str, ...] = CASES,
) -> None:
    """Measures avatars from four photos of synthetic people with a table, posts or another person
    in front.

    The table has foreground PSNRs of refined avatars: of what is covered in a photo, in the photos
    and in held-out views, and of whole held-out views. Poses are true, and so are masks where
    nothing is in front.

    Options:
    kinds: what is in front
    """
    start = people.start()
    cases = {
        f"{kind}: {seed}": functools.partial(measured, start, seed, kind)
        for kind in kinds
        for seed in start.seeds
    }
    found = run.rows(cases, start.settings | {"photos": PHOTOS})

    # means over the people of which something is covered
    table, numbers = [], {}
    for kind in kinds:
        rows = [found[f"{kind}: {seed}"] for seed in start.seeds]
        rows = [row for row in rows if row is not None]
        numbers[kind] = {"people": len(rows)}
        for state in STATES:
            mean = {
                name: float(np.mean([row[state][name] for row in rows])) for name in rows[0][state]
            }
            numbers[kind][state] = mean
            hidden = f"{100 * mean['unknown']:.0f} %"
            values = [mean[name] for name in ("photos", "views", "whole views")]
            table.append([kind, state, hidden, *(f"{value:.2f}" for value in values)])
    header = ["in front", "taken for", "known to be", "covered, in the photos"]
    header += ["covered, held-out views", "all of the person, held-out views"]
    shown = markdown_table(header, table, "ll" + "r" * 4)
    about = f"{len(start.seeds)} people of the {start.settings['split']} seeds, {start.size} px"
    about += f", {PHOTOS} photos, {start.settings['held_out']} held-out views; foreground PSNR, dB."
    run.show(f"{about}\n\n{shown}", {"settings": start.settings, "cases": numbers})


def measured(start: Start, seed: int, kind: str) -> dict[str, dict[str, float]] | None:
    """Returns {state: the numbers of a person}, or None if nothing of the person is covered."""
    # pixels of the photos and of held-out views whose person is covered in a photo
    subject = start.subject(seed, (PHOTOS,))
    whole, others = subject.photos, subject.held_out
    front = in_front(kind, seed, start.body, whole)
    assert whole.masks is not None and others.masks is not None
    truth = whole.masks
    covered = front & (truth > 0.5)
    shown = covered_vertices(start.body, whole, others, covered)
    if not covered.any() or not shown.any():
        return None

    def state_of(name: str) -> Capture:
        """Returns the photos as they are treated in a state."""
        if name == "nothing in front":
            return whole
        masks = np.where(front, np.float32(0), truth)
        images = np.where(front[..., None], np.float32(1), whole.images)
        cut = dataclasses.replace(whole, images=images, masks=masks)
        if name == "background":
            return cut
        if name == "found":
            return with_hidden_parts(cut)
        return dataclasses.replace(cut, unknown=front)

    # scores of the avatar of each state
    result = {}
    for state in STATES:
        photos = state_of(state)
        avatar = refine(
            reconstruct(start.variables, start.config, photos),
            photos,
            dataclasses.replace(ITERATIONS_ALONE, head_steps=0),
        )
        known = np.zeros_like(covered) if photos.unknown is None else photos.unknown
        result[state] = {
            "unknown": float((known & covered).sum() / covered.sum()),
            "photos": psnr(avatar, whole, covered),
            "views": psnr(avatar, others, shown),
            "whole views": psnr(avatar, others, others.masks > 0.5),
        }
    return result


def psnr(avatar: Avatar, truth: Capture, pixels: Bool[np.ndarray, "v h w"]) -> float:
    """Returns the PSNR in dB of an avatar over some pixels of the views of a capture."""
    drawn = predict_views(avatar, truth).images
    return float(-10 * np.log10(np.mean((drawn - truth.images)[pixels] ** 2)))


# What is in front
# --------------------------------------------------------------------------------------------------


def in_front(kind: str, seed: int, body: BodyModel, photos: Capture) -> Bool[np.ndarray, "v h w"]:
    """Returns the pixels in which something is between the person and the cameras of the photos.

    `kind` is one of `CASES`.
    """
    # axes around the person: up is y, and `towards` points to the first camera
    vertices = body_of(photos)
    middle = vertices.mean(axis=0)
    towards = np.asarray(photos.cameras[0].center) - middle
    towards[1] = 0
    towards /= np.linalg.norm(towards)
    left = np.cross([0.0, 1.0, 0.0], towards)
    ground, height = vertices[:, 1].min(), np.ptp(vertices[:, 1])
    place = middle - [0, middle[1] - ground, 0]
    if kind == "person":
        other = make_subject(seed + OTHERS, body)
        posed = sample_pose(other, 0)
        move = place + NEAR * towards + BESIDE * left - [0, ground, 0]
        moved = pose_subject(other, posed.rotations, posed.translation + move.astype(np.float32))
        views = [View(0, name, photos.cameras[i]) for i, name in enumerate(photos.names)]
        masks = np.asarray(capture_views(other, body, [moved], views).masks) > 0.5
        nearer = [is_nearer(moved.vertices.mean(axis=0), middle, c) for c in cameras(photos)]
        return masks & np.asarray(nearer)[:, None, None]

    # boxes as (center, size) in metres
    rng = np.random.default_rng([seed, CASES.index(kind)])
    if kind == "table":
        low = ground + rng.uniform(0.36, 0.42) * height
        boxes = [(place + 0.5 * towards + [0, low - ground, 0], (1.2, 0.05, 0.5))]
    else:
        sides = rng.uniform(-0.12, 0.12, 2)
        # one in front, one on the person's left
        boxes = [
            (place + 0.6 * towards + sides[0] * left + [0, 1, 0], (0.08, 2.4, 0.08)),
            (place + 0.6 * left + sides[1] * towards + [0, 1, 0], (0.08, 2.4, 0.08)),
        ]
    found = np.zeros(photos.images.shape[:3], bool)
    for i, camera in enumerate(cameras(photos)):
        for center, size in boxes:
            corners = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), axis=-1).reshape(-1, 3) * size
            corners = center + corners @ np.stack([left, [0.0, 1.0, 0.0], towards])
            if is_nearer(center, middle, camera):
                found[i] |= drawn(camera, corners, found.shape[1:])
    return found


def body_of(photos: Capture) -> Float[np.ndarray, "n 3"]:
    """Returns the vertices of the body in the pose of the photos, metres."""
    return np.asarray(posed_vertices(photos.body, jnp.asarray(photos.betas), photos.poses))[0]


def cameras(photos: Capture) -> list[Camera]:
    """Returns the cameras of photos as a list."""
    return [photos.cameras[i] for i in range(photos.view_count)]


def is_nearer(point: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"], camera: Camera) -> bool:
    """Whether a point is at least 0.2 metres nearer to a camera than another point."""
    axis = np.asarray(camera.cam_from_world)[2, :3]
    return bool(axis @ (point - other) < -0.2)


def drawn(
    camera: Camera, corners: Float[np.ndarray, "8 3"], shape: tuple[int, ...]
) -> Bool[np.ndarray, "h w"]:
    """Returns the pixels of a box with these corners in an image of this shape."""
    from PIL import Image, ImageDraw

    matrix = np.asarray(camera.cam_from_world, float)
    seen = corners @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = (seen / seen[:, 2:] @ np.asarray(camera.K, float).T)[:, :2] - 0.5
    outline = pixels[ConvexHull(pixels).vertices]
    image = Image.new("L", (shape[1], shape[0]))
    ImageDraw.Draw(image).polygon(outline.ravel().tolist(), fill=1)
    return np.asarray(image) > 0


def covered_vertices(
    body: BodyModel, photos: Capture, others: Capture, covered: Bool[np.ndarray, "v h w"]
) -> Bool[np.ndarray, "w h w"]:
    """Returns the pixels of other views that show a part of the body which is covered in a photo.

    The part is that of the nearest visible vertex. It is covered if a photo would show the vertex,
    and has a covered pixel there or beside.
    """
    vertices = body_of(photos)
    size = photos.images.shape[1]
    hidden = np.zeros(len(vertices), bool)
    quality = np.asarray(view_quality(body, to_network_views(photos, size)))
    near = [ndimage.binary_dilation(each) for each in covered]
    for i, camera in enumerate(cameras(photos)):
        x, y = projected(camera, vertices).astype(int).clip(0, size - 1).T
        hidden |= (quality[i] > 0) & near[i][y, x]
    assert others.masks is not None
    shown = np.zeros(others.masks.shape, bool)
    quality = np.asarray(view_quality(body, to_network_views(others, size)))
    for i, camera in enumerate(cameras(others)):
        visible = np.flatnonzero(quality[i] > 0)
        rows, columns = np.nonzero(others.masks[i] > 0.5)
        tree = KDTree(projected(camera, vertices[visible]))
        nearest = tree.query(np.stack([columns, rows], axis=-1) + 0.5)[1]
        shown[i, rows, columns] = hidden[visible[nearest]]
    return shown


def projected(camera: Camera, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Returns the pixels at which a camera sees points."""
    matrix = np.asarray(camera.cam_from_world, float)
    seen = points @ matrix[:3, :3].T + matrix[:3, 3]
    return (seen / seen[:, 2:] @ np.asarray(camera.K, float).T)[:, :2]
