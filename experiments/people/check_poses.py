"""Measure the pose prior and the sequences: self-penetration, soles on the ground, sliding; optionally strips of frames.

    python experiments/people/check_poses.py --json OUT [--poses 200] [--sequences 12] [--strips FOLDER]

About 80 s of one CPU core. Expect: 0.85 % of the vertices inside another part, nearly all in creases of armpits and
groin, 0.11 % of them without these parts; planted soles within 6 mm of the ground, which slide by 0.1 mm a frame in walks
and less in the rest.
"""

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

CREASES = ("shoulder", "collar", "spine3", "pelvis", "hip")
"""Parts whose skin folds into itself where blend skinning bends it, whatever the pose is."""
TOUCHING = 4e-3
"""Metres above its lowest point at which a sole touches the ground."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, help="the numbers")
    parser.add_argument("--poses", type=int, default=200, help="poses of the prior")
    parser.add_argument("--sequences", type=int, default=12, help="sequences of 60 frames, of all kinds in turn")
    parser.add_argument("--strips", type=Path, help="folder for poses.png and sequences.png")
    arguments = parser.parse_args()

    import numpy as np

    from experiments.people.overlap import OverlapMeter
    from humangs_jax.body.library import load_body
    from humangs_jax.people.kinematics import Build
    from humangs_jax.people.poses import sample_rotations
    from humangs_jax.people.sequences import KINDS, sample_sequence

    body = load_body()
    joints = np.asarray(body.joint_regressor @ body.template, float)
    build = Build(joints, body.parents, torso_radius=0.13, thigh_radius=0.1, shin_radius=0.08, arm_radius=0.035)
    poses = [sample_rotations(np.random.default_rng(seed), build) for seed in range(arguments.poses)]
    kinds = [list(KINDS)[i % len(KINDS)] for i in range(arguments.sequences)]
    sequences = [sample_sequence(np.random.default_rng(i), build, 60, kind) for i, kind in enumerate(kinds)]

    meter = OverlapMeter(body)
    numbers = {
        "poses": penetration(meter, poses) | limits(poses),
        "sequences": penetration(meter, [r for s in sequences for r in s.rotations[::10]]),
        "feet": {kind: sliding(body, [s for s in sequences if s.kind == kind]) for kind in KINDS},
    }
    arguments.json.write_text(json.dumps(numbers, indent=1) + "\n")
    print(json.dumps(numbers, indent=1))
    if arguments.strips:
        arguments.strips.mkdir(parents=True, exist_ok=True)
        draw_strips(body, poses, sequences, arguments.strips)


def penetration(meter, poses) -> dict:
    """Share of the body's vertices inside another part, and the same without the parts that fold in every pose."""
    import numpy as np

    part = np.asarray(meter.body.skinning_weights).argmax(1)
    names = np.asarray(meter.body.joint_names)[part]
    folds = np.asarray([any(crease in name for crease in CREASES) for name in names])
    inside = np.stack([meter.inside(rotations) for rotations in poses])
    shares, limbs = inside.mean(1), (inside & ~folds).mean(1)
    where = {name: int(inside[:, names == name].sum()) for name in sorted(set(names))}
    return {
        "count": len(poses),
        "mean_share_inside": float(shares.mean()),
        "max_share_inside": float(shares.max()),
        "mean_share_inside_without_creases": float(limbs.mean()),
        "max_share_inside_without_creases": float(limbs.max()),
        "vertices_by_part": dict(sorted(where.items(), key=lambda item: -item[1])[:8]),
    }


def limits(poses) -> dict:
    """Spread of the joints' angles (degrees), and the largest share of a limit that is used."""
    import numpy as np

    from humangs_jax.people.kinematics import LIMITS

    angles = np.linalg.norm(np.stack(poses), axis=-1)
    used = {joint: angles[:, joint].max() / limit for joint, limit in enumerate(LIMITS) if limit > 0}
    spread = np.rad2deg(np.stack(poses).std(0)).mean(1)
    return {
        "largest_share_of_a_limit": float(max(used.values())),
        "mean_spread_of_body_joints_degrees": float(spread[:22].mean()),
        "mean_spread_of_finger_joints_degrees": float(spread[25:].mean()),
    }


def sliding(body, sequences) -> dict:
    """How far the touching points of planted soles move in a frame, and how high planted soles are."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.body.model import BodyPose, pose_body, shape_body

    part = np.asarray(body.skinning_weights).argmax(1)
    feet = [np.flatnonzero(np.isin(part, (7 + side, 10 + side))) for side in (0, 1)]
    rest = shape_body(body, jnp.zeros(0))
    pose = jax.jit(lambda r, t: pose_body(body, rest, BodyPose(r, t)).vertices)
    slides, heights, lowest_ever = [], [], np.inf
    for s in sequences:
        vertices = [
            np.asarray(pose(jnp.asarray(r, jnp.float32), jnp.asarray(t, jnp.float32)))
            for r, t in zip(s.rotations, s.translations, strict=True)
        ]
        for side in (0, 1):
            low = np.asarray([v[feet[side], 1].min() for v in vertices])
            heights += low[s.planted[:, side]].tolist()
            lowest_ever = min(lowest_ever, low.min())
            for f in np.flatnonzero(s.planted[:-1, side] & s.planted[1:, side]):
                now, then = vertices[f][feet[side]], vertices[f + 1][feet[side]]
                touching = (now[:, 1] < low[f] + TOUCHING) & (then[:, 1] < low[f + 1] + TOUCHING)
                slides += np.linalg.norm((then - now)[touching][:, [0, 2]], axis=1).tolist()
    return {
        "sequences": len(sequences),
        "mean_slide_mm_per_frame": 1e3 * float(np.mean(slides)),
        "p99_slide_mm_per_frame": 1e3 * float(np.quantile(slides, 0.99)),
        "planted_sole_mm": [1e3 * float(np.min(heights)), 1e3 * float(np.max(heights))],
        "lowest_point_mm": 1e3 * float(lowest_ever),
    }


def draw_strips(body, poses, sequences, folder: Path) -> None:
    """poses.png: 40 of the poses. sequences.png: a row of 12 frames for each sequence. The bare body, grey."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.body.model import BodyPose, pose_body, shape_body
    from humangs_jax.geometry.camera import intrinsics_from_fov, look_at
    from humangs_jax.io.images import write_png
    from humangs_jax.rendering.mesh.position_map import vertex_normals
    from humangs_jax.rendering.mesh.rasterizer import interpolate_attributes, rasterize_mesh

    size, rest = 160, shape_body(body, jnp.zeros(0))
    pose = jax.jit(lambda r, t: pose_body(body, rest, BodyPose(r, t)).vertices)

    def draw(rotations, translation, azimuth, grounded):
        vertices = pose(jnp.asarray(rotations, jnp.float32), jnp.asarray(translation, jnp.float32))
        if grounded:
            vertices = vertices - jnp.asarray([0, 1.0, 0]) * vertices[:, 1].min()
        target = jnp.asarray([translation[0], 0.85, translation[2]], jnp.float32)
        eye = target + jnp.asarray([2.7 * np.sin(azimuth), 0.3, 2.7 * np.cos(azimuth)], jnp.float32)
        camera = look_at(eye, target, jnp.asarray([0.0, 1.0, 0.0]), intrinsics_from_fov(0.75, size, size), size, size)
        light = jnp.asarray([0.3, 0.8, 0.5]) / jnp.linalg.norm(jnp.asarray([0.3, 0.8, 0.5]))
        bright = 0.35 + 0.6 * jnp.clip(vertex_normals(vertices, body.faces) @ light, 0, 1)
        grey = jnp.repeat(bright[:, None], 3, axis=1)
        return np.asarray(
            interpolate_attributes(rasterize_mesh(vertices, body.faces, camera), body.faces, grey, jnp.ones(3))
        )

    pictures = [draw(r, np.zeros(3), 0.6 if i % 2 else -0.5, True) for i, r in enumerate(poses[:40])]
    rows = [np.concatenate(pictures[i : i + 10], 1) for i in range(0, len(pictures) // 10 * 10, 10)]
    if rows:
        write_png(folder / "poses.png", np.concatenate(rows))
    strips = []
    for s in sequences[:8]:
        shown = np.linspace(0, len(s.rotations) - 1, 12).astype(int)
        strips.append(np.concatenate([draw(s.rotations[i], s.translations[i], 0.9, False) for i in shown], 1))
    if strips:
        write_png(folder / "sequences.png", np.concatenate(strips))


if __name__ == "__main__":
    main()
