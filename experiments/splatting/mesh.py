"""Time of the mesh rasterizer beside that of splatting, on images of the same size.

    python experiments/splatting/mesh.py --scene demo --size 512 [--json OUT]

Rasterizes the default body (26,756 faces) as the scene's camera sees it, and splats the scene (see
`splatting/scenes.py`), in turns in one process. Half a minute. Expected: the mesh takes less time than the Gaussians; exit
status 1 if it takes more than 1.5 times as long (CPU time).
"""

import argparse
import os
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.interleaved import medians, prepare_process
from experiments.common.results import write_json
from experiments.splatting.scenes import load_scene

MOST = 1.5
"""Times the CPU time of splatting."""


def benchmark(source: str, size: int, repeats: int) -> dict[str, Any]:
    """Medians of both, and their ratio."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.body.library import load_body
    from humangs_jax.body.model import shape_body
    from humangs_jax.core.compiler_options import compiler_options
    from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh
    from humangs_jax.rendering.splatting import plan_buffers, render

    scene, body = load_scene(source, size), load_body()
    gaussians, camera = scene.gaussians(), scene.camera()
    vertices = shape_body(body, jnp.zeros(body.shape_directions.shape[-1])).vertices
    vertices = vertices + jnp.mean(gaussians.means, axis=0) - jnp.mean(vertices, axis=0)
    config = plan_buffers(gaussians, camera, margin=1.0)
    options = compiler_options()
    splat = jax.jit(lambda g: render(g, camera, config).rgb, compiler_options=options)
    mesh = jax.jit(lambda v: rasterize_mesh(v, body.faces, camera), compiler_options=options)
    covered = float((mesh(vertices).face_ids >= 0).mean())
    if covered == 0:
        raise ValueError(f"{source}: the body that stands where its Gaussians are is not in its camera's view")
    runs = {
        "splatting": lambda: jax.block_until_ready(splat(gaussians)),
        "mesh": lambda: jax.block_until_ready(mesh(vertices)),
    }
    load, times = os.getloadavg()[0], medians(runs, repeats)
    result = {
        f"{name}_{kind}": float(ms)
        for name, pair in times.items()
        for kind, ms in zip(("ms", "cpu_ms"), pair, strict=True)
    }
    result |= {"ratio_cpu": result["mesh_cpu_ms"] / result["splatting_cpu_ms"], "faces": len(body.faces)}
    return result | {"gaussians": len(scene.means), "size": size, "covered": covered, "load_average": load}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="demo", help="npz of a scene, or 'demo'")
    parser.add_argument("--size", type=int, default=512, help="side of the image, pixels")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    prepare_process()
    result = benchmark(arguments.scene, arguments.size, arguments.repeats)
    print(
        f"{result['faces']:,} faces on {result['covered']:.0%} of {arguments.size} x {arguments.size}: "
        f"{result['mesh_ms']:.1f} ms, CPU {result['mesh_cpu_ms']:.1f}\n"
        f"{result['gaussians']:,} Gaussians: {result['splatting_ms']:.1f} ms, CPU {result['splatting_cpu_ms']:.1f}\n"
        f"mesh / splatting, CPU: {result['ratio_cpu']:.2f} (load {result['load_average']:.1f})"
    )
    if arguments.json:
        write_json(arguments.json, result)
    sys.exit(result["ratio_cpu"] > MOST)


if __name__ == "__main__":
    main()
