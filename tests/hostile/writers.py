"""Every command that writes, whole and real but for what it computes: each run is a process of its own, made by a fork.

A process that has imported everything and started no backend of JAX is forked, so that a run takes a second instead of ten.
What costs minutes (fits, reconstruction, rendering, training steps) is answered by stand-ins at once; options, checks, readers,
writers, the training loop and its checkpoints are the package's own. A run tells the files that it changes, and can be killed
at any of these moments.
"""

import contextlib
import dataclasses
import fnmatch
import hashlib
import importlib
import json
import os
import re
import resource
import select
import shutil
import signal
import sys
import time
import traceback
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

HERE = Path(__file__).resolve().parent
SECONDS = 300
"""Longest that a run may take on a busy machine."""
HEAVY = (
    *("apps.check", "apps.demo", "apps.settings", "avatar.frames", "avatar.layers", "avatar.video"),
    *("data.calibration.importing", "people.writer", "refinement.refine", "training.diagnose", "viewer.page"),
    *("fitting.examination", "fitting.fit_capture", "fitting.refine", "fitting.scan_views", "network.conversion"),
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
WORK = {
    *("reconstruct", "refine_with_report", "motion_frames", "images", "draw", "fit_photos", "refine_capture"),
    *("fit_scan", "load_checkpoint", "make_subject", "train_step", "build_bank", "tune"),
}
"""Stand-ins for what takes long: nothing that is wrong with the place may be found only after these."""
CHANGES = {
    "open": (),
    "os.rename": (2, 3),
    "os.remove": (1,),
    "os.mkdir": (2,),
    "os.rmdir": (1,),
    "subprocess.Popen": (),
}
"""Events of Python that change files, and which of their arguments are descriptors of folders."""


@dataclasses.dataclass(frozen=True)
class Command:
    """arguments: with {inputs} for the folder of inputs and {v} for 1 or 2, the number of the variant.

    copies: inputs that are copied into the place first. first: arguments of the run that made what is there before, None for
    nothing. varies: files that no two runs write equally, as patterns; `own`: those whose names differ, too; `often`: those
    that one run writes several times. once: it refuses a place where it has come to its end.
    """

    name: str
    arguments: str
    copies: tuple[str, ...] = ()
    first: str | None = ""
    varies: tuple[str, ...] = ()
    own: tuple[str, ...] = ()
    often: tuple[str, ...] = ()
    once: bool = False

    def words(self, inputs: Path, variant: int) -> list[str]:
        text = self.first if variant == 1 and self.first else self.arguments
        return [word.format(inputs=inputs, v=variant) for word in text.split()]


CAPTURE = "--keypoints {inputs}/keypoints.npz --overwrite"
RUN = ("run/checkpoints/*", "run/tensorboard/*")
COMMANDS = (
    Command(
        "import", "import cameras {inputs}/transforms.json --images {inputs}/photos --out new --scale {v} --overwrite"
    ),
    Command("fit in place", f"fit capture {CAPTURE}", copies=("capture",)),
    Command("fit elsewhere", f"fit {{inputs}}/capture {CAPTURE} --out fitted"),
    Command("fit --refine", "fit capture --refine --overwrite", copies=("capture",)),
    Command("fit --scan", "fit --scan {inputs}/scan.obj --out body --overwrite"),
    Command("fit --scan --views", "fit --scan {inputs}/scan.obj --views views", first=None, once=True),
    Command("check", "check {inputs}/capture --out check.png"),
    Command("demo", "demo --out demo --refine 0 --size 16", varies=("demo/report.json",)),
    Command("reconstruct", "reconstruct {inputs}/capture --out me.npz --no-check"),
    Command("refine", "refine {inputs}/avatar1.npz {inputs}/capture --limit 1steps --out me.npz --no-check"),
    Command("tune", "tune {inputs}/capture --frame-ms 50 --out tuned.json"),
    Command("animate mp4", "animate {inputs}/avatar1.npz --out me.mp4 --size 16"),
    Command("animate gif", "animate {inputs}/avatar1.npz --out me.gif --size 16"),
    Command("render", "render {inputs}/avatar1.npz --out views --views 3 --size 16 --exr"),
    Command("render anew", "render {inputs}/avatar1.npz --out views --views 3 --size 16", first=None),
    Command("export ply", "export {inputs}/avatar{v}.npz --out me.ply"),
    Command("export splat", "export {inputs}/avatar{v}.npz --out me.splat"),
    Command("export glb", "export {inputs}/avatar{v}.npz --out me.glb"),
    Command("export html", "export {inputs}/avatar{v}.npz --html me.html"),
    Command(
        "synth",
        "synth --out people --subjects 2 --size 128 --views 2 --close-views 0 --workers 1 --held-out 1",
        first="synth --out people --subjects 1 --size 128 --views 2 --close-views 0 --workers 1 --held-out 1",
    ),
    Command(
        "train",
        "train {inputs}/people --out run --config {inputs}/train.json --validation {inputs}/people",
        first=None,
        varies=("run/log.jsonl",),
        own=RUN,
        often=("run/*.safetensors",),
    ),
    Command(
        "train --on-the-fly",
        "train --out run --on-the-fly 2 --config {inputs}/train.json",
        first=None,
        varies=("run/log.jsonl",),
        own=RUN,
        often=("run/*.safetensors",),
    ),
    Command(
        "start",
        "start {inputs}/photos --cameras {inputs}/transforms.json --keypoints {inputs}/keypoints.npz --out begun "
        "--without-masks --no-browser",
        first=None,
        often=("begun/capture.json",),
        once=True,
    ),
    Command(
        "preprocess",
        "preprocess avatarrex {inputs}/videos --out set --body {inputs}/SMPLX_TINY.npz --size 16 --every 1",
    ),
    Command(
        "evaluate",
        "evaluate {inputs}/capture --predictions {inputs}/capture/images --json a.json --html a.html --csv a.csv "
        "--markdown a.md --latex a.tex",
    ),
    Command("convert", "convert {inputs}/any.pt --out w.safetensors --losses l.safetensors"),
)


# Stand-ins ------------------------------------------------------------------------------------------------------------


def import_everything():
    """In the process that is forked. Nothing here may start a backend of JAX: its threads would not survive."""
    sys.path[:0] = [str(HERE), *(str(HERE.parent / name) for name in ("network", "data/datasets", ""))]
    os.environ |= {"JAX_PLATFORMS": "cpu", "TF_CPP_MIN_LOG_LEVEL": "2"}
    for name in (*LATE, *(f"humangs_jax.{name}" for name in ("cli", *HEAVY))):
        importlib.import_module(name)


def random_of(variant, *more):
    import numpy as np

    return np.random.default_rng([variant, *more])


def some_avatar(variant, count=60):
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.avatar.avatar import Avatar
    from humangs_jax.body.library import load_body
    from humangs_jax.body.model import shape_body
    from humangs_jax.rendering.gaussians import Gaussians

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
    return Avatar(gaussians, weights, rest.vertices, rest.joints, body.faces, body.parents, body.joint_names)


def some_renderings(variant, count, size=16):
    import jax.numpy as jnp

    from humangs_jax.rendering.drawing import Rendering

    random = random_of(variant)
    image = lambda *shape: jnp.asarray(random.random((size, size, *shape)), jnp.float32)
    return [Rendering(image(3), image(), image(), jnp.zeros((), jnp.int32)) for _ in range(count)]


def some_cameras(count, size=16):
    import jax.numpy as jnp

    from humangs_jax.geometry.camera import Camera

    K = jnp.asarray([[20.0, 0, size / 2], [0, 20, size / 2], [0, 0, 1]])
    pose = jnp.asarray([[1.0, 0, 0, 0], [0, -1, 0, 0.9], [0, 0, -1, 2.6], [0, 0, 0, 1]])
    return Camera(jnp.stack([K] * count), jnp.stack([pose] * count), size, size)


def some_capture(variant, views=6, size=32):
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.body.library import load_body
    from humangs_jax.body.model import BodyPose
    from humangs_jax.data.capture import Capture

    body, random, cameras = load_body(), random_of(variant, 1), some_cameras(views, size)
    masks = np.zeros((views, size, size), np.float32)
    masks[:, 4:-4, 8:-8] = 1
    images = np.where(masks[..., None] > 0, random.random((views, size, size, 3)), 1.0).astype(np.float32)
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
    import numpy as np

    from humangs_jax.data.keypoints.keypoints import Keypoints
    from humangs_jax.data.keypoints.sets import COCO_17
    from humangs_jax.fitting.files import FitRecord

    random = random_of(variant, 2)
    keypoints = Keypoints(32 * random.random((len(names), 17, 2)), np.full((len(names), 17), 0.9), COCO_17)
    return FitRecord(keypoints, tuple(names), np.ones(1), np.ones((1, 55)), np.ones((1, 55)), np.eye(3))


def some_variables():
    """Zeros of the shapes of the preset `tiny`."""
    import pickle

    return pickle.loads((Path(os.environ["KILLS_INPUTS"]) / "variables.pkl").read_bytes())


def stand_ins(variant):
    """What is patched: (module, name, replacement)."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.avatar.avatar import Avatar
    from humangs_jax.core.pytree import replace
    from humangs_jax.evaluation.scores import Scores
    from humangs_jax.fitting.refine import RefinedCapture
    from humangs_jax.fitting.report import FitReport
    from humangs_jax.fitting.scan_fit import ScanFit
    from humangs_jax.fitting.similarity import Similarity
    from humangs_jax.network.presets import tiny
    from humangs_jax.refinement.refine import Refinement
    from humangs_jax.training.validation import METRICS

    drawn = lambda count, size=16: (some_cameras(count, size), some_renderings(variant, count, size))
    moved = lambda capture: replace(capture, betas=np.full_like(capture.betas, variant / 8))
    frames = lambda *_, **__: iter([np.asarray(r.rgb) for r in some_renderings(variant, 3)])

    def refined(capture, **_):
        found = some_cameras(capture.view_count, 32).K  # whatever the start was
        cameras = replace(capture.cameras, K=found + jnp.asarray([[0, 0, variant / 8], [0, 0, 0], [0, 0, 0]]))
        return RefinedCapture(replace(moved(capture), cameras=cameras), FitReport("refinement"))

    def person(seed, _body):
        return SimpleNamespace(seed=seed, betas=np.zeros(3, np.float32))

    def posed(subject, index):
        random = random_of(subject.seed, index)
        return SimpleNamespace(
            subject=subject,
            vertices=random.normal(size=(50, 3)).astype(np.float32),
            rotations=np.zeros((len(body().parents), 3), np.float32),
            translation=np.zeros(3, np.float32),
        )

    def body():
        from humangs_jax.body.library import load_body

        return load_body()

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
        return importlib.import_module("humangs_jax.training.state").init_state(config, some_variables())

    def validated(_variables, _body, examples, *_):
        return dict.fromkeys(METRICS, 20.0), [np.asarray(example.targets.images) for example in examples]

    def bank(seeds, *_, **__):
        from readers import bank_arrays

        from humangs_jax.people.bank import PeopleBank

        arrays = bank_arrays()
        names = {field.name for field in dataclasses.fields(PeopleBank)}
        plain = {name: int(arrays[name]) if name == "generator" else arrays[name] for name in names & set(arrays)}
        return PeopleBank(**plain | {"split": "train", "seeds": np.asarray(seeds, np.int32)} | tuples(arrays))

    def tuples(arrays):
        return {name: tuple(arrays[name].tolist()) for name in ("parents", "mirrored_joints")}

    def shown(vertices, faces, tints, camera):
        image = random_of(variant, 3).random((camera.height, camera.width))
        return SimpleNamespace(
            shaded=np.repeat(image[..., None], 3, -1),
            covered=image > 0.5,
        )

    def in_scan(*_, **__):
        from humangs_jax.body.model import BodyPose

        model = body()
        pose = BodyPose(jnp.full((len(model.parents), 3), variant / 100), jnp.zeros(3))
        align = Similarity(1.0, np.eye(3), np.zeros(3))
        betas = np.zeros(model.shape_directions.shape[-1], np.float32)
        return ScanFit(model, betas, pose, align, "+y", np.zeros(4), FitReport("scan"))

    def fitted(photos, *_, **__):
        record = some_record(variant, photos.names)
        capture = moved(some_capture(0, len(photos.names), 32))
        return SimpleNamespace(capture=capture, record=record, report=FitReport("keypoints"))

    def converted(*_):
        return SimpleNamespace(variables=some_variables(), config=tiny(), skipped=1)

    def scored(images, _truth, rules, *_):
        from humangs_jax.evaluation.scores import score_names

        return [dict.fromkeys(score_names(rules), variant / 8) for _ in images]

    def tuned(*_, **__):
        from humangs_jax.apps.settings import Cost, Tuned, load_front

        return Tuned(load_front()[variant], Cost(variant, 0.0, 1.0), {})

    mesh_views = lambda *_: iter([(np.full((32, 32, 3), variant / 4), np.ones((32, 32)))] * 8)
    avatar = lambda *_, **__: Avatar.load(Path(os.environ["KILLS_INPUTS"]) / f"avatar{variant}.npz")
    return (
        ("avatar.reconstruct", "reconstruct", avatar),
        ("network.weights", "load_weights", lambda *_: (None, tiny())),
        (
            "refinement.refine",
            "refine_with_report",
            lambda *_, **__: Refinement(avatar(), 2, 1, 1.0, 0.0, (1.0, 0.5), (20.0, 21.0), True),
        ),
        ("avatar.frames", "images", frames),
        ("avatar.frames", "motion_views", lambda *_: (None, None)),
        (
            "avatar.frames",
            "turntable_views",
            lambda _avatar, _pose, views, _shot: ([None] * views, some_cameras(views)),
        ),
        ("avatar.layers", "draw", lambda _, poses, *__: iter(some_renderings(variant, len(poses)))),
        ("apps.check", "_body_image", shown),
        (
            "apps.check",
            "faults",
            lambda capture: ((), (SimpleNamespace(problem=None, inside=1.0),) * capture.view_count),
        ),
        ("apps.check", "_posed_frames", lambda capture: {0: np.zeros((4, 3))}),
        ("apps.demo", "load_weights", lambda *_: (None, tiny())),
        ("apps.demo", "reconstruct", avatar),
        ("apps.demo", "animate", lambda avatar, _: avatar.gaussians),
        ("apps.demo", "capture_renderings", lambda _, truth, *__: drawn(truth.view_count, truth.cameras.width)),
        ("apps.demo", "score", lambda *_: Scores(20.0, 0.9, 20.0, 0.2)),
        ("apps.demo", "painted_body", lambda _: None),
        ("apps.demo", "draw_painted_body", lambda *_: None),
        ("apps.demo", "motion_frames", frames),
        ("apps.settings", "tune", tuned),
        ("apps.settings", "both_avatars", lambda *_: random_of(variant, 4).random((16, 32, 3))),
        ("evaluation.run", "score_views", scored),
        ("fitting.fit_capture", "fit_photos", fitted),
        ("fitting.refine", "refine_capture", refined),
        ("fitting.scan_fit", "fit_scan", in_scan),
        ("fitting.scan_views", "_draw", mesh_views),
        ("network.conversion", "load_checkpoint", converted),
        ("network.conversion", "describe", lambda _: "a network"),
        ("losses.loss_networks", "collect_loss_networks", lambda _: ({"x": np.ones(999)}, ["VGG-19"])),
        ("people.writer", "make_subject", person),
        ("people.writer", "sample_pose", posed),
        ("people.writer", "capture_views", views_of),
        ("people.writer", "cameras_around", lambda rng, vertices, azimuths, size: some_cameras(len(azimuths), size)),
        ("training.loop", "train_step", step),
        ("training.loop", "init_state", state),
        ("training.loop", "gaussian_body", lambda body, _: body),
        ("training.loop", "validate", validated),
        ("training.sources", "build_bank", bank),
        (
            "training.sources",
            "on_the_fly_people",
            lambda _: importlib.import_module("humangs_jax.training.sources").captured_people(
                [Path(os.environ["KILLS_INPUTS"]) / "people" / "a"], body()
            ),
        ),
    )


# Runs -----------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Moment:
    """When a run is killed: `seconds` after its `event`-th change of a file, at 0 just before it; event None: after the start.

    by: the signal; SIGINT, as Ctrl-C in a terminal, only with event None, and the start is that of the command line.
    """

    event: int | None
    seconds: float
    by: int = signal.SIGKILL


@dataclasses.dataclass(frozen=True)
class Run:
    """How a run ended. code: None if it was killed. changes: (seconds since the start, event, path). work: stand-ins called."""

    code: int | None
    out: str
    errors: str
    changes: list
    work: list


class Changes:
    """The audit hook of a run: notes changes of files in the place, and kills the run, its group of processes, at one."""

    def __init__(self, place: Path, moment: Moment | None, tell: int):
        self.place, self.moment, self.tell, self.seen = str(place), moment, tell, []
        self.start = time.monotonic()
        sys.addaudithook(self.audit)

    def audit(self, event, arguments):
        if event not in CHANGES:
            return
        if event == "open":
            path, mode, flags = arguments
            if not (any(c in (mode or "") for c in "wax+") or (flags or 0) & (os.O_WRONLY | os.O_RDWR)):
                return
        path = arguments[0]
        if event == "subprocess.Popen":
            path = "."
        if not isinstance(path, str | bytes | os.PathLike):
            return
        folder = max((arguments[i] for i in CHANGES[event]), default=-1)
        path = os.fsdecode(path)
        base = self.place if folder == -1 else os.readlink(f"/proc/self/fd/{folder}")
        if not os.path.join(base, path).startswith(self.place):
            return
        self.seen.append((time.monotonic() - self.start, event, path))
        if self.moment is not None and self.moment.event == len(self.seen) - 1:
            if self.moment.seconds == 0:
                os.killpg(0, signal.SIGKILL)
            os.write(self.tell, b"!")


def start(
    command: Command, place: Path, inputs: Path, variant: int, moment: Moment | None = None, most: int | None = None
):
    """Begins a run; most: bytes that a file may have, as on a disk that is full then. Returns what `end` wants."""
    log = inputs.with_name("logs") / f"{place.name}.{variant}"  # not on a disk that is full
    shutil.rmtree(log, ignore_errors=True)
    log.mkdir(parents=True)
    ready, tell = os.pipe()
    pid = os.fork()
    if pid:
        os.close(tell)
        return pid, ready, log, moment
    code = 70
    try:
        os.close(ready)
        os.setsid()
        for number, name in ((1, "out"), (2, "errors")):
            os.dup2(os.open(log / name, os.O_WRONLY | os.O_CREAT), number)
        os.chdir(place)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        code = perform(command, place, inputs, variant, moment, tell, most, log)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def perform(command, place, inputs, variant, moment, tell, most, log):
    """The command line in this process; its exit status."""
    from humangs_jax import cli

    os.environ["KILLS_INPUTS"] = str(inputs)
    called = []
    for module, name, replacement in stand_ins(variant):
        noted = lambda *given, _name=name, _work=replacement, **named: (called.append(_name), _work(*given, **named))[1]
        mock.patch.object(importlib.import_module(f"humangs_jax.{module}"), name, noted).start()
    sys.argv = ["humangs", *command.words(inputs, variant)]
    if moment is not None and moment.by == signal.SIGINT:
        hear_from_the_start(cli, tell)
    changes, code = Changes(place, moment, tell), 0
    if most is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
    try:
        cli.main()
    except SystemExit as ending:
        code = ending.code
    except KeyboardInterrupt:  # behind the end of the command line
        code = 0
    except BaseException:
        traceback.print_exc()
        code = 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stdout.flush()
    sys.stderr.flush()
    if most is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    changes.place = "\0"  # what follows is not of the run
    (log / "changes.json").write_text(json.dumps([changes.seen, sorted(WORK & set(called))]))
    return code


def hear_from_the_start(cli, tell):
    """Says when the command line begins; an interrupt before it comes then.

    The audit hook is Python that a user's run does not have, also where extensions allow no exception: none is raised in it.
    """
    from humangs_jax.cli import screen

    importing, hook = screen._importing, Changes.audit.__code__
    mock.patch.object(screen, "_importing", lambda frame: frame.f_code is hook or importing(frame)).start()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells start what runs in the background without it
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    prepare = cli._prepare

    def begins(verbose):
        os.write(tell, b"!")
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        prepare(verbose)

    mock.patch.object(cli, "_prepare", begins).start()


def end(begun) -> Run:
    """Waits for a run, kills it at its moment."""
    pid, ready, log, moment = begun
    deadline = time.monotonic() + SECONDS
    killed = False
    try:
        if moment is not None and moment.event is None and moment.by == signal.SIGKILL:
            killed = not select.select([ready], [], [], moment.seconds)[0]
        else:
            assert select.select([ready], [], [], SECONDS)[0], f"{log}: did not end"
            if os.read(ready, 1):  # at its moment; an end of file is the end of the process
                time.sleep(moment.seconds)
                killed = True
        if killed:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, moment.by)
    finally:
        os.close(ready)
    status = None
    while status is None and time.monotonic() < deadline:
        found, state = os.waitpid(pid, os.WNOHANG)
        status = state if found else time.sleep(0.01)
    if status is None:
        os.killpg(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        raise AssertionError(f"{log}: did not end")
    changes = log / "changes.json"
    code = None if os.WIFSIGNALED(status) else os.waitstatus_to_exitcode(status)
    texts = [(log / name).read_text() if (log / name).exists() else "" for name in ("out", "errors")]
    return Run(code, *texts, *(json.loads(changes.read_text()) if changes.exists() and code is not None else ([], [])))


def run(*arguments, **options) -> Run:
    return end(start(*arguments, **options))


def prepare(inputs: Path) -> None:
    """Writes the inputs of all commands, in a process of its own."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            make_inputs(inputs)
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    assert os.waitpid(pid, 0)[1] == 0, "the inputs could not be made"


def make_inputs(inputs: Path) -> None:
    import pickle

    import jax
    import numpy as np
    from dataset_files import write_avatarrex, write_model
    from readers import sphere, write_import

    from humangs_jax.core.configuration import config_to_json
    from humangs_jax.data.capture import save_capture
    from humangs_jax.io.npz import write_npz
    from humangs_jax.network.weights import expected_variables
    from humangs_jax.training.config import tiny

    inputs.mkdir()
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, np.float32), expected_variables(tiny().model))
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
    arrays = {"set": record.keypoints.set.name, "names": record.names, "points": record.keypoints.points}
    write_npz(inputs / "keypoints.npz", arrays | {"confidences": record.keypoints.confidences})
    (inputs / "scan.obj").write_text(sphere().export(file_type="obj"))
    (inputs / "any.pt").write_bytes(b"")
    (inputs / "train.json").write_text(
        config_to_json(dataclasses.replace(tiny(), steps=6, checkpoint_every=2), indent=1)
    )


# States ---------------------------------------------------------------------------------------------------------------


def temporary(part: str) -> bool:
    """Whether a name in a path is one that `atomic` or Orbax gives what is not finished."""
    from humangs_jax.io.atomic import _TEMPORARY

    lock = part.startswith(".") and part.endswith(".lock")
    return lock or _TEMPORARY.fullmatch(part) is not None or ".orbax-checkpoint-tmp" in part


def snapshot(place: Path) -> tuple[dict[str, str], dict[str, str]]:
    """(path -> hash of the files under final names, of those under temporary ones)."""
    final, other = {}, {}
    for path in sorted(place.rglob("*")):
        relative = path.relative_to(place)
        kind = other if any(temporary(part) for part in relative.parts) else final
        if path.is_file():
            kind[str(relative)] = hashlib.sha256(contents(path)).hexdigest()
        elif kind is other:
            kind[f"{relative}/"] = ""
    return final, other


def contents(path: Path) -> bytes:
    """The bytes of a file; of weights in one order: their header is written in another one by each run."""
    data = path.read_bytes()
    if path.suffix != ".safetensors" or not weights_are_whole(data):
        return data
    size = 8 + int.from_bytes(data[:8], "little")
    return json.dumps(json.loads(data[8:size]), sort_keys=True).encode() + data[size:]


def weights_are_whole(data: bytes) -> bool:
    try:
        size = 8 + int.from_bytes(data[:8], "little")
        header = json.loads(data[8:size])
        return size + max(each["data_offsets"][1] for name, each in header.items() if name != "__metadata__") == len(
            data
        )
    except (ValueError, LookupError):
        return False


def matches(name: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatch.fnmatch(name, pattern) for pattern in patterns)


def whole(path: Path) -> bool:
    """Whether a file that no two runs write equally is complete: a log may end in a part of a line."""
    if path.suffix == ".safetensors":
        return weights_are_whole(path.read_bytes())
    text = path.read_text()
    lines = text.splitlines() if path.suffix == ".jsonl" else [text]
    for line in lines[:-1] if path.suffix == ".jsonl" and not text.endswith("\n") else lines:
        try:
            json.loads(line)
        except ValueError:
            return False
    return True


def half_written(command: Command, place: Path, before: dict, after: dict) -> list[str]:
    """What is wrong with a place between two states: files under final names that are neither old nor new, or lost."""
    final, other = snapshot(place)
    found = []
    for name, content in final.items():
        if matches(name, command.own):
            continue
        if matches(name, command.varies + command.often):
            if not whole(place / name):
                found.append(f"{name}: half-written")
        elif content not in (before.get(name), after.get(name)):
            found.append(f"{name}: neither old nor new")
    for name in before.keys() & after.keys() - final.keys():
        if before[name] not in other.values():  # moved aside, to be put back
            found.append(f"{name}: lost")
    return found


def unlike(command: Command, place: Path, expected: dict) -> list[str]:
    """What is wrong with a place after a run that came to its end."""
    final, other = snapshot(place)
    found = [f"{name}: left over" for name in other]
    compared = lambda names: {name for name in names if not matches(name, command.own)}
    found += [f"{name}: missing" for name in compared(expected.keys() - final.keys())]
    found += [f"{name}: too much" for name in compared(final.keys() - expected.keys())]
    for name in compared(final.keys() & expected.keys()):
        same = whole(place / name) if matches(name, command.varies) else final[name] == expected[name]
        found += [] if same else [f"{name}: not what the command writes"]
    if (place / "run").is_dir():
        found += unlike_a_run(place / "run")
    return found


def next_run(command: Command, place: Path, inputs: Path, expected: dict) -> list[str]:
    """What is wrong with the run after one that was killed or failed, and with what is there then."""
    finished = command.once and not unlike(command, place, expected)
    ending = run(command, place, inputs, 2)
    found = [] if ending.code == (2 if finished else 0) else [f"exit status {ending.code}: {ending.errors[-500:]}"]
    return [f"the next run: {fault}" for fault in found + unlike(command, place, expected)]


def unlike_a_run(out: Path) -> list[str]:
    steps = sorted(path.name for path in (out / "checkpoints").iterdir())
    losses = [json.loads(line)["step"] for line in (out / "log.jsonl").read_text().splitlines() if '"loss"' in line]
    # one that was interrupted at 5 has saved that step, and two are kept
    good = {"4", "6"} <= set(steps) or {"5", "6"} <= set(steps)
    found = [] if good and all(step.isdecimal() for step in steps) else [f"checkpoints {steps}"]
    return found + ([] if losses == sorted(set(losses)) and losses[-1] == 6 else [f"steps in the log: {losses}"])


def place_of(command: Command, folder: Path, inputs: Path, name: str) -> Path:
    """A new place for runs of a command, with copies of what they change."""
    place = folder / f"{command.name.replace(' ', '_')}_{name}"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    for each in command.copies:
        shutil.copytree(inputs / each, place / each)
    return place


def error_lines(text: str) -> list[str]:
    """Lines of stderr that are no progress bar."""
    return [
        line for line in re.split(r"[\r\n]+", text) if line.strip() and not re.search(r"\d+%\||\d+it \[|it/s", line)
    ]
