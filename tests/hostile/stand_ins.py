# ruff: noqa: E402
"""What stands in for work that takes minutes (fits, reconstruction, rendering, training steps), and
the inputs of all commands.

Imports everything that a command may need, for the process that is forked. Nothing here may start a
backend of JAX: its threads would not survive.
"""

import dataclasses
import importlib
import os
import pickle
import sys
from pathlib import Path
from types import SimpleNamespace

HERE = Path(__file__).resolve().parent
sys.path[:0] = [
    str(HERE),
    *(str(HERE.parent / name) for name in ("network", "capture", "data/datasets", "")),
]
os.environ |= {"JAX_PLATFORMS": "cpu", "TF_CPP_MIN_LOG_LEVEL": "2"}

import jax
import jax.numpy as jnp
import numpy as np
from dataset_files import write_avatarrex, write_model
from honest_files import write_import

from humangs_jax.apps.quick_check import Faults
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, shape_body
from humangs_jax.capture.fitting.files import FitRecord
from humangs_jax.capture.fitting.refine import RefinedCapture
from humangs_jax.capture.fitting.report import FitReport
from humangs_jax.capture.keypoints.keypoints import COCO_17, Keypoints
from humangs_jax.core.configuration import config_to_json
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture, save_capture
from humangs_jax.evaluation.scores import Scores, score_names
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.arrays import write_npz
from humangs_jax.network.presets import tiny
from humangs_jax.network.weights import expected_variables
from humangs_jax.refinement.refine import Refinement
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splatting import Rendering
from humangs_jax.training import config
from humangs_jax.training.forward import METRICS

HEAVY = (
    *("apps.check", "apps.demo", "avatar.frames", "avatar.layers", "avatar.video"),
    *(
        "capture.calibration.importing",
        "synthetic.writer",
        "refinement.refine",
        "training.diagnose",
        "viewer.page",
    ),
    *("capture.fitting.fit_capture", "capture.fitting.refine", "network.conversion"),
)
LATE = (
    "orbax.checkpoint",
    "tensorboardX",
    "OpenEXR",
    "safetensors.numpy",
    "plyfile",
    "imageio_ffmpeg",
    "tqdm",
)
for name in (*LATE, *(f"humangs_jax.{name}" for name in ("cli", *HEAVY))):
    importlib.import_module(name)
WORK = {
    *(
        "reconstruct",
        "refine_with_report",
        "motion_frames",
        "images",
        "draw",
        "fit_photos",
        "refine_capture",
    ),
    *("load_checkpoint", "make_subject", "train_step"),
}
"""Stand-ins for what takes long: nothing that is wrong with the place may be found only after
these.
"""


def random_of(variant, *more):
    return np.random.default_rng([variant, *more])


def some_avatar(variant, count=60):
    body, random = load_body(), random_of(variant)
    rest = shape_body(body, jnp.zeros(body.shape_directions.shape[-1]))
    chosen = np.linspace(0, len(rest.vertices) - 1, count).astype(int)
    number = lambda x: jnp.asarray(x, jnp.float32)
    gaussians = Gaussians(
        means=rest.vertices[chosen],
        quats=number(np.tile([1.0, 0, 0, 0], (count, 1))),
        scales=number(np.full((count, 3), 0.02)),
        opacities=number(np.full(count, 0.9)),
        colors=number(random.random((count, 3))),
    )
    weights = body.skinning_weights[chosen]
    return Avatar(
        gaussians, weights, rest.vertices, rest.joints, body.faces, body.parents, body.joint_names
    )


def some_renderings(variant, count, size=16):
    random = random_of(variant)
    image = lambda *shape: jnp.asarray(random.random((size, size, *shape)), jnp.float32)
    return [Rendering(image(3), image(), image(), jnp.zeros((), jnp.int32)) for _ in range(count)]


def some_cameras(count, size=16):
    K = jnp.asarray([[20.0, 0, size / 2], [0, 20, size / 2], [0, 0, 1]])
    pose = jnp.asarray([[1.0, 0, 0, 0], [0, -1, 0, 0.9], [0, 0, -1, 2.6], [0, 0, 0, 1]])
    return Camera(jnp.stack([K] * count), jnp.stack([pose] * count), size, size)


def some_capture(variant, views=6, size=32):
    body, random, cameras = load_body(), random_of(variant, 1), some_cameras(views, size)
    masks = np.zeros((views, size, size), np.float32)
    masks[:, 4:-4, 8:-8] = 1
    images = np.where(masks[..., None] > 0, random.random((views, size, size, 3)), 1.0).astype(
        np.float32
    )
    rotations = 0.01 * random.normal(size=(1, len(body.parents), 3))
    return Capture(
        images=np.rint(255 * images) / np.float32(255),
        masks=masks,
        cameras=cameras,
        frames=np.zeros(views, np.int32),
        body=body,
        betas=np.zeros(body.shape_directions.shape[-1], np.float32),
        poses=BodyPose(jnp.asarray(rotations, jnp.float32), jnp.zeros((1, 3))),
        names=tuple(f"{i:03d}" for i in range(views)),
    )


def some_record(variant, names):
    random = random_of(variant, 2)
    keypoints = Keypoints(
        32 * random.random((len(names), 17, 2)), np.full((len(names), 17), 0.9), COCO_17
    )
    return FitRecord(
        keypoints, tuple(names), np.ones(1), np.ones((1, 55)), np.ones((1, 55)), np.eye(3)
    )


def some_variables():
    """Zeros of the shapes of the preset `tiny`."""
    return pickle.loads((Path(os.environ["KILLS_INPUTS"]) / "variables.pkl").read_bytes())


def stand_ins(variant):
    """What is patched: (module, name, replacement)."""
    drawn = lambda count, size=16: (
        some_cameras(count, size),
        some_renderings(variant, count, size),
    )
    moved = lambda capture: replace(capture, betas=np.full_like(capture.betas, variant / 8))
    frames = lambda *_, **__: iter([np.asarray(r.rgb) for r in some_renderings(variant, 3)])

    def refined(capture, **_):
        found = some_cameras(capture.view_count, 32).K  # whatever the start was
        cameras = replace(
            capture.cameras, K=found + jnp.asarray([[0, 0, variant / 8], [0, 0, 0], [0, 0, 0]])
        )
        return RefinedCapture(replace(moved(capture), cameras=cameras), FitReport("refinement"))

    def person(seed, _body):
        return SimpleNamespace(seed=seed, betas=np.zeros(3, np.float32))

    def posed(subject, index):
        random = random_of(subject.seed, index)
        return SimpleNamespace(
            subject=subject,
            vertices=random.normal(size=(50, 3)).astype(np.float32),
            rotations=np.zeros((len(load_body().parents), 3), np.float32),
            translation=np.zeros(3, np.float32),
        )

    def views_of(subject, body, poses, views):
        capture = some_capture(subject.seed, len(views), 128)
        return dataclasses.replace(capture, names=tuple(view.name for view in views))

    def step(state, *_, **__):
        numbers = {"loss": 1.0, "psnr": 20.0, "grad_norm": 1.0, "learning_rate": 0.1}
        metrics = {name: jnp.asarray(value) for name, value in numbers.items()}
        params = jax.tree.map(lambda x: x + 1, state.params)
        metrics |= {"skipped": state.opt_state.skipped, "nonfinite": state.opt_state.nonfinite}
        return replace(state, step=state.step + 1, params=params), metrics

    def state(config, variables=None):
        return importlib.import_module("humangs_jax.training.state").init_state(
            config, some_variables()
        )

    def validated(_variables, _body, examples, *_):
        return dict.fromkeys(METRICS, 20.0), [
            np.asarray(example.targets.images) for example in examples
        ]

    def shown(vertices, faces, tints, camera):
        image = random_of(variant, 3).random((camera.height, camera.width))
        return SimpleNamespace(shaded=np.repeat(image[..., None], 3, -1), covered=image > 0.5)

    def fitted(photos, *_, **__):
        record = some_record(variant, photos.names)
        capture = moved(some_capture(0, len(photos.names), 32))
        count = 1 + int(np.max(photos.frames))
        poses = jax.tree.map(lambda x: jnp.repeat(x, count, axis=0), capture.poses)
        capture = replace(capture, frames=np.asarray(photos.frames, np.int32), poses=poses)
        return SimpleNamespace(
            capture=capture, record=record, report=FitReport("keypoints"), camera_errors=()
        )

    def converted(*_):
        return SimpleNamespace(variables=some_variables(), config=tiny(), skipped=1)

    def scored(images, _truth, rules, *_):
        return [dict.fromkeys(score_names(rules), variant / 8) for _ in images]

    avatar = lambda *_, **__: Avatar.load(Path(os.environ["KILLS_INPUTS"]) / f"avatar{variant}.npz")
    return {
        "avatar.reconstruct.reconstruct": avatar,
        "network.weights.load_weights": lambda *_: (None, tiny()),
        "refinement.refine.refine_with_report": lambda *_, **__: Refinement(
            avatar(), 2, 1, 1.0, 0.0, (1.0, 0.5), (20.0, 21.0), True
        ),
        "avatar.frames.images": frames,
        "avatar.frames.motion_views": lambda *_: (None, None),
        "avatar.frames.turntable_views": lambda _avatar, _pose, views, _shot: (
            [None] * views,
            some_cameras(views),
        ),
        "avatar.layers.draw": lambda _, poses, *__: iter(some_renderings(variant, len(poses))),
        "capture.detection.people.available": lambda: False,
        "apps.check._body_image": shown,
        "apps.check.faults": lambda capture: Faults(
            (), (None,) * capture.view_count, (1.0,) * capture.view_count, set()
        ),
        "apps.check._posed_frames": lambda capture, *_: dict.fromkeys(
            map(int, capture.frames), np.zeros((4, 3))
        ),
        "apps.start.better_body": lambda _weights, _config, loose, *_: (loose, None),
        "apps.demo.load_weights": lambda *_: (None, tiny()),
        "apps.demo.reconstruct": avatar,
        "apps.demo.animate": lambda avatar, _: avatar.gaussians,
        "apps.demo.capture_renderings": lambda _, truth, *__: drawn(
            truth.view_count, truth.cameras.width
        ),
        "apps.demo.score": lambda *_: Scores(20.0, 0.9, 20.0, 0.2),
        "apps.demo.painted_body": lambda _: None,
        "apps.demo.draw_painted_body": lambda *_: None,
        "apps.demo.motion_frames": frames,
        "evaluation.run.score_views": scored,
        "capture.fitting.fit_capture.fit_photos": fitted,
        "capture.fitting.refine.refine_capture": refined,
        "network.conversion.load_checkpoint": converted,
        "network.conversion.describe": lambda _: "a network",
        "losses.loss_networks.collect_loss_networks": lambda _: ({"x": np.ones(999)}, ["VGG-19"]),
        "synthetic.writer.make_subject": person,
        "synthetic.writer.sample_pose": posed,
        "synthetic.writer.capture_views": views_of,
        "synthetic.writer.cameras_around": lambda rng, vertices, azimuths, size: some_cameras(
            len(azimuths), size
        ),
        "training.loop.train_step": step,
        "training.loop.init_state": state,
        "training.loop.gaussian_body": lambda body, _: body,
        "training.loop.validate": validated,
    }


def make_inputs(inputs: Path) -> None:
    inputs.mkdir()
    zeros = jax.tree.map(
        lambda x: np.zeros(x.shape, np.float32), expected_variables(config.tiny().model)
    )
    (inputs / "variables.pkl").write_bytes(pickle.dumps(zeros))
    write_import(inputs)
    write_avatarrex(inputs / "videos" / "a", frames=1)
    write_model(inputs)
    save_capture(inputs / "capture", some_capture(0))
    for name in "ab":
        save_capture(inputs / "people" / name, some_capture(ord(name)))
    for variant in (1, 2):
        some_avatar(variant).save(inputs / f"avatar{variant}.npz")
    record = some_record(0, [f"{i:03d}" for i in range(6)])
    arrays = {
        "set": record.keypoints.set.name,
        "names": record.names,
        "points": record.keypoints.points,
    }
    write_npz(inputs / "keypoints.npz", arrays | {"confidences": record.keypoints.confidences})
    (inputs / "any.pt").write_bytes(b"")
    (inputs / "train.json").write_text(
        config_to_json(dataclasses.replace(config.tiny(), steps=6, checkpoint_every=2), indent=1)
    )
