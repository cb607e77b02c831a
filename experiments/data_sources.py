"""How fast each data set is read, against what training takes; how long preprocessing takes."""

import functools
import importlib.util
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from experiments import made_up
from experiments.harness import Run, entry
from experiments.results import markdown_table, significant
from humangs_jax.data.datasets.subject import FileBody, open_people
from humangs_jax.data.loading import CaptureSource, Loader, PeopleCache, ViewSampling
from humangs_jax.data.preprocess.run import Settings, preprocess

INPUTS, TARGETS, SIZE = 4, 3, 256
REAL_SIZES = {"avatarrex": (1500, 2048), "thuman4": (1330, 1150), "actorshq": (750, 1022)}
"""Width and height of photos; of ActorsHQ at scale 4x."""
DNA_SIZE, DNA_ENLARGED, DNA_LENS = (612, 512), 4, (-0.1, 0.03, 1e-4, -1e-4, 0.0)
"""Of DNA-Rendering's cameras of 5 megapixels; the lens makes the reader undistort its photos, as it has to with real ones."""
SMALLER = 5
"""Photos are rendered at real sizes divided by this, then enlarged: their content does not matter."""
NAMES = {
    "scenes": "scene list, 512 px",
    "avatarrex": "AvatarReX as it is, 1500 x 2048",
    "thuman4": "THuman4.0 as it is, 1330 x 1150",
    "actorshq": "ActorsHQ 4x, 750 x 1022",
    "dna": "DNA-Rendering as it is, 2448 x 2048",
}
PREPROCESSED = {
    "thuman": "a rendered view of a scan, 3 x 3 samples a pixel",
    "avatarrex": "a photo of AvatarReX",
    "thuman4": "a photo of THuman4.0",
}


def spent(work: Callable[[], object]) -> dict[str, float]:
    """Wall and CPU seconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def have_h5py() -> bool:
    """Whether DNA-Rendering can be written and read."""
    return importlib.util.find_spec("h5py") is not None


def enlarge(folder: Path, size: tuple[int, int]) -> None:
    """Photos and masks to their real size, and the calibration with them."""
    for path in [*folder.rglob("*.jpg"), *folder.rglob("*.png")]:
        with Image.open(path) as image:
            larger = image.resize(size)
        larger.save(path, quality=95)
    for path in folder.glob("calibration*.json"):
        cameras = json.loads(path.read_text())
        for camera in cameras.values():
            camera["K"] = [SMALLER * x for x in camera["K"][:8]] + [1.0]
            camera["imgSize"] = list(size)
        path.write_text(json.dumps(cameras))
    for path in folder.rglob("calibration.csv"):
        head, *rows = path.read_text().splitlines()
        width, height = size
        rows = [",".join([row.split(",")[0], str(width), str(height), *row.split(",")[3:]]) for row in rows]
        path.write_text("\n".join([head, *rows]) + "\n")


def write_set(layout: str, out: Path) -> tuple[Path, Path]:
    """A data set with photos of the real size, and its body file."""
    if layout == "thuman":
        folder = made_up.write_thuman(out, made_up.SEEDS[:1])
    elif layout == "dna":
        lens = DNA_LENS
        folder = made_up.write_dna(out, frames=3, cameras=4, size=DNA_SIZE, enlarged=DNA_ENLARGED, lens=lens)
    else:
        width, height = (pixels // SMALLER for pixels in REAL_SIZES[layout])
        folder = made_up.WRITERS[layout](out, frames=3, cameras=4, size=(width, height))
        enlarge(folder, (width * SMALLER, height * SMALLER))
    return folder, out / "body.npz"


def measure_preprocessing(out: Path, sets: dict[str, tuple[Path, Path]], kinds: Sequence[str], views: int) -> dict[str, Any]:
    """Seconds for a view of each kind, one process, compilation apart."""
    results = {}
    for kind in kinds:
        every = 10 if kind == "avatarrex" else 1
        settings = Settings(kind, views=views, factors=(2.0, 2.0), every=every, train=0, test=1)
        source, body = sets[kind]
        make = lambda name, kept=settings, source=source, body=body, kind=kind: preprocess(
            source, out / f"{kind}_{name}", body, kept, progress=False
        )
        make("first")  # compiles
        took = spent(lambda make=make: make("scenes"))
        count = json.loads((out / f"{kind}_scenes" / "manifest.json").read_text())["counts"]["views"]
        results[kind] = took | {"views": count, "cpu_s_per_view": took["cpu_s"] / count}
    return results


def examples(people: Any, inputs: int, targets: int, count: int) -> Any:
    """Samples through the loader, one by one."""
    sampling = ViewSampling(input_counts=(inputs,), target_count=targets)
    source = CaptureSource(PeopleCache(people, limit_bytes=0), sampling, SIZE, SIZE)
    return Loader(source, seed=1, threads=2).batches(0, count)


def measure_reading(people: Any, samples: int) -> dict[str, float]:
    """Seconds to open people and to read samples."""
    opened = spent(lambda: [person.summary() for person in people])
    list(examples(people, INPUTS, TARGETS, 2))
    took = spent(lambda: list(examples(people, INPUTS, TARGETS, samples)))
    speeds = {"samples_per_s": samples / took["wall_s"], "cpu_s_per_sample": took["cpu_s"] / samples}
    return {"open_s": opened["cpu_s"]} | speeds


def table(result: dict[str, Any]) -> str:
    """Sources, then preprocessing."""
    step = result["train_step_s"]
    rows = []
    for name, numbers in result["sources"].items():
        share = numbers["cpu_s_per_sample"] / step
        cells = [significant(numbers["samples_per_s"]), significant(1e3 * numbers["cpu_s_per_sample"])]
        rows.append([NAMES[name], *cells, f"{100 * share:.0f} %"])
    header = ["source", "samples a second", "CPU ms a sample", "share of a training step"]
    made = [[PREPROCESSED[kind], significant(1e3 * n["cpu_s_per_view"])] for kind, n in result["preprocessing"].items()]
    parts = [
        f"A sample is {INPUTS} input and {TARGETS} target views at {SIZE} px, decoded from disk every time; a training step of "
        f"the preset `small` takes {step:.2g} s and one sample.",
        markdown_table(header, rows),
        markdown_table(["preprocessing to 512 px", "CPU ms"], made),
    ]
    return "\n\n".join(parts)


@entry
def data_sources(
    run: Run,
    sources: tuple[str, ...] = tuple(NAMES),
    samples: int = 20,
    train_step_s: float = 2.8,
    views: int = 12,
) -> None:
    """How fast each data set is read, against what training takes; how long preprocessing takes.

    Synthetic people are written in each layout with photos of the real sizes, read through the loader (4 input and 3 target
    views at 256 pixels a sample, nothing kept in memory), and preprocessed. CPU seconds count the work of all threads.

    Options:
    sources: what is read; DNA-Rendering is left out without h5py
    samples: that are timed
    train_step_s: seconds of a training step (docs/data.md)
    views: of the scan
    """
    if min(samples, views) < 1:
        raise ValueError("--samples and --views must be at least 1")
    chosen = [name for name in NAMES if name in sources and (name != "dna" or have_h5py())]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)

        @functools.cache
        def written(layout):
            return write_set(layout, out / layout)

        @functools.cache
        def preprocessed():
            return measure_preprocessing(out, {kind: written(kind) for kind in PREPROCESSED}, list(PREPROCESSED), views)

        def source(name):
            path, body = written("thuman" if name == "scenes" else name)
            if name == "scenes":
                preprocessed()
                path = out / "thuman_scenes" / "test.json"
            return measure_reading(open_people(path, FileBody.load(body)), samples)

        cases = {"preprocessing": preprocessed} | {name: functools.partial(source, name) for name in chosen}
        rows = run.rows(cases, {"samples": samples, "views": views})
    made = rows.pop("preprocessing")
    result = {"train_step_s": train_step_s, "preprocessing": made, "sources": rows}
    run.show(table(result), result)
