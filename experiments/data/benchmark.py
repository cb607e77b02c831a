"""How fast each data set is read, against what training takes; how long preprocessing takes; whether memory stays flat.

    python experiments/data/benchmark.py --json sources.json [--page docs/datasets.md] [--samples 20] [--flat 1000]

Synthetic people are written in each layout with photos of the real sizes, read through the loader (4 input and 3 target views at
256 pixels a sample, nothing kept in memory), and preprocessed. Memory: the resident set of this process over --flat samples of
two views of the scene list, over --flat-photos samples of each source of large photos, and over --flat-dna of DNA-Rendering,
whose photos take ten times as long as others (left out without h5py), after the first fifth. CPU seconds count the work of all
threads and depend little on other programs. About 10 minutes on 2 CPU cores, 25 with --flat-photos 1000.
"""

import argparse
import importlib.util
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.interleaved import prepare_process
from experiments.common.results import markdown_table, publish, significant, write_json
from experiments.data import made_up

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


def spent(work: Callable[[], object]) -> dict[str, float]:
    """Wall and CPU seconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def resident_bytes() -> int:
    """The resident set of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


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


def write_sets(out: Path) -> dict[str, tuple[Path, Path]]:
    """Layout -> (data set, body file)."""
    sets = {}
    for layout, size in REAL_SIZES.items():
        small = size[0] // SMALLER, size[1] // SMALLER
        frames = {"frames": 3, "cameras": 4, "size": small}
        folder = made_up.WRITERS[layout](out / layout, **frames)
        enlarge(folder, (small[0] * SMALLER, small[1] * SMALLER))
        sets[layout] = folder, out / layout / "body.npz"
    if importlib.util.find_spec("h5py"):
        large: dict[str, Any] = {"size": DNA_SIZE, "enlarged": DNA_ENLARGED, "lens": DNA_LENS}
        folder = made_up.write_dna(out / "dna", frames=3, cameras=4, **large)
        sets["dna"] = folder, out / "dna" / "body.npz"
    sets["thuman"] = made_up.write_thuman(out / "thuman", made_up.SEEDS[:1]), out / "thuman" / "body.npz"
    return sets


def measure_preprocessing(out: Path, sets: dict[str, tuple[Path, Path]], views: int) -> dict[str, Any]:
    """Seconds for a view of each kind, one process, compilation apart."""
    from humangs_jax.data.preprocess.run import preprocess
    from humangs_jax.data.preprocess.scenes import Settings

    results = {}
    for kind in ("thuman", "avatarrex", "thuman4"):
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


def measure_reading(people: Any, samples: int, flat: int) -> dict[str, float]:
    """Samples through the loader; then the growth of memory."""
    from humangs_jax.data.loader import CaptureSource, Loader, PeopleCache, ViewSampling

    def examples(inputs: int, targets: int, count: int) -> Any:
        sampling = ViewSampling(input_counts=(inputs,), target_count=targets)
        source = CaptureSource(PeopleCache(people, limit_bytes=0), sampling, SIZE, SIZE)
        return Loader(source, seed=1, threads=2).batches(0, count)

    opened = spent(lambda: [person.outline() for person in people])
    list(examples(INPUTS, TARGETS, 2))
    took = spent(lambda: list(examples(INPUTS, TARGETS, samples)))
    sizes = []
    for i, _ in enumerate(examples(1, 1, flat)):
        if i >= flat // 5:
            sizes.append(resident_bytes())
    grown = (sum(sizes[-20:]) - sum(sizes[:20])) / 20 if len(sizes) >= 40 else 0.0
    return {
        "open_s": opened["cpu_s"],
        "samples_per_s": samples / took["wall_s"],
        "cpu_s_per_sample": took["cpu_s"] / samples,
        "grown_bytes": grown,
        "samples_of_memory": flat,
    }


def table(result: dict[str, Any]) -> str:
    """Sources, then preprocessing."""
    step = result["train_step_s"]
    rows = []
    for name, numbers in result["sources"].items():
        share = numbers["cpu_s_per_sample"] / step
        grown = f"{numbers['grown_bytes'] / 2**20:+.1f} MiB over {numbers['samples_of_memory']:,.0f}"
        cells = [significant(numbers["samples_per_s"]), significant(1e3 * numbers["cpu_s_per_sample"])]
        rows.append([NAMES[name], *cells, f"{100 * share:.0f} %", grown])
    header = ["source", "samples a second", "CPU ms a sample", "share of a training step", "memory"]
    kinds = {
        "thuman": "a rendered view of a scan, 3 x 3 samples a pixel",
        "avatarrex": "a photo of AvatarReX",
        "thuman4": "a photo of THuman4.0",
    }
    made = [[kinds[kind], significant(1e3 * n["cpu_s_per_view"])] for kind, n in result["preprocessing"].items()]
    parts = [
        f"A sample is {INPUTS} input and {TARGETS} target views at {SIZE} px, decoded from disk every time; a training step of "
        f"the preset `small` takes {step:.2g} s and one sample. Memory: growth of the resident set over samples of two views.",
        markdown_table(header, rows),
        markdown_table(["preprocessing to 512 px", "CPU ms"], made),
    ]
    return "\n\n".join(parts)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--page", type=Path, help="page whose table data_sources is written")
    parser.add_argument("--samples", type=int, default=20, help="samples that are timed")
    parser.add_argument("--flat", type=int, default=1000, help="samples over which memory is watched")
    parser.add_argument("--flat-photos", type=int, default=100, help="the same of sources of large photos")
    parser.add_argument("--flat-dna", type=int, default=100, help="the same of DNA-Rendering")
    parser.add_argument("--train-step-s", type=float, default=2.8, help="seconds of a training step (docs/data.md)")
    parser.add_argument("--views", type=int, default=12, help="views of the scan")
    arguments = parser.parse_args()
    counts = arguments.samples, arguments.flat, arguments.flat_photos, arguments.flat_dna, arguments.views
    if min(counts) < 1:
        parser.error("--samples, --flat, --flat-photos, --flat-dna and --views must be at least 1")
    prepare_process()
    from humangs_jax.data.datasets.bodies import FileBody
    from humangs_jax.data.datasets.opening import open_people

    result: dict[str, Any] = {"train_step_s": arguments.train_step_s, "sources": {}}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        sets = write_sets(out)
        result["preprocessing"] = measure_preprocessing(out, sets, arguments.views)
        print(json.dumps(result), flush=True)
        bodies = {layout: FileBody.load(body) for layout, (_, body) in sets.items()}
        sources = {"scenes": (out / "thuman_scenes" / "test.json", bodies["thuman"])}
        sources |= {layout: (sets[layout][0], bodies[layout]) for layout in NAMES if layout in sets}
        flat = {"scenes": arguments.flat, "dna": arguments.flat_dna}
        for name, (path, body) in sources.items():
            people = open_people(path, body)
            watched = flat.get(name, arguments.flat_photos)
            result["sources"][name] = measure_reading(people, arguments.samples, watched)
            print(name, json.dumps(result["sources"][name]), flush=True)
            if arguments.json:
                write_json(arguments.json, result)
    print(table(result))
    if arguments.page:
        publish(arguments.page, "data_sources", table(result), result)


if __name__ == "__main__":
    main()
