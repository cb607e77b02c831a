"""Screenshots of an avatar's page (docs/viewer.md) and of exported files in programs that are not ours (docs/export.md).

Browser: Chromium with software WebGL. viewer: our page, as `humangs export --html` writes it, in a window of 1280 x 800.

Gaussians: the PlayCanvas engine (SuperSplat's) opens .ply and .glb, Spark .splat and .spz. The mesh: three.js opens .glb, at four
times of the shipped walk, and .obj. Every page gets files and modules from a server on this machine; nothing else is loaded.
Blender (its Python module, a version for the Python at hand) opens both and renders them with Cycles.
"""

import contextlib
import functools
import json
import subprocess
import tempfile
import threading
import time
from collections.abc import Generator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from experiments import chromium
from experiments.harness import Run, entry
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export.gaussians import export
from humangs_jax.data.motion import load_motion
from humangs_jax.io.images import read_image
from humangs_jax.viewer.page import write_page

WIDTH, HEIGHT = 320, 480
WINDOW, WAIT = (1280, 800), 4.0
"""Of our page: CSS pixels, and seconds of the walk before the picture is taken."""
PAGE = """<!doctype html><meta charset="utf-8"><style>body { margin: 0; background: #fff } canvas { display: block }</style>
<script type="importmap">%(imports)s</script><canvas id="canvas" width="%(width)d" height="%(height)d"></canvas>
<script type="module">%(script)s</script>"""
IMPORTS = {
    "imports": {
        "three": "/node_modules/three/build/three.module.js",
        "three/addons/": "/node_modules/three/examples/jsm/",
        "@sparkjsdev/spark": "/node_modules/@sparkjsdev/spark/dist/spark.module.js",
        "playcanvas": "/node_modules/playcanvas/build/playcanvas.mjs",
    }
}
THREE = """
import * as THREE from "three";
const canvas = document.getElementById("canvas");
const renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(30, canvas.width / canvas.height, 0.1, 50);
scene.background = new THREE.Color(0xffffff);
scene.add(new THREE.AmbientLight(0xffffff, Math.PI));
camera.position.set(1.35, 1.25, 4.1);
camera.lookAt(0, 0.85, 0);
const frames = async (count) => {
  for (let i = 0; i < count; i++) {
    await new Promise(requestAnimationFrame);
    renderer.render(scene, camera);
  }
};
"""
MESH_GLB = (
    THREE
    + """
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
window.humangs = { ready: (async () => {
  const gltf = await new GLTFLoader().loadAsync("mesh.glb");
  scene.add(gltf.scene);
  const mixer = new THREE.AnimationMixer(gltf.scene);
  mixer.clipAction(gltf.animations[0]).play();
  mixer.setTime(%(time)f);
  gltf.scene.traverse((part) => { part.frustumCulled = false; });
  const hips = gltf.scene.getObjectByName("pelvis").getWorldPosition(new THREE.Vector3());
  camera.position.add(new THREE.Vector3(hips.x, 0, hips.z));
  await frames(3);
})() };
"""
)
MESH_OBJ = (
    THREE
    + """
import { OBJLoader } from "three/addons/loaders/OBJLoader.js";
import { MTLLoader } from "three/addons/loaders/MTLLoader.js";
window.humangs = { ready: (async () => {
  const loaded = new Promise((done) => { THREE.DefaultLoadingManager.onLoad = done; });
  const materials = await new MTLLoader().loadAsync("mesh.mtl");
  materials.preload();
  scene.add(await new OBJLoader().setMaterials(materials).loadAsync("mesh.obj"));
  await loaded;  // the texture
  await frames(3);
})() };
"""
)
SPARK = (
    THREE
    + """
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
window.humangs = { ready: (async () => {
  scene.add(new SparkRenderer({ renderer }));
  const splats = new SplatMesh({ url: "%(file)s" });
  splats.quaternion.set(%(turn)s);
  scene.add(splats);
  await splats.initialized;
  for (let i = 0; i < 40; i++) {  // its workers sort meanwhile
    await frames(1);
    await new Promise((done) => setTimeout(done, 100));
  }
})() };
"""
)
PLAYCANVAS = """
import * as pc from "playcanvas";
const canvas = document.getElementById("canvas");
const app = new pc.Application(canvas, { graphicsDeviceOptions: { preserveDrawingBuffer: true } });
app.setCanvasFillMode(pc.FILLMODE_NONE);
app.setCanvasResolution(pc.RESOLUTION_FIXED, canvas.width, canvas.height);
app.start();
const camera = new pc.Entity();
camera.addComponent("camera", { clearColor: new pc.Color(1, 1, 1), fov: 30, nearClip: 0.1, farClip: 50 });
camera.setPosition(1.35, 1.25, 4.1);
camera.lookAt(0, 0.85, 0);
app.root.addChild(camera);
window.humangs = { ready: (async () => {
  const asset = new pc.Asset("person", "%(kind)s", { url: "%(file)s" });
  const loaded = new Promise((done, fail) => { asset.on("load", done); asset.on("error", (e) => fail(new Error(e))); });
  app.assets.add(asset);
  app.assets.load(asset);
  await loaded;
  let person;
  if ("%(kind)s" === "container") person = asset.resource.instantiateRenderEntity();
  else {
    person = new pc.Entity();
    person.addComponent("gsplat", { asset });
    person.setLocalEulerAngles(0, 0, 180);  // as SuperSplat turns .ply files
  }
  app.root.addChild(person);
  for (let i = 0; i < 40; i++) {
    await new Promise(requestAnimationFrame);
    await new Promise((done) => setTimeout(done, 100));
  }
})() };
"""
BLENDER = """
import math, sys
import bpy
from mathutils import Vector
out, frames = sys.argv[1], [int(text) for text in sys.argv[2].split(",")]
def rendered(name, frame):
    scene = bpy.context.scene
    scene.frame_set(frame)
    body = next(part for part in bpy.data.objects if part.type == "MESH" and len(part.data.vertices) > 1000)
    shown = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = [shown.matrix_world @ vertex.co for vertex in shown.to_mesh().vertices]
    middle = Vector((sum(p.x for p in points) / len(points), sum(p.y for p in points) / len(points), 0.85))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera, camera.data.sensor_fit, camera.data.angle = camera, "VERTICAL", math.radians(30)
    camera.location = middle + Vector((1.35, -4.1, 0.4))
    camera.rotation_euler = (middle - camera.location).to_track_quat("-Z", "Y").to_euler()
    scene.world = bpy.data.worlds.new("white")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[0].default_value = (1, 1, 1, 1)
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 8
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x, scene.render.resolution_y = %(width)d, %(height)d
    scene.render.filepath = f"{out}/{name}.png"
    bpy.ops.render.render(write_still=True)
for frame in frames:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = 24
    bpy.ops.import_scene.gltf(filepath=f"{out}/mesh.glb")
    rendered(f"glb_{frame}", frame)
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.obj_import(filepath=f"{out}/mesh.obj")
rendered("obj", 0)
"""
BLENDER_FRAMES = (0, 12, 24, 36)
ABOUT_Y = "0, 1, 0, 0"
BOTH = "0, 0, 1, 0"
SHEETS = {
    "export_gaussians": [
        (".ply in PlayCanvas", PLAYCANVAS, {"file": "person.ply", "kind": "gsplat"}),
        (".glb in PlayCanvas", PLAYCANVAS, {"file": "person.glb", "kind": "container"}),
        (".splat in Spark", SPARK, {"file": "person.splat", "turn": BOTH}),
        (".spz in Spark", SPARK, {"file": "person.spz", "turn": ABOUT_Y}),
    ],
    "export_mesh": [
        *((f"mesh.glb in three.js, {time:g} s", MESH_GLB, {"time": time}) for time in (0.0, 0.5, 1.0, 1.5)),
        (".obj in three.js", MESH_OBJ, {}),
    ],
}
"""Screenshots side by side: what it shows, the page, what goes into it."""


@entry
def export_screenshots(
    run: Run,
    avatar: Path,
    modules: Path | None = None,
    blender: Path | None = None,
    out: Path = Path("docs/images"),
    only: tuple[Literal["viewer", "export_gaussians", "export_mesh"], ...] = (),
) -> None:
    """Screenshots of exported avatars in public programs, and of the viewer.

    Options:
    avatar: file written by humangs reconstruct
    modules: folder node_modules with the programs; without it: viewer alone
    blender: a Python that has Blender's module bpy
    out: folder for the images
    only: default: all
    """
    wanted = only or ("viewer", *(sorted(SHEETS) if modules else ()))
    sheets = [name for name in wanted if name in SHEETS]
    if sheets and modules is None:
        raise ValueError(f"{sheets[0]} needs --modules")
    if (reason := chromium.missing()) is not None:
        raise ValueError(reason)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "viewer" in wanted:
            write_viewer(out / "viewer.png", folder, avatar)
        if sheets or blender:
            write_files(folder, avatar)
        if blender is not None:
            write_blender_sheet(out / "export_blender.jpg", folder, blender)
        if not sheets or modules is None:
            return
        (folder / "node_modules").symlink_to(modules.resolve())
        with served(folder) as address, chromium.Chromium(WIDTH, HEIGHT) as browser:
            for sheet in sheets:
                write_sheet(out / f"{sheet}.jpg", folder, address, browser, SHEETS[sheet])


def write_viewer(path: Path, folder: Path, avatar: Path) -> None:
    """The page of an avatar a moment after it was opened. Raises: RuntimeError for a page that shows nothing."""
    write_page(folder / "avatar.html", Avatar.load(avatar))
    with chromium.Chromium(*WINDOW) as browser:
        browser.open(folder / "avatar.html")
        time.sleep(WAIT)
        image = browser.screenshot()
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def write_files(folder: Path, path: Path) -> None:
    """One person in every format."""
    avatar = Avatar.load(path)
    for suffix in (".ply", ".glb", ".splat", ".spz"):
        export(folder / f"person{suffix}", avatar)
    export(folder / "mesh.glb", avatar, load_motion(rest_joints=avatar.rest_joints), mesh=True)
    export(folder / "mesh.obj", avatar, mesh=True)


@contextlib.contextmanager
def served(folder: Path) -> Generator[str]:
    """The address at which a folder is served on this machine."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format, *args):
            """Nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()


def write_sheet(path: Path, folder: Path, address: str, browser, shots) -> None:
    """Take the screenshots of a sheet and write them side by side. Raises: RuntimeError for a page that shows nothing."""
    images = []
    for number, (title, page, values) in enumerate(shots):
        frame = {"imports": json.dumps(IMPORTS), "width": WIDTH, "height": HEIGHT, "script": page % values}
        name = f"{path.stem}_{number}.html"  # each its own: the browser may keep a page of the same address
        (folder / name).write_text(PAGE % frame)
        browser.open(f"{address}/{name}")
        image = browser.screenshot()
        problems = [line for line in browser.problems() if "favicon" not in line]
        person = float((np.abs(image - 1).max(axis=-1) > 0.1).mean())
        print(f"{title}: the person covers {person:.1%}", *problems, sep="\n  ", flush=True)
        if person < 0.02:
            raise RuntimeError(f"{title}: nothing is seen")
        images.append(image)
    save_sheet(path, images)


def write_blender_sheet(path: Path, folder: Path, python: Path) -> None:
    """Render the mesh in Blender and write the images side by side. Raises: CalledProcessError."""
    script = BLENDER % {"width": WIDTH, "height": HEIGHT}
    subprocess.run([python, "-c", script, folder, ",".join(map(str, BLENDER_FRAMES))], check=True, capture_output=True)
    names = [*(f"glb_{frame}" for frame in BLENDER_FRAMES), "obj"]
    save_sheet(path, [read_image(folder / f"{name}.png")[0] for name in names])


def save_sheet(path: Path, images: list) -> None:
    pixels = np.rint(255 * np.concatenate(images, axis=1)).astype(np.uint8)
    Image.fromarray(pixels).save(path, quality=85, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")
