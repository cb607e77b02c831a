"""How fast each data set is read, against what training takes; how long preprocessing takes; whether memory stays flat.

    python experiments/data/benchmark.py --json sources.json [--page docs/datasets.md] [--samples 20] [--flat 1000]

Synthetic people are written in each layout with photos of the real sizes, read through the loader (4 input and 3 target views at
256 pixels a sample, nothing kept in memory), and preprocessed. Memory: growth of the resident set of this process after the first
fifth of --flat samples of two views (videos: of photos a fifth as wide, which take a twentieth of the time), and of --flat-photos
of the real size. CPU seconds count the work of all threads and depend little on other programs. About 15 minutes on 2 CPU cores.

An earlier --json is continued: --sources and --parts say what is measured anew. DNA-Rendering is left out without h5py.
"""

import argparse
import importlib.util
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish, significant, write_json
from experiments.data import made_up
from experiments.timing import prepare_process

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
PARTS = ("preprocessing", "reading", "memory", "small")


def spent(work: Callable[[], object]) -> dict[str, float]:
    """Wall and CPU seconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def resident_bytes() -> int:
    """The resident set of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def have_h5py() -> bool:
    """Whether DNA-Rendering can be written and read."""
    return importlib.util.find_spec("h5py") is not None


def enlarge(folder: Path, size: tuple[int, int]) -> None:
    """Photos and masks to their real size, and the calibration with them."""
    from PIL import Image

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


def write_set(layout: str, out: Path, real_size: bool) -> tuple[Path, Path]:
    """A data set and its body file. real_size: of its photos; else they are a fifth (DNA-Rendering: a quarter) as wide."""
    if layout == "thuman":
        folder = made_up.write_thuman(out, made_up.SEEDS[:1])
    elif layout == "dna":
        enlarged = DNA_ENLARGED if real_size else 1
        folder = made_up.write_dna(out, frames=3, cameras=4, size=DNA_SIZE, enlarged=enlarged, lens=DNA_LENS)
    else:
        width, height = (pixels // SMALLER for pixels in REAL_SIZES[layout])
        folder = made_up.WRITERS[layout](out, frames=3, cameras=4, size=(width, height))
        if real_size:
            enlarge(folder, (width * SMALLER, height * SMALLER))
    return folder, out / "body.npz"


def measure_preprocessing(
    out: Path, sets: dict[str, tuple[Path, Path]], kinds: Sequence[str], views: int
) -> dict[str, Any]:
    """Seconds for a view of each kind, one process, compilation apart."""
    from humangs_jax.data.preprocess.run import Settings, preprocess

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
    from humangs_jax.data.loading import CaptureSource, Loader, PeopleCache, ViewSampling

    sampling = ViewSampling(input_counts=(inputs,), target_count=targets)
    source = CaptureSource(PeopleCache(people, limit_bytes=0), sampling, SIZE, SIZE)
    return Loader(source, seed=1, threads=2).batches(0, count)


def measure_reading(people: Any, samples: int) -> dict[str, float]:
    """Seconds to open people and to read samples."""
    opened = spent(lambda: [person.boundary() for person in people])
    list(examples(people, INPUTS, TARGETS, 2))
    took = spent(lambda: list(examples(people, INPUTS, TARGETS, samples)))
    speeds = {"samples_per_s": samples / took["wall_s"], "cpu_s_per_sample": took["cpu_s"] / samples}
    return {"open_s": opened["cpu_s"]} | speeds


def grown_bytes(people: Any, samples: int) -> float:
    """Growth of the resident set over a number of samples of two views : the mean of the last 20 less that of 20 early ones."""
    sizes = [resident_bytes() for i, _ in enumerate(examples(people, 1, 1, samples)) if i >= samples // 5]
    return (sum(sizes[-20:]) - sum(sizes[:20])) / 20


def table(result: dict[str, Any]) -> str:
    """Sources, then preprocessing."""
    step = result["train_step_s"]
    rows = []
    for name, numbers in result["sources"].items():
        share = numbers["cpu_s_per_sample"] / step
        cells = [significant(numbers["samples_per_s"]), significant(1e3 * numbers["cpu_s_per_sample"])]
        grown = [
            f"{numbers[of] / 2**20:+.1f} MiB over {numbers[over]:,.0f}" if numbers.get(over) else ""
            for of, over in (("grown_bytes", "samples_of_memory"), ("grown_bytes_small", "samples_of_memory_small"))
        ]
        rows.append([NAMES[name], *cells, f"{100 * share:.0f} %", *grown])
    header = ["source", "samples a second", "CPU ms a sample", "share of a training step", "memory"]
    header.append("memory, smaller photos")
    made = [[PREPROCESSED[kind], significant(1e3 * n["cpu_s_per_view"])] for kind, n in result["preprocessing"].items()]
    parts = [
        f"A sample is {INPUTS} input and {TARGETS} target views at {SIZE} px, decoded from disk every time; a training step of "
        f"the preset `small` takes {step:.2g} s and one sample. Memory: growth of the resident set over samples of two views; "
        f"smaller photos are a fifth as wide (DNA-Rendering: a quarter).",
        markdown_table(header, rows),
        markdown_table(["preprocessing to 512 px", "CPU ms"], made),
    ]
    return "\n\n".join(parts)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--page", type=Path, help="page whose table data_sources is written")
    parser.add_argument("--sources", nargs="*", choices=NAMES, default=list(NAMES), help="what is read")
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=PARTS, help="what is measured")
    parser.add_argument("--samples", type=int, default=20, help="samples that are timed")
    parser.add_argument("--flat", type=int, default=1000, help="samples over which memory is watched")
    parser.add_argument("--flat-photos", type=int, default=100, help="the same of large photos")
    parser.add_argument("--train-step-s", type=float, default=2.8, help="seconds of a training step (docs/data.md)")
    parser.add_argument("--views", type=int, default=12, help="views of the scan")
    arguments = parser.parse_args()
    if min(arguments.samples, arguments.views) < 1 or min(arguments.flat, arguments.flat_photos) < 50:
        parser.error("--samples and --views must be at least 1, --flat and --flat-photos at least 50")
    prepare_process()
    from humangs_jax.data.datasets.bodies import FileBody
    from humangs_jax.data.datasets.subject import open_people

    result: dict[str, Any] = {"train_step_s": arguments.train_step_s, "preprocessing": {}, "sources": {}}
    if arguments.json and arguments.json.exists():
        result = json.loads(arguments.json.read_text())

    def note(name: str, numbers: dict[str, float]) -> None:
        result["sources"].setdefault(name, {}).update(numbers)
        print(name, json.dumps(numbers), flush=True)
        if arguments.json:
            write_json(arguments.json, result)

    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        sources = [name for name in NAMES if name in arguments.sources and (name != "dna" or have_h5py())]
        preprocessed = [*PREPROCESSED] if "preprocessing" in arguments.parts else []
        whole = "reading" in arguments.parts or "memory" in arguments.parts
        needed = {"thuman" if name == "scenes" else name for name in sources if whole}
        of_scenes = ["thuman"] if "thuman" in needed and not preprocessed else []
        sets = {name: write_set(name, out / name, True) for name in needed.union(preprocessed)}
        made = measure_preprocessing(out, sets, preprocessed or of_scenes, arguments.views)
        result["preprocessing"].update(made if preprocessed else {})
        for name in sources:
            if whole:
                path, body_file = sets["thuman" if name == "scenes" else name]
                body, path = FileBody.load(body_file), out / "thuman_scenes" / "test.json" if name == "scenes" else path
                people = open_people(path, body)
                if "reading" in arguments.parts:
                    note(name, measure_reading(people, arguments.samples))
                if "memory" in arguments.parts:
                    watched = arguments.flat if name == "scenes" else arguments.flat_photos
                    note(name, {"grown_bytes": grown_bytes(people, watched), "samples_of_memory": watched})
            if "small" in arguments.parts and name != "scenes":
                path, body_file = write_set(name, out / f"{name}_small", False)
                grown = grown_bytes(open_people(path, FileBody.load(body_file)), arguments.flat)
                note(name, {"grown_bytes_small": grown, "samples_of_memory_small": arguments.flat})
    print(table(result))
    if arguments.page:
        publish(arguments.page, "data_sources", table(result), result)


if __name__ == "__main__":
    main()
