"""A fuzzer over every reader: python fuzz.py FOLDER INPUTS [READER ...]

Honest files are taken apart as their format has it (arrays of an archive, values of JSON,
instructions of a pickle, chunks of a PNG, words of a text), a few parts are exchanged for hostile
ones, and the file is put together again; or bytes change at random. What is found is shrunk by
hypothesis, saved as FOLDER/found-READER, and becomes a case of `attacks_*.py`.

`CHUNK` inputs at a time go to the reader that had the fewest, until each has INPUTS.
FOLDER/record.json has the figures of each reader; a later call goes on from there, and tries what
was found again.
"""

import argparse
import copy
import gc
import gzip
import io
import itertools
import json
import os
import pickletools
import re
import shutil
import struct
import sys
import time
import zipfile
import zlib
from pathlib import Path
from types import SimpleNamespace

import worker

worker.prepare()  # before JAX and the readers are imported

import jax  # noqa: E402
import numpy as np  # noqa: E402
import readers  # noqa: E402
from hostile_cases import FIRST_SEED  # noqa: E402
from hypothesis import HealthCheck, Phase, given, seed, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402

CHUNK = 500
"""Inputs that hypothesis draws from one seed: its number among those of the reader."""
LARGEST = 1 << 26
"""Bytes of a mutated file: reading what is honestly large takes memory within the limits of
docs/security.md.
"""
MOST_MAPPINGS = 20_000
"""Every compiled program maps memory, of which Linux allows 65,530 pieces: with more than this the
fuzzer starts itself again.
"""

NUMBERS = [
    0,
    1,
    -1,
    2,
    7,
    255,
    2**15,
    2**31 - 1,
    2**31,
    2**32,
    2**63,
    -(2**63),
    10**30,
    0.5,
    1e30,
    1e400,
    -1e400,
    np.nan,
]
VALUES = [*NUMBERS, None, True, "", "x", "..", "../x", "/", "a\0b", "1", "nan"]
VALUES += [[], {}, [1, [2]], {"a": 1}, [[]] * 9, [0.0] * 51]
DTYPES = ("<f4", "<f8", ">f8", "<f2", "<i4", "<i8", "<u1", "<u4", "|b1", "<c8", "<U3", "|S3")
SIZES = (0, 1, 2, 3, 4, 5, 9, 17, 55, 165)
WORDS = (
    b"nan inf -1 0 1e400 99999999999999999999 x [ { - !!opencv-matrix !!python/object &a *a"
    b" %YAML:1.0 # / ..".split()
)
WORDS += [b"9" * 400, b"", b"\0", b"\xff", b"\n", b": ", b"f 1 2 3", b"v 1 2 3"]
BYTES = [
    *(bytes([i]) for i in range(256)),
    *(end * size for end in (b"\0", b"\xff", b"\x7f", b"\x80") for size in (2, 4, 8)),
    *WORDS,
]
NAMES = """numpy dtype, numpy ndarray, numpy.core.multiarray _reconstruct, numpy.core.multiarray scalar, numpy._core.numeric
_frombuffer, _codecs encode, scipy.sparse csc_matrix, chumpy.ch Ch, chumpy.reordering Select, copyreg _reconstructor, collections
OrderedDict, torch FloatStorage, torch.storage _load_from_bytes, joblib.numpy_pickle NumpyArrayWrapper, collections
defaultdict, torch._utils _rebuild_tensor_v2, torch._utils _rebuild_parameter, os system, builtins object"""
INSTRUCTIONS = [each.code.encode("latin1") for each in pickletools.opcodes]
INSTRUCTIONS += [b"c" + "\n".join((*each.split(), "")).encode() for each in NAMES.split(",")]
INSTRUCTIONS += [b"J" + struct.pack("<i", n) for n in (-1, 0, 7, 2**31 - 1)] + [b"X\1\0\0\0<"]
HEADERS = itertools.product(
    (0, 9, 10, 70_000), (0, 12, 2**31), (1, 8, 16), range(8), (0, 1), (0, 1), (0, 1, 2)
)
CHUNKS = [
    (b"IHDR", struct.pack(">IIBBBBB", *header)) for header in itertools.islice(HEADERS, 0, None, 7)
]
CHUNKS += [
    (name, body)
    for name in (
        b"tRNS",
        b"PLTE",
        b"iCCP",
        b"zTXt",
        b"gAMA",
        b"cHRM",
        b"cICP",
        b"eXIf",
        b"acTL",
        b"fcTL",
        b"IDAT",
        b"IEND",
    )
    for body in (b"", b"\0", bytes(40), b"x\0\0" + zlib.compress(bytes(99)))
]


class Draw:
    """Choices of hypothesis, in few words."""

    def __init__(self, data):
        self.data = data

    def below(self, count):
        return self.data.draw(st.integers(0, max(0, count - 1)))

    def of(self, options):
        return options[self.below(len(options))]

    def value(self):
        """Of JSON: one of those above, or two of them in a list or a dict."""
        way = self.below(8)
        some = [copy.deepcopy(self.of(VALUES)) for _ in range(2 if way > 5 else 1)]
        return some if way == 6 else dict(zip("ab", some, strict=True)) if way == 7 else some[0]

    def exchanged(self, pieces, hostile):
        """Pieces in a list, or a bytearray, of which a few are left out, doubled, or exchanged for
        hostile ones.
        """
        for _ in range(1 + self.below(4)):
            at, way, count = (
                self.below(len(pieces) + 1),
                self.below(4),
                1 + self.below(self.of((1, 8, 64))),
            )
            if way == 0:
                del pieces[at : at + count]
            elif way == 1:
                other = self.below(len(pieces) + 1)
                pieces[at:at] = pieces[other : other + count]
            else:
                new = self.of(hostile) * self.of((1, 1, 1, count))
                pieces[at : at + len(new) * (way == 2)] = new
        return pieces


def mutated_bytes(data, draw):
    return bytes(draw.exchanged(bytearray(data), BYTES))


def mutated_text(data, draw):
    return b"".join(
        draw.exchanged(re.split(rb"([ \n])", data), [[b" ", word, b" "] for word in WORDS])
    )


def mutated_pickle(data, draw):
    ends = [place for _, _, place in pickletools.genops(data)] + [len(data)]
    pieces = [data[a:b] for a, b in itertools.pairwise(ends)]
    return b"".join(draw.exchanged(pieces, [[each] for each in INSTRUCTIONS]))


def mutated_png(data, draw):
    at, chunks = 8, []
    while at + 12 <= len(data):
        length, name = struct.unpack(">I4s", data[at : at + 8])
        chunks.append((name, data[at + 8 : at + 8 + length]))
        at += 12 + length
    at = draw.below(len(chunks))
    name, body = chunks[at]
    chunks[at] = draw.of(
        [
            (name, mutated_bytes(body, draw)),
            (name, zlib.compress(mutated_bytes(bytes(400), draw))),
            (name, body),
        ]
    )
    chunks = draw.exchanged(chunks, [[each] for each in CHUNKS])
    packed = (
        struct.pack(">I", len(b)) + n + b + struct.pack(">I", zlib.crc32(n + b)) for n, b in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def places(value, path=()):
    yield path
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, item in items:
        yield from places(item, (*path, key))


def mutated_value(value, draw):
    for _ in range(1 + draw.below(3)):
        path = draw.of(list(places(value)))
        if not path:
            return draw.value()
        parent = value
        for key in path[:-1]:
            parent = parent[key]
        way = draw.below(4)
        if way == 0 and isinstance(parent, dict):
            del parent[path[-1]]
        elif way == 1 and isinstance(parent, list):
            parent[:] = parent[:1] * draw.of((0, 2, 50))
        else:
            parent[path[-1]] = draw.value()
    return value


def mutated_json(data, draw):
    return json.dumps(mutated_value(json.loads(data), draw)).encode()


def mutated_array(array, draw):
    way = draw.below(5)
    if way == 0:
        return np.zeros([draw.of(SIZES) for _ in range(draw.below(5))], draw.of(DTYPES))
    if way == 1 and array.dtype.kind in "fiu" and array.size:
        array = array.copy()
        bad = (0, 1, 9, 99) if array.dtype.kind in "iu" else (np.nan, np.inf, -np.inf, -1.0, 6e4)
        array.reshape(-1)[draw.below(array.size)] = draw.of(bad)
        return array
    if way == 2:
        return (
            array.astype(draw.of(DTYPES[:9]))
            if array.dtype.kind in "fiub"
            else np.asarray(draw.of(("", "x", "\0")))
        )
    if way == 3:
        return array[None]
    return array[: draw.below(len(array) + 1)] if array.ndim else np.zeros(3)


def mutated_npz(data, draw):
    with np.load(io.BytesIO(data)) as archive:
        arrays = dict(archive)
    for _ in range(1 + draw.below(3)):
        key = draw.of(sorted(arrays)) if arrays else "x"
        if draw.below(6) == 0:
            arrays.pop(key, None)
        elif key == "header" and "header" in arrays:
            arrays[key] = np.asarray(
                mutated_json(str(arrays[key]).encode(), draw).decode("utf-8", "replace")
            )
        else:
            arrays[key] = mutated_array(arrays.get(key, np.zeros(3)), draw)
    stream = io.BytesIO()
    with np.errstate(all="ignore"):
        np.savez(stream, **arrays)
    return stream.getvalue()


def mutated_zip(data, draw):
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = draw.of([*(["archive/data.pkl"] * 3 if "archive/data.pkl" in members else ()), *members])
    members[name] = (
        mutated_pickle(members[name], draw)
        if name.endswith(".pkl")
        else mutated_bytes(members[name], draw)
    )
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


def mutated_glb(data, draw):
    length = struct.unpack_from("<I", data, 12)[0]
    header = mutated_json(data[20 : 20 + length], draw)
    header += b" " * (-len(header) % 4)
    chunks = struct.pack("<II", len(header), 0x4E4F534A) + header + data[20 + length :]
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def mutated_spz(data, draw):
    if data.startswith(
        b"NGSP"
    ):  # the header and the table, else hardly any change comes as far as the numbers
        return mutated_bytes(data[:128], draw) + data[128:]
    return gzip.compress(mutated_bytes(gzip.decompress(data), draw))


def mutated_safetensors(data, draw):
    length = struct.unpack_from("<Q", data)[0]
    header, rest = json.loads(data[8 : 8 + length]), data[8 + length :]
    notes = header.get("__metadata__", {})
    if "architecture" in notes and draw.below(2):
        key = draw.of(("architecture", "conventions"))
        notes[key] = mutated_json(notes[key].encode(), draw).decode()
    else:
        header = mutated_value(header, draw)
    header = json.dumps(header).encode()
    return struct.pack("<Q", len(header)) + header + rest


KINDS = {
    mutated_npz: (
        "npz, smplx npz, hands, body, avatar, keypoints npz, motion npz, amass, thuman, human3r,"
        " smplcodec, sam 3d, fit record, bank, video poses, scene arrays"
    ),
    mutated_json: (
        "panoptic, shelf, easymocap motion, easymocap annots, json, configuration, transforms,"
        " opencv json, openpose, coco, coco annotations, mmpose, lhm, face scores, manifest,"
        " capture, photos, boundary, import, avatarrex, scene list, evaluation, preprocessed set,"
        " preprocessed scene, skipped subject"
    ),
    mutated_pickle: "pickle, pickled tensors, smplx pkl, aist, phalp, thuman fit",
    mutated_text: (
        "opencv yaml, toml, qualisys, easymocap, colmap, obj, log, bvh, face table, 3dgs text, missing"
        " photos, actorshq, thuman mesh, thuman scan"
    ),
    mutated_png: "image",
    mutated_zip: "torch zip, gvhmr",
    mutated_glb: "glb motion, glb face, vrma face, glb splats",
    mutated_spz: "spz, spz 4",
    mutated_safetensors: "safetensors, weights",
}
STRUCTURES = {name: mutated for mutated, names in KINDS.items() for name in names.split(", ")}
"""How the files of a reader are taken apart; those of the others change by bytes alone."""
assert set(STRUCTURES) <= set(readers.FORMATS)


def checked(read, path, watch):
    """Reads a file.

    Raises: AssertionError for anything but a result or one line that names the file.
    """

    folder = path if path.is_dir() else path.parent
    case = SimpleNamespace(name="", reader="", make=lambda _: path)
    result = worker.run(case, read, folder, watch, measured=False)
    assert result["outcome"] in ("read", "refused"), f"{result['outcome']}: {result['message']}"
    if result["outcome"] == "refused":
        assert str(folder) in result["message"] and "\n" not in result["message"], result["message"]
    return result["outcome"]


def fuzz(name, folder, inputs, number, watch):
    """Figures of one chunk of a reader; with something found, only what it was."""
    place = folder / name.replace(" ", "_")
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    path = readers.FORMATS[name].make(place)
    file = readers.FORMATS[name].damaged(path)
    honest, counts = file.read_bytes(), {"read": 0, "refused": 0}

    @seed(FIRST_SEED + number)
    @settings(
        max_examples=inputs,
        deadline=None,
        database=None,
        phases=(Phase.generate, Phase.shrink),
        print_blob=False,
        suppress_health_check=list(HealthCheck),
        report_multiple_bugs=False,
    )
    @given(st.data())
    def run(data):
        draw = Draw(data)
        mutate = STRUCTURES.get(name, mutated_bytes) if draw.below(4) else mutated_bytes
        try:
            content = mutate(honest, draw)
        except (OverflowError, TypeError, ValueError):  # values that the format itself cannot hold
            content = mutated_bytes(honest, draw)
        if len(content) > LARGEST:
            content = mutated_bytes(honest, draw)
        file.write_bytes(content)
        try:
            counts[checked(readers.FORMATS[name].read, path, watch)] += 1
        except AssertionError:
            (folder / f"found-{name.replace(' ', '_')}").write_bytes(content)
            raise

    start = time.perf_counter()
    try:
        run()
    except AssertionError as error:
        return {"found": str(error)[-900:]}
    return counts | {
        "inputs": sum(counts.values()),
        "chunks": 1,
        "seconds": time.perf_counter() - start,
    }


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("inputs", type=int)
    parser.add_argument("readers", nargs="*")
    parser.add_argument(
        "--page",
        type=Path,
        help="page whose table fuzz is written, with its docs/results/fuzz.json",
    )
    arguments = parser.parse_args()
    folder, names = (
        arguments.folder,
        arguments.readers or [name for name, each in readers.FORMATS.items() if each.make],
    )
    record, fresh = (
        folder / "record.json",
        {"inputs": 0, "read": 0, "refused": 0, "chunks": 0, "seconds": 0.0},
    )
    figures = json.loads(record.read_text()) if record.exists() else {}
    figures |= {name: fresh | figures.get(name, {}) | {"found": ""} for name in names}
    shutil.rmtree(folder / "honest", ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    worker.warm_up(readers, folder)
    watch = worker.Watch()
    worker.limit_memory()
    while waiting := [
        name
        for name in names
        if figures[name]["inputs"] < arguments.inputs and not figures[name]["found"]
    ]:
        name = min(waiting, key=lambda each: figures[each]["inputs"])
        own = figures[name]
        chunk = min(CHUNK, arguments.inputs - own["inputs"])
        for key, value in fuzz(name, folder, chunk, own["chunks"], watch).items():
            own[key] = round(own[key] + value, 1) if key != "found" else value
        record.write_text(json.dumps(figures, indent=1) + "\n")
        if own["found"]:
            print(f"{name}: {own['found']}", flush=True)
        jax.clear_caches()
        gc.collect()
        if Path("/proc/self/maps").read_bytes().count(b"\n") > MOST_MAPPINGS:
            os.execv(sys.executable, [sys.executable, *sys.argv])
    if arguments.page is not None:
        write_page(arguments.page, figures)
    print(json.dumps(figures))


def write_page(page, figures):
    sys.path.insert(0, str(worker.ROOT))
    from experiments.results import markdown_table, publish

    total = lambda key: sum(each[key] for each in figures.values())
    header = [
        "readers",
        "mutated files",
        "fewest of a reader",
        "read",
        "refused in one line",
        "anything else",
    ]
    fewest = min(each["inputs"] for each in figures.values())
    found = sum(bool(each["found"]) for each in figures.values())
    rows = [
        [
            len(figures),
            f"{total('inputs'):,}",
            f"{fewest:,}",
            f"{total('read'):,}",
            f"{total('refused'):,}",
            found,
        ]
    ]
    publish(page, "fuzz", markdown_table(header, rows, "r" * len(header)), figures)


if __name__ == "__main__":
    main()
