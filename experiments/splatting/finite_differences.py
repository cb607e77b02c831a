"""Finite differences of an image's error against the gradient of the camera: what the cuts of splatting leave out.

    python experiments/splatting/finite_differences.py --page docs/numerics.md

The shipped person in the pose and before the camera of its first photo, 128 x 128 pixels, float64; the loss is the mean squared
error to the image of a camera that is a little off (`AWAY`). Central differences for the six numbers of a camera twist (rotation,
translation), radians and metres.
"""

import argparse
import dataclasses
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish

TABLE = "splatting_finite_differences"
SIZE = 128
STEPS = (1e-3, 1e-4)
AWAY = (0.02, -0.03, 0.01, 0.02, 0.01, -0.03)
"""Radians and metres."""
CUTS = {
    "as drawn: alpha_min 1/255, transmittance_stop 1e-4": {},
    "alpha_min 1e-6": {"alpha_min": 1e-6},
    "alpha_min 1e-6, transmittance_stop 0": {"alpha_min": 1e-6, "transmittance_stop": 0.0},
}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", type=Path, help="page whose table is written")
    arguments = parser.parse_args()
    results = measure()
    text = section(results)
    print(text)
    if arguments.page:
        publish(arguments.page, TABLE, text, results)


def measure(size: int = SIZE) -> dict[str, list[float]]:
    """Relative L2 difference of the twist's gradient, by setting, for each of `STEPS`."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from experiments.splatting.scenes import load_scene
    from humangs_jax.core.pytree import replace
    from humangs_jax.geometry import transform
    from humangs_jax.rendering.splatting import SplatConfig, plan_buffers, render

    scene = load_scene("demo", size)
    jax.config.update("jax_enable_x64", True)
    gaussians, camera = scene.gaussians(np.float64), scene.camera(np.float64)

    def drawn(twist, gaussians, config):
        x, y, z = twist[:3]
        turn = jax.scipy.linalg.expm(jnp.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
        moved = replace(camera, cam_from_world=transform.make(turn, twist[3:]) @ camera.cam_from_world)
        return render(gaussians, moved, config).rgb

    target = jax.jit(drawn)(jnp.asarray(AWAY), gaussians, plan_buffers(gaussians, camera, margin=1.5))
    both = jax.jit(jax.value_and_grad(lambda *given: jnp.mean(jnp.square(drawn(*given) - target))))
    results = {}
    for name, cuts in CUTS.items():
        config = plan_buffers(gaussians, camera, dataclasses.replace(SplatConfig(), **cuts), margin=1.5)
        gradient = np.asarray(both(jnp.zeros(6), gaussians, config)[1])
        value = lambda twist, config=config: float(both(jnp.asarray(twist), gaussians, config)[0])
        results[name] = []
        for step in STEPS:
            differences = [(value(step * axis) - value(-step * axis)) / (2 * step) for axis in np.eye(6)]
            results[name].append(float(np.linalg.norm(differences - gradient) / np.linalg.norm(gradient)))
    return results


def section(results: dict[str, list[float]]) -> str:
    """The table."""
    rows = [[name, *(f"{difference:.2%}" for difference in found)] for name, found in results.items()]
    return markdown_table(["cuts", *(f"step {step:g}" for step in STEPS)], rows)


if __name__ == "__main__":
    main()
