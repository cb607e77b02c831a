"""Scans: accessors, instances, textures, and formats that are not read."""

import gzip
import os
import re
import struct

import honest_files as honest
from attacks_photos import EPS, PHOTOS
from hostile_cases import case, changed, huge, setting, written
from PIL import Image

# Scans --------------------------------------------------------------------------------------------------------------------


def glb(change=lambda content: None, **options):
    return written("scan.glb", lambda: honest.textured_glb(change=change, **options))


def no_view(count):
    def change(content):
        content["accessors"].append({"componentType": 5126, "count": count, "type": "VEC3"})

    return change


def instances(content):
    content["nodes"] += [{"mesh": 0, "name": f"n{i}"} for i in range(5000)]
    content["scenes"][0]["nodes"] = list(range(len(content["nodes"])))
    content["meshes"][0]["primitives"] *= 40


def chain_of_nodes(content):
    first = len(content["nodes"])
    content["nodes"] += [{"children": [first + i + 1], "name": f"c{i}"} for i in range(5000)] + [{"mesh": 0, "name": "end"}]
    content["scenes"][0]["nodes"] = [first]


def circle_of_nodes(content):
    content["nodes"] += [
        {"children": [len(content["nodes"]) + 1], "name": "a"},
        {"children": [len(content["nodes"])], "name": "b"},
    ]
    content["scenes"][0]["nodes"].append(len(content["nodes"]) - 1)


GLBS = {
    "an accessor without a view": (no_view(500_000_000), 5),
    "an accessor of 2^62": (no_view(1 << 62), 5),
    "an accessor below 0": (setting("accessors.0.count", -3), 6),
    "an accessor of half": (setting("accessors.0.count", 1.5), 6),
    "an accessor of words": (setting("accessors.0.count", "many"), 6),
    "a count too large": (setting("accessors.0.count", 100_000), 6),
    "another type": (setting("accessors.0.componentType", 7), 6),
    "a view beyond the end": (setting("bufferViews.0.byteOffset", 1 << 40), 6),
    "a view below 0": (setting("bufferViews.0.byteOffset", -8), 6),
    "a step of 0": (setting("bufferViews.0.byteStride", 0), 6),
    "a view of the last buffer": (setting("bufferViews.0.buffer", -1), 6),
    "another file": (setting("buffers.0.uri", "../../etc/passwd"), 2),
    "another machine": (setting("buffers.0.uri", "http://127.0.0.1:9/x.bin"), 4),
    "a texture in the text": (setting("images.0", {"uri": "data:image/png;base64,aGVsbG8="}), 6),
    "a mesh that is not there": (setting("nodes.0.mesh", 99), 6),
    "no primitives": (setting("meshes.0", {}), 6),
    "an attribute that is not there": (setting("meshes.0.primitives.0.attributes.POSITION", 99), 6),
    "200,000 instances": (instances, 5),
    "a circle of nodes": (circle_of_nodes, 6),
}
for kind, (change, item) in GLBS.items():
    case(kind, "glb", glb(change), "either" if "nodes" in kind else "refused", item)


def gaussians_ply(*lines, size=0):
    header = "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header\n"]).encode()
    return written("a.ply", header + bytes(size))


def spz(count, degree, size=0):
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, count, degree, 12, 0, 0)
    return written("a.spz", lambda: gzip.compress(header + bytes(size)))


GAUSSIANS = {
    "10^12 in the header": ("3dgs", gaussians_ply("element vertex 1000000000000", "property float x"), 5),
    "20 million without a file": ("3dgs", gaussians_ply("element vertex 20000000", "property float x", size=99), 5),
    "10 million without properties": ("3dgs", gaussians_ply("element vertex 10000000"), 5),
    "one property twice": ("3dgs", gaussians_ply("element vertex 1", *["property float x"] * 2, size=8), 6),
    "4 billion": ("spz", spz(2**32 - 1, 0), 5),
    "19 million of zeros, a bomb": ("spz", spz(19_000_000, 3, 64 << 20), 5),
    "ten times as long, a bomb": ("spz", spz(10, 0, 64 << 20), 5),
}
for kind, (reader, make, item) in GAUSSIANS.items():
    case(kind, reader, make, item=item)
case("a chain of 5,000 nodes", "glb", glb(chain_of_nodes), "either", 5)
case("a texture that is EPS", "glb", glb(images=EPS), item=4)
case("a texture of 13,000 x 13,000", "glb", glb(images=PHOTOS["13,000 x 13,000"][0]), item=5)
case("lists in lists", "glb", written("a.glb", lambda: glb_of(b'{"a":' + b"[" * 90_000 + b"]" * 90_000 + b"}")), item=6)
case("2 MB of JSON", "glb", written("a.glb", lambda: glb_of(b'{"a": "' + b"x" * (2 << 20) + b'"}')), item=5)
case("a texture that has moved", "glb", glb(setting("images.0", {"uri": "moved.png"})), "read", 6)


def glb_of(header):
    chunk_ = struct.pack("<II", len(header), 0x4E4F534A) + header
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunk_)) + chunk_


def obj_with(texture=None, **options):
    def make(folder):
        if texture is not None:
            (folder / "texture.png").write_bytes(texture)
        return honest.textured_obj(folder, **options)

    return make


case("a texture that has moved", "obj", obj_with(), "read", 6)
case("a material that has moved", "obj", obj_with(material="moved.mtl"), "read", 6)
case("a texture that is EPS", "obj", obj_with(EPS), "read", 4)
case("a texture of 13,000 x 13,000", "obj", obj_with(PHOTOS["13,000 x 13,000"][0]), "read", 5)
case("a material outside", "obj", obj_with(material="../../../../etc/passwd"), "read", 2)
short, short_uvs = (
    lambda data, kind=kind: re.sub(rb"^(%s \S+) .*$" % kind, rb"\1", data, flags=re.MULTILINE) for kind in (b"v", b"vt")
)
case("vertices of one number", "obj", changed("obj", short), item=6)
case("vertices of one number", "thuman scan", changed("thuman scan", short), item=6)
case("texture coordinates of one number", "thuman scan", changed("thuman scan", short_uvs), "either", 6)
case("a texture outside", "obj", lambda folder: honest.textured_obj(folder, "../../../../etc/passwd"), "read", 2)
MESHES = {
    "a corner of 2^30": ("scan.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 1 2 1073741824\n" * 60),
    "a corner of 10^30": ("scan.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + f"f 1 2 {10**30}\n" * 60),
    "a corner far below 0": ("scan.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f -1 -2 -999999\n" * 60),
    "a corner of 0": ("scan.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 0 1 2\n" * 60),
    "places of words": ("scan.obj", "v a b c\n" * 9 + "f 1 2 3\n" * 60),
    "places of inf": ("scan.obj", "v inf inf inf\nv 1 0 0\nv 0 1 0\n" + "f 1 2 3\n" * 60),
    "another encoding": ("scan.obj", b"\xff\xfe" * 5000 + b"\nf 1 2 3\n"),
    "one line of 4 MB": ("scan.obj", "v " + "1 " * (2 << 20)),
    "10^12 corners": ("scan.ply", "ply\nformat ascii 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n"),
    "10^12 corners in binary": (
        "scan.ply", "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n",
    ),
    "a list of 2^31": (
        "scan.ply",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nelement face 1\n"
        b"property list int int vertex_indices\nend_header\n" + struct.pack("<fi", 0, (1 << 31) - 1),
    ),
    "a header without an end": ("scan.ply", "ply\nformat ascii 1.0\n" + "comment x\n" * 100_000),
    "a type that does not exist": ("scan.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty quaternion x\nend_header\n1\n"),
    "2^32 triangles": ("scan.stl", bytes(80) + struct.pack("<I", (1 << 32) - 1) + bytes(50)),
    "text of nothing": ("scan.stl", "solid x\nfacet normal a b c\nouter loop\nvertex 1 2\nendsolid\n"),
    "10^12 corners and faces": ("scan.off", "OFF\n1000000000000 1000000000000 0\n"),
    "fewer than it says": ("scan.off", "OFF\n3 100 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
    "corners outside": ("scan.off", "OFF\n3 60 0\n0 0 0\n1 0 0\n0 1 0\n" + "3 0 1 99\n" * 60),
}  # fmt: skip
for kind, (name, data) in MESHES.items():
    expect = "either" if kind == "a corner of 0" else "refused"  # trimesh counts it from the end
    case(kind, name.split(".")[1], written(name, data), expect, 5 if "10^" in kind or "2^" in kind else 6)
for suffix in ("dae", "3mf", "gltf", "zip", "xyz", "dxf", "svg", "step", "urdf", "json", "pkl", ""):
    case(f"a file named .{suffix}", "obj", written(f"scan.{suffix}", "<?xml version='1.0'?><a/>"), item=4)


# Parts and textures -------------------------------------------------------------------------------------------------------


def many_changes(word, count):
    vertices = "".join(f"v {i} {i % 7} {i % 3}\n" for i in range(3 * count))
    return vertices + "".join(f"{word} a{i}\nf {3 * i + 1} {3 * i + 2} {3 * i + 3}\n" for i in range(count))


for word in ("o", "g", "s"):
    many = written("scan.obj", lambda w=word: many_changes(w, 30_000))
    case(f"{word} for each of 30,000 faces", "obj", many, "read", 5)
for kind, line in {
    "in comments": "# usemtl a{0}\nf {1}\n",
    "in faces": "f {1} usemtl a{0}\n",
    "in a name": "usemtl " + "usemtl " * 1000 + "\nf {1}\n",
}.items():

    def disguised(line=line):
        vertices = "".join(f"v {i} {i % 7} {i % 3}\n" for i in range(90_000))
        return vertices + "".join(
            line.format(i, f"{3 * i + 1} {3 * i + 2} {3 * i + 3}") for i in range(30_000 // line.count("u"))
        )

    case(f"usemtl {kind}, 30,000", "obj", written("scan.obj", disguised), "either", 5)
case("usemtl for each of 30,000 faces", "obj", written("scan.obj", lambda: many_changes("usemtl", 30_000)), item=5)
two = written("scan.obj", lambda: re.sub(r"usemtl a\d*(\d)", r"usemtl \1", many_changes("usemtl", 30_000)))
case("two materials, 30,000 changes", "obj", two, "read", 5)
SOLID = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 {}\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n"
solids = lambda: "".join(SOLID.format(i) for i in range(30_000))
case("30,000 solids", "stl", written("scan.stl", solids), item=5)
case("30,000 SOLIDS", "stl", written("scan.stl", lambda: solids().upper()), item=5)


def repeated(count):
    return lambda content: content["meshes"][0].update(primitives=content["meshes"][0]["primitives"] * count)


WHITE = Image.new("RGB", (3000, 3000), "white")
case("3,000 parts of a mesh", "glb", glb(repeated(3000)), item=5)
case("1,000 parts with a texture of 9 million pixels", "glb", glb(repeated(1000), image=WHITE), item=5)


def obj_with_texture(place, texture="texture.png"):
    def make(folder):
        place(folder / texture)
        return honest.textured_obj(folder, texture)

    return make


TEXTURES = {
    "a pipe": os.mkfifo,
    "a folder": lambda path: path.mkdir(),
    "an endless device": lambda path: path.symlink_to("/dev/zero"),
    "a link to itself": lambda path: path.symlink_to(path),
    "nothing": lambda path: path.touch(),
    "cut off": lambda path: path.write_bytes(honest.photo_bytes()[:200]),
    "a terabyte": huge,
}
for kind, place in TEXTURES.items():
    case(f"a texture that is {kind}", "obj", obj_with_texture(place), "read", 6)
case("a texture without a name", "obj", lambda folder: honest.textured_obj(folder, ""), "read", 6)
case("a texture that is cut off", "glb", glb(images=honest.photo_bytes()[:200]), item=6)


def nine_thousand_textures(folder):
    path = honest.write_obj(folder)
    (folder / "scan.mtl").write_text("".join(f"newmtl m{i}\nmap_Kd texture.png\n" for i in range(9000)))
    return path


case("9,000 materials of one texture", "obj", nine_thousand_textures, "read", 5)
