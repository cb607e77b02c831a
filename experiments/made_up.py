"""Synthetic people in the layouts of real data sets, with the package's body as an SMPL-X file."""

import csv
import dataclasses
import importlib
import io
import json
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from experiments.bodies import write_smplx
from experiments.harness import Run, entry
from humangs_jax.body.library import load_body
from humangs_jax.body.resolution import decimate
from humangs_jax.data.datasets.subject import BodyParameters, FileBody, posed_people, turned
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.io.images import to_uint8
from humangs_jax.people.bank import bake_subject, lit_texture
from humangs_jax.people.subject import DEMO, describe, make_subject, pose_subject, render_view
from humangs_jax.people.writer import sample_motion, sample_pose

SEEDS = (3_000_271, 3_000_584)
"""People who are written, of the split "demo"."""
TIGHT = ("tank", "leggings", "socks")
"""What all of them wear, with short hair: close to the skin, so that the body's silhouette tells whether it stands in its
place."""
HANDS = slice(25, 40), slice(40, 55)
COLUMNS = 10
"""Shape directions, and as many of expression, of an old SMPL-X file."""
BACKGROUND = 0.45
"""Grey of the room behind the people of videos."""


def write_body(path: Path, people: Sequence[Any], body: Any, hand_poses: np.ndarray) -> dict[str, np.ndarray]:
    """The package's body as an SMPL-X model file, in which person i has betas e_i, and its arrays.

    hand_poses: (people, 2, 45) that 12 components reach.
    """
    directions = np.zeros((len(body.template), 3, 2 * COLUMNS), np.float32)  # shapes, no expressions
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


def make_people(seeds: Sequence[int], vertices: int | None = None) -> tuple[list[Any], Any]:
    """Synthetic people, and the body of the model file: that which they are made of, decimated to `vertices`."""
    body = load_body()
    return [in_tight_clothes(seed, body) for seed in seeds], body if vertices is None else decimate(body, vertices)


def in_tight_clothes(seed: int, body: Any) -> Any:
    """The person of a seed in `TIGHT` clothes of other people of the documentation, with hair that is buzzed."""
    person, wanted, garments, haircut = describe(seed, body), set(TIGHT), {}, None
    for other in DEMO:
        seen = describe(other, body)
        for garment in seen.garments:
            if garment.kind in wanted:
                sizes = {key: 0.0 if key == "loose" else size for key, size in garment.sizes.items()}
                garments[garment.kind] = dataclasses.replace(garment, sizes=sizes)
                wanted.discard(garment.kind)
        haircut = seen.haircut if haircut is None and seen.haircut.cut == "buzz" else haircut
        if not wanted and haircut is not None:
            break
    assert haircut is not None and not wanted  # there are a thousand people
    worn = tuple(garments[kind] for kind in TIGHT)
    return make_subject(seed, body, dataclasses.replace(person, garments=worn, haircut=haircut))


def placed(rotations: np.ndarray, translations: np.ndarray, world: np.ndarray, arrays: dict[str, np.ndarray], i: int) -> Any:
    """Parameters of person i of a model file in another world."""
    shape = np.eye(2 * COLUMNS)[i]
    rest = arrays["v_template"] + arrays["shapedirs"] @ shape
    return turned(BodyParameters(shape, rotations, translations), world, arrays["J_regressor"][0] @ rest)


# THuman ---------------------------------------------------------------------------------------------------------------


def write_thuman(
    out: Path, seeds: Sequence[int] = SEEDS, kinds: Sequence[str] = "AC", texture_size: int = 1024, vertices: Any = None
) -> Path:
    """out/body.npz and out/thuman with a scan for each seed, fits of these kinds; returns the data set.

    Scans stand in a world of their own: turned, moved, and in other units for each person.
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
        folder = out / "thuman" / "model" / name
        write_scan(folder, name, points, baked.atlas.uvs, baked.atlas.faces, lit_texture(pose, baked))
        parameters = placed(pose.rotations[None].astype(float), pose.translation[None].astype(float), matrix, arrays, i)
        fit = fit_values(parameters, kinds[i % len(kinds)], scale, arrays, i)
        mesh = scale * next(posed_people(FileBody.load(out / "body.npz").model, parameters)).vertices
        write_fit(out / "thuman" / "smplx" / name, fit, mesh, arrays["f"])
    return out / "thuman"


def random_rigid(rng: np.random.Generator) -> np.ndarray:
    """A turn by up to a radian about any axis, and up to a metre."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)).as_matrix()
    matrix[:3, 3] = rng.uniform(-1, 1, 3)
    return matrix


def fit_values(parameters: Any, kind: str, scale: float, arrays: dict[str, np.ndarray], person: int) -> dict[str, Any]:
    """What smplx_param.pkl of that kind holds, as THuman writes it."""
    rotations, translation = parameters.rotations[0].reshape(-1), parameters.translations[0]
    names = {"global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3}
    values, at = {}, 0
    for key, size in names.items():
        values[key], at = rotations[None, at : at + size], at + size
    for side, name in enumerate(("left", "right")):
        hand = rotations[at + 45 * side : at + 45 * (side + 1)] - arrays[f"hands_mean{name[0]}"]
        values[f"{name}_hand_pose"] = (np.eye(12)[person] if kind == "A" else hand)[None]
    values |= {"betas": parameters.betas[None, :COLUMNS], "expression": parameters.betas[None, COLUMNS:]}
    values["scale"] = np.asarray([scale])
    values["transl" if kind == "C" else "translation"] = (translation if kind == "C" else scale * translation)[None]
    return {key: np.asarray(value, np.float32) for key, value in values.items()}


def write_fit(folder: Path, values: dict[str, Any], mesh: np.ndarray, faces: np.ndarray) -> None:
    """smplx_param.pkl and mesh_smplx.obj."""
    folder.mkdir(parents=True)
    (folder / "smplx_param.pkl").write_bytes(pickle.dumps(values, protocol=4))
    lines = [f"v {x:.8g} {y:.8g} {z:.8g}" for x, y, z in mesh.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces.astype(int) + 1).tolist()]
    (folder / "mesh_smplx.obj").write_text("\n".join(lines) + "\n")


def write_scan(folder: Path, name: str, points: np.ndarray, uvs: np.ndarray, faces: np.ndarray, texture: np.ndarray) -> None:
    """NAME.obj, material0.mtl and material0.jpeg."""
    folder.mkdir(parents=True)
    lines = ["mtllib material0.mtl"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in points.tolist()]
    lines += [f"vt {u:.7g} {v:.7g}" for u, v in uvs.tolist()]
    lines.append("usemtl material0")
    lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in (np.asarray(faces, int) + 1).tolist()]
    (folder / f"{name}.obj").write_text("\n".join(lines) + "\n")
    (folder / "material0.mtl").write_text("newmtl material0\nKd 1 1 1\nmap_Kd material0.jpeg\n")
    Image.fromarray(texture).save(folder / "material0.jpeg", quality=95)


# Videos ---------------------------------------------------------------------------------------------------------------


class Video:
    """A person who moves, seen by cameras around; in a world that is turned against ours, as calibrations leave it.

    parameters: of the model file in that world. cameras: ours; K (3, 3), R (c, 3, 3), T (c, 3) that a calibration has.
    """

    def __init__(
        self,
        out: Path,
        seed: int = SEEDS[0],
        frames: int = 3,
        cameras: int = 4,
        size: tuple[int, int] = (150, 204),
        vertices: int | None = None,
    ):
        people, small = make_people([seed], vertices)
        motion = sample_motion(people[0], 30, "walk")
        rows = np.linspace(0, 29, frames).round().astype(int)
        rotations, translations = (np.asarray(x, np.float64)[rows] for x in (motion.rotations, motion.translations))
        rotations[:, 23:25] = 0  # the layouts hold no eyes
        hands = rotations[:1, 25:].reshape(1, 2, 45)
        arrays = write_body(out / "body.npz", people, small, hands)
        world = random_rigid(np.random.default_rng(seed))
        self.parameters = placed(rotations, translations, world, arrays, 0)
        number = lambda x: np.asarray(x, np.float32)
        self.posed = [pose_subject(people[0], number(r), number(t)) for r, t in zip(rotations, translations, strict=True)]
        self.cameras = self._around(cameras, size)
        poses = np.stack([np.asarray(camera.cam_from_world, np.float64) for camera in self.cameras])
        poses = poses @ np.linalg.inv(world)
        self.R, self.T = poses[:, :3, :3], poses[:, :3, 3]
        self.K = np.asarray(self.cameras[0].K, np.float64)

    def _around(self, count, size):
        low = np.stack([p.vertices.min(0) for p in self.posed]).min(0)
        high = np.stack([p.vertices.max(0) for p in self.posed]).max(0)
        width, height = size
        reach = 1.3 * float(np.linalg.norm(high - low))
        azimuths = jnp.asarray(np.arange(count) * 2 * np.pi / count, jnp.float32)
        return list(orbit(jnp.asarray((low + high) / 2), reach, azimuths, 0.1, intrinsics_from_fov(0.7, *size), width, height))

    def write(self, place: Callable[[int, int], tuple[Path, ...]], background: float = BACKGROUND):
        """Photos and masks at place(camera, frame)."""
        for c, camera in enumerate(self.cameras):
            for f, posed in enumerate(self.posed):
                image, mask = render_view(posed, camera, background)
                for path, pixels in zip(place(c, f), (image, mask), strict=True):
                    path.parent.mkdir(parents=True, exist_ok=True)
                    Image.fromarray(to_uint8(pixels)).save(path, quality=95)

    def calibration(self, names: Sequence[str]) -> dict[str, Any]:
        """calibration.json: OpenCV's convention, pixel centres at whole numbers."""
        K = self.K.copy()
        K[:2, 2] -= 0.5
        size = [self.cameras[0].width, self.cameras[0].height]
        flat = lambda x: np.asarray(x).reshape(-1).tolist()
        return {
            name: {"K": flat(K), "R": flat(R), "T": flat(T), "imgSize": size}
            for name, R, T in zip(names, self.R, self.T, strict=True)
        }

    def write_parameters(self, path: Path, every: int = 1) -> None:
        """smpl_params.npz. every: 10 means photos of rows 0, 10, 20; the rows between repeat the pose."""
        rows = np.repeat(np.arange(len(self.parameters.rotations)), every)
        rotations = self.parameters.rotations[rows].reshape(len(rows), -1)
        arrays = {
            "global_orient": rotations[:, :3],
            "body_pose": rotations[:, 3:66],
            "jaw_pose": rotations[:, 66:69],
            "left_hand_pose": rotations[:, 75:120],
            "right_hand_pose": rotations[:, 120:],
            "transl": self.parameters.translations[rows],
            "betas": np.tile(self.parameters.betas[:COLUMNS], (len(rows), 1)),
            "expression": np.zeros((len(rows), COLUMNS)),
        }
        np.savez(path, **{key: value.astype(np.float32) for key, value in arrays.items()})  # ty: ignore[invalid-argument-type]


def write_avatarrex(out: Path, **how: Any) -> Path:
    """out/body.npz and out/avatarrex_zzr with photos of every 10th frame; returns the subject's folder. how: of a `Video`."""
    video, folder = Video(out, **how), out / "avatarrex_zzr"
    serials = [f"220{i:05d}" for i in range(len(video.cameras))]
    place = lambda c, f: tuple(folder / serials[c] / part / f"{10 * f:08d}.jpg" for part in ("", "mask/pha"))
    video.write(place)
    (folder / "calibration_full.json").write_text(json.dumps(video.calibration(serials)))
    video.write_parameters(folder / "smpl_params.npz", every=10)
    return folder


def write_thuman4(out: Path, size: tuple[int, int] = (166, 144), **how: Any) -> Path:
    """out/body.npz and out/subject00, a photo of which is listed as missing; returns the subject's folder. how: of a `Video`."""
    video, folder = Video(out, size=size, **how), out / "subject00"
    names, last = [f"cam{i:02d}" for i in range(len(video.cameras))], len(video.posed) - 1
    video.write(lambda c, f: tuple(folder / kind / names[c] / f"{f:08d}.jpg" for kind in ("images", "masks")))
    (folder / "images" / names[-1] / f"{last:08d}.jpg").unlink()
    (folder / "missing_img_files.txt").write_text(f"images\\{names[-1]}\\{last:08d}.jpg\n")
    (folder / "calibration.json").write_text(json.dumps(video.calibration(names)))
    video.write_parameters(folder / "smpl_params.npz")
    return folder


def write_actorshq(out: Path, **how: Any) -> Path:
    """out/body.npz and out/Actor01/Sequence1 at scale 4x; returns the sequence's folder. how: of a `Video`."""
    video, folder = Video(out, **how), out / "Actor01" / "Sequence1"
    names = [f"Cam{i + 1:03d}" for i in range(len(video.cameras))]

    def place(c: int, f: int) -> tuple[Path, Path]:
        photo = folder / "4x" / "rgbs" / names[c] / f"{names[c]}_rgb{f:06d}.jpg"
        return photo, folder / "4x" / "masks" / names[c] / f"{names[c]}_mask{f:06d}.png"

    video.write(place, background=0.0)
    width, height = video.cameras[0].width, video.cameras[0].height
    with open(folder / "4x" / "calibration.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py"])
        for name, R, T in zip(names, video.R, video.T, strict=True):
            turn, center = Rotation.from_matrix(R.T).as_rotvec(), -R.T @ T
            K = video.K
            inner = K[0, 0] / width, K[1, 1] / height, K[0, 2] / width, K[1, 2] / height
            table.writerow([name, width, height, *turn.tolist(), *center.tolist(), *map(float, inner)])
    video.write_parameters(folder / "smpl_params.npz")
    return folder


def write_dna(out: Path, **how: Any) -> Path:
    """out/body.npz and out/dna with main/0001_01.smc and its annotations; returns the data set. Needs h5py. how: of a `Video`."""
    h5py: Any = importlib.import_module("h5py")
    video, folder = Video(out, **how), out / "dna"
    means = np.load(out / "body.npz")
    for part in ("main", "annotations"):
        (folder / part).mkdir(parents=True)

    def encoded(pixels: np.ndarray, kind: str) -> np.ndarray:
        stream = io.BytesIO()
        Image.fromarray(to_uint8(pixels)).save(stream, kind, quality=95)
        return np.frombuffer(stream.getvalue(), np.uint8)

    with (
        h5py.File(folder / "main" / "0001_01.smc", "w") as main,
        h5py.File(folder / "annotations" / "0001_01_annots.smc", "w") as notes,
    ):
        main.attrs["gender"], main.attrs["actor_id"] = "male", "0001"
        for c, camera in enumerate(video.cameras):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = video.R[c], video.T[c]
            K = video.K.copy()
            K[:2, 2] -= 0.5
            inner = {"K": K, "D": np.zeros(5), "RT": np.linalg.inv(pose), "Color_Calibration": np.eye(3)}
            for key, value in inner.items():
                notes[f"Camera_Parameter/{c:02d}/{key}"] = value
            for f, posed in enumerate(video.posed):
                image, mask = render_view(posed, camera, BACKGROUND)
                main[f"Camera_5mp/{c}/color/{f}"] = encoded(image, "JPEG")
                notes[f"Mask/{c}/mask/{f}"] = encoded(mask, "PNG")
        rotations = video.parameters.rotations.copy()
        rotations[:, 25:40] -= means["hands_meanl"].reshape(15, 3)
        rotations[:, 40:] -= means["hands_meanr"].reshape(15, 3)
        values = {
            "fullpose": rotations,
            "transl": video.parameters.translations,
            "betas": np.tile(video.parameters.betas[:COLUMNS], (len(rotations), 1)),
            "expression": np.zeros((len(rotations), COLUMNS)),
            "scale": np.ones(1),
        }
        for key, value in values.items():
            notes[f"SMPLx/{key}"] = value.astype(np.float32)
    return folder


WRITERS: dict[str, Callable[..., Path]] = {
    "thuman": write_thuman,
    "avatarrex": write_avatarrex,
    "thuman4": write_thuman4,
    "actorshq": write_actorshq,
    "dna": write_dna,
}


@entry
def made_up(run: Run, layouts: tuple[str, ...], out: Path = Path("made_up"), people: int = 2) -> None:
    """Writes synthetic people in the layouts of real data sets.

    Options:
    layouts: of thuman, avatarrex, thuman4, actorshq, dna
    out: folder of one folder for each layout
    people: scans of thuman
    """
    if unknown := set(layouts) - set(WRITERS):
        raise ValueError(f"{unknown.pop()}: expected some of {', '.join(WRITERS)}")
    for layout in layouts:
        options = {"seeds": range(SEEDS[0], SEEDS[0] + people)} if layout == "thuman" else {}
        print(WRITERS[layout](out / layout, **options))
