"""Synthetic people in layouts of real data sets, on the package's body as an SMPL-X file."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from data.datasets.dataset_files import (
    ANGLES,
    AVATARREX,
    COLUMNS,
    THUMAN4,
    write_fit,
    write_folders,
    write_scan,
)
from scipy.spatial.transform import Rotation

from experiments.bodies import write_smplx
from humangs_jax.body.library import load_body
from humangs_jax.body.resolution import decimate
from humangs_jax.data.datasets.subject import BodyParameters, FileBody, posed_people, turned
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.io.images import to_uint8
from humangs_jax.synthetic.bank import bake_subject, lit_texture
from humangs_jax.synthetic.subject import SPLITS, describe, make_subject, pose_subject, render_view
from humangs_jax.synthetic.writer import sample_motion, sample_pose

DEMO = SPLITS["demo"]
SEEDS = (3_000_271, 3_000_584)
"""Seeds of the people, of the split "demo"."""
TIGHT = ("tank", "leggings", "socks")
"""Clothes of all of them, with short hair: the silhouette is close to that of the body."""
HANDS = slice(25, 40), slice(40, 55)
BACKGROUND = 0.45
"""Grey level of the room behind the people of videos."""


def write_body(path, people, body, hand_poses):
    """Writes the package's body as an SMPL-X model file; returns its arrays.

    Person i has the betas e_i. `hand_poses` (people, 2, 45) are in the span of 12 components.
    """
    # shapes, no expressions
    directions = np.zeros((len(body.template), 3, 2 * COLUMNS), np.float32)
    for i, person in enumerate(people):
        directions[..., i] = np.asarray(body.shape_directions) @ person.betas
    rng = np.random.default_rng(7)
    means = 0.2 * rng.normal(size=(2, 45))
    components = rng.normal(size=(2, 45, 45))
    for i, hands in enumerate(hand_poses):
        components[:, i] = hands - means  # person i's hands are component i
    more = {f"hands_mean{side}": means[i] for i, side in enumerate("lr")}
    more |= {f"hands_components{side}": components[i] for i, side in enumerate("lr")}
    return write_smplx(path, body, directions, **more)


def make_people(seeds, vertices=None):
    """Returns (synthetic people, body of the model file), with the body decimated to `vertices`."""
    body = load_body()
    people = [in_tight_clothes(seed, body) for seed in seeds]
    return people, body if vertices is None else decimate(body, vertices)


def in_tight_clothes(seed, body):
    """Returns the person of a seed with short hair and the `TIGHT` clothes of other people."""
    person, wanted, garments, haircut = describe(seed, body), set(TIGHT), {}, None
    for other in DEMO:
        seen = describe(other, body)
        for garment in seen.garments:
            if garment.kind in wanted:
                sizes = {
                    key: 0.0 if key == "loose" else size for key, size in garment.sizes.items()
                }
                garments[garment.kind] = dataclasses.replace(garment, sizes=sizes)
                wanted.discard(garment.kind)
        haircut = seen.haircut if haircut is None and seen.haircut.cut == "buzz" else haircut
        if not wanted and haircut is not None:
            break
    worn = tuple(garments[kind] for kind in TIGHT)
    return make_subject(seed, body, dataclasses.replace(person, garments=worn, haircut=haircut))


def placed(rotations, translations, world, arrays, i):
    """Returns the parameters of person i of a model file in another world."""
    shape = np.eye(2 * COLUMNS)[i]
    rest = arrays["v_template"] + arrays["shapedirs"] @ shape
    return turned(
        BodyParameters(shape, rotations, translations), world, arrays["J_regressor"][0] @ rest
    )


def random_rigid(rng):
    """Returns a random turn by up to a radian and a move by up to a metre, (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)).as_matrix()
    matrix[:3, 3] = rng.uniform(-1, 1, 3)
    return matrix


# THuman
# --------------------------------------------------------------------------------------------------


def write_thuman(out, seeds=SEEDS, kinds="AC", texture_size=1024, vertices=None):
    """Writes out/body.npz and out/thuman with a scan for each seed; returns the data set's folder.

    The world of each scan is turned, moved, and in other units. `kinds` are those of the fits.
    """
    people, small = make_people(seeds, vertices)
    posed = [sample_pose(person, 1) for person in people]
    hands = np.stack([[p.rotations[part].reshape(-1) for part in HANDS] for p in posed])
    arrays = write_body(out / "body.npz", people, small, hands)
    for i, (person, pose) in enumerate(zip(people, posed, strict=True)):
        name, rng = f"{i:04d}", np.random.default_rng(i)
        scale, matrix = float(rng.uniform(0.4, 2.0) * (100 if i % 2 else 1)), random_rigid(rng)
        baked = bake_subject(person, texture_size)
        points = scale * (pose.vertices @ matrix[:3, :3].T + matrix[:3, 3])[baked.atlas.vertices]
        scan = points, baked.atlas.faces, baked.atlas.uvs, lit_texture(pose, baked)
        write_scan(out / "thuman" / "model" / name, *scan)
        parameters = placed(
            pose.rotations[None].astype(float),
            pose.translation[None].astype(float),
            matrix,
            arrays,
            i,
        )
        fit = fit_values(parameters, kinds[i % len(kinds)], scale, arrays, i)
        mesh = (
            scale * next(posed_people(FileBody.load(out / "body.npz").model, parameters)).vertices
        )
        write_fit(out / "thuman" / "smplx" / name, fit, mesh, arrays["f"])
    return out / "thuman"


def fit_values(parameters, kind, scale, arrays, person):
    """Returns what THuman's smplx_param.pkl of this kind holds."""
    rotations, translation = parameters.rotations[0].reshape(-1), parameters.translations[0]
    values, at = {}, 0
    for key, size in ANGLES.items():
        values[key], at = rotations[None, at : at + size], at + size
    for side, name in enumerate(("left", "right")):
        hand = rotations[at + 45 * side : at + 45 * (side + 1)] - arrays[f"hands_mean{name[0]}"]
        values[f"{name}_hand_pose"] = (np.eye(12)[person] if kind == "A" else hand)[None]
    values |= {
        "betas": parameters.betas[None, :COLUMNS],
        "expression": parameters.betas[None, COLUMNS:],
    }
    values["scale"] = np.asarray([scale])
    values["transl" if kind == "C" else "translation"] = (
        translation if kind == "C" else scale * translation
    )[None]
    return {key: np.asarray(value, np.float32) for key, value in values.items()}


# Videos
# --------------------------------------------------------------------------------------------------


class Video:
    """A `Recording` of a moving person by cameras around; makes out/body.npz.

    The recording's world is turned against ours, as after a calibration. `posed` and `cameras` are
    in ours.
    """

    def __init__(self, out, seed=SEEDS[0], frames=3, cameras=4, size=(150, 204), vertices=None):
        people, small = make_people([seed], vertices)
        motion = sample_motion(people[0], 30, "walk")
        rows = np.linspace(0, 29, frames).round().astype(int)
        rotations, translations = (
            np.asarray(x, np.float64)[rows] for x in (motion.rotations, motion.translations)
        )
        rotations[:, 23:25] = 0  # the layouts hold no eyes
        arrays = write_body(out / "body.npz", people, small, rotations[:1, 25:].reshape(1, 2, 45))
        world = random_rigid(np.random.default_rng(seed))
        body = placed(rotations, translations, world, arrays, 0)
        number = lambda x: np.asarray(x, np.float32)
        self.posed = [
            pose_subject(people[0], number(r), number(t))
            for r, t in zip(rotations, translations, strict=True)
        ]
        self.size, self.frames = size, frames
        self.cameras = self._around(cameras)
        poses = np.stack([np.asarray(camera.cam_from_world, np.float64) for camera in self.cameras])
        poses = poses @ np.linalg.inv(world)
        self.R, self.T = poses[:, :3, :3], poses[:, :3, 3]
        self.K = np.array(self.cameras[0].K, np.float64)
        self.K[:2, 2] -= 0.5
        angles = body.rotations.reshape(frames, -1)
        parts = {"global_orient": slice(0, 3), "body_pose": slice(3, 66), "jaw_pose": slice(66, 69)}
        parts |= {"left_hand_pose": slice(75, 120), "right_hand_pose": slice(120, None)}
        parameters = {key: angles[:, part] for key, part in parts.items()} | {
            "transl": body.translations
        }
        parameters |= {
            "betas": np.tile(body.betas[:COLUMNS], (frames, 1)),
            "expression": np.zeros((frames, COLUMNS)),
        }
        self.parameters = {key: number(x) for key, x in parameters.items()}

    def _around(self, count):
        low = np.stack([p.vertices.min(0) for p in self.posed]).min(0)
        high = np.stack([p.vertices.max(0) for p in self.posed]).max(0)
        reach = 1.3 * float(np.linalg.norm(high - low))
        azimuths = jnp.asarray(np.arange(count) * 2 * np.pi / count, jnp.float32)
        K = intrinsics_from_fov(0.7, *self.size)
        return list(orbit(jnp.asarray((low + high) / 2), reach, azimuths, 0.1, K, *self.size))

    def shot(self, camera, frame):
        return [
            to_uint8(x) for x in render_view(self.posed[frame], self.cameras[camera], BACKGROUND)
        ]


def write_avatarrex(out, **how):
    """Writes out/body.npz and out/avatarrex_zzr with photos of every 10th frame.

    Returns the subject's folder; `how` are arguments of `Video`.
    """
    video = Video(out, **how)
    serials = [f"220{i:05d}" for i in range(len(video.cameras))]
    return write_folders(out / "avatarrex_zzr", video, serials, *AVATARREX, every=10)


def write_thuman4(out, size=(166, 144), **how):
    """Writes out/body.npz and out/subject00, of which one photo is listed as missing.

    Returns the subject's folder; `how` are arguments of `Video`.
    """
    video = Video(out, size=size, **how)
    names, last = [f"cam{i:02d}" for i in range(len(video.cameras))], len(video.posed) - 1
    folder = write_folders(out / "subject00", video, names, *THUMAN4)
    (folder / "images" / names[-1] / f"{last:08d}.jpg").unlink()
    (folder / "missing_img_files.txt").write_text(f"images\\{names[-1]}\\{last:08d}.jpg\n")
    return folder


WRITERS = {"thuman": write_thuman, "avatarrex": write_avatarrex, "thuman4": write_thuman4}
