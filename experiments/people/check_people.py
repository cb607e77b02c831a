"""Count what is wrong with synthetic people, and how much they differ.

    python experiments/people/check_people.py --subjects 200 --json OUT [--described 1000]
        [--plots docs/images/people_diversity.png]

Faults are counted in images of random poses from random cameras, as shares of the person's pixels:
- poking: skin that lies inside of a hem and is seen although the OUTER side of cloth is at most 6 cm behind it on the same ray,
  of which skin deeper than 1 cm inside of the hem is `poking_deep`. (Skin seen up a sleeve or under a skirt has the inner side
  of cloth behind it: no fault.) Skin that cloth covers well is not in the mesh at all and cannot poke: see `hollow`.
- inside: all skin deeper than 1 cm inside of a hem that is seen at all, rightly (up a sleeve) or not: an upper bound.
- hollow: the INNER side of cloth is seen where the naked body, posed alike, would be at least 1 cm nearer: one looks through a
  neckline, a cuff or a hem into empty clothes.
- gaps: the background is seen where the naked body would be.
Diversity is that of descriptions (`person.describe`: shape, garments, colors, hair; a millisecond each) and of images
(foreground share, colors as seen, joint angles). 1,000 descriptions take 3 s, 1,000 subjects with images about 15 minutes
on 2 CPU cores. Expected: poking below 0.1 %.
"""

import argparse
import collections
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish, write_json

DEPTH, HOLLOW_DEPTH = 0.06, 0.01
"""Metres: how far behind poking skin its cloth may lie; how much nearer the missing body must be."""
FAULTS = {
    "poking": "skin inside of a hem (deeper than 0) is seen although the outer side of cloth is at most 6 cm behind it on the "
    "ray",
    "poking_deep": "of it, skin more than 1 cm inside of the hem",
    "inside": "all skin more than 1 cm inside of a hem that is seen at all, rightly (up a sleeve, under a skirt) or not: an "
    "upper bound of what pokes",
    "hollow": "the inner side of cloth is seen where the naked body would be at least 1 cm nearer: one looks into empty clothes",
    "gaps": "the background is seen where the naked body would be",
}
SPREADS = {
    "stature": ("stature, m", 2),
    "years": ("years", 0),
    "weight": ("weight coefficient", 2),
    "muscle": ("muscle coefficient", 2),
    "skin_brightness": ("brightness of the skin", 2),
    "foreground_share": ("share of the picture that is person", 3),
}
"""Rows of the table of diversity, and their digits."""
DEEP = 0.01
"""Metres inside of a hem: deep."""
SHARE_BINS = 40


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=50, help="people that are built, posed and rendered")
    parser.add_argument("--described", type=int, default=1000, help="people whose descriptions are counted")
    parser.add_argument("--poses", type=int, default=2, help="poses of every built person")
    parser.add_argument("--views", type=int, default=2, help="cameras around every pose")
    parser.add_argument("--size", type=int, default=256, help="side of the pictures")
    parser.add_argument("--first", type=int, default=0, help="first seed (training people by default)")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--page", type=Path, help="page whose tables people_faults and people_diversity are written")
    parser.add_argument("--plots", type=Path, help="write the diversity plots here")
    parser.add_argument("--worst", type=int, default=0, help="print the seeds with most faults")
    arguments = parser.parse_args()

    from humangs_jax.body.library import load_body

    body = load_body()
    people = describe_all(body, arguments)
    seen, faults = look_at_all(body, arguments)
    result = {**people["numbers"], **seen["numbers"]}
    print(json.dumps(result, indent=1))
    for name in ("poking", "hollow", "gaps"):
        if arguments.worst:
            ranked = sorted(faults, key=lambda row: -row[name])[: arguments.worst]
            print(name, [(row["seed"], row["pose"], f"{row[name]:.2%}") for row in ranked])
    if arguments.json:
        write_json(arguments.json, result)
    if arguments.page:
        publish(arguments.page, "people_faults", faults_table(result), {name: result[name] for name in FAULTS})
        publish(arguments.page, "people_diversity", diversity_table(result), result)
    if arguments.plots:
        draw(arguments.plots, people, seen)


def faults_table(result: dict[str, Any]) -> str:
    """One row for each fault."""
    rows = []
    for name, definition in FAULTS.items():
        mean, worst, poses = (result[name][key] for key in ("mean", "worst", "poses_above_0.1_percent"))
        rows.append([name.replace("_", ", "), definition, f"{mean:.4%}", f"{worst:.2%}", f"{poses:.1%}"])
    return markdown_table(["fault", "definition", "mean", "worst pose", "poses above 0.1 %"], rows, "lllll")


def diversity_table(result: dict[str, Any]) -> str:
    """One row for each measure."""
    rows = [[label, *(f"{x:.{digits}f}" for x in result[name].values())] for name, (label, digits) in SPREADS.items()]
    header = [
        f"of {result['described']:,} people",
        "mean",
        "standard deviation",
        "least",
        "5 %",
        "median",
        "95 %",
        "most",
    ]
    return markdown_table(header, rows, "l" * len(header))


def describe_all(body, arguments):
    """Counts and spreads over descriptions."""
    import numpy as np

    from humangs_jax.people.subject import describe

    people = [describe(arguments.first + i, body) for i in range(arguments.described)]
    kinds = collections.Counter(g.kind for p in people for g in p.garments)
    patterns = collections.Counter(g.fabric.pattern for p in people for g in p.garments)
    cuts = collections.Counter(p.haircut.cut for p in people)
    beards = collections.Counter(p.haircut.beard for p in people)
    betas = np.stack([p.betas for p in people])
    stature, years = np.asarray([p.stature for p in people]), np.asarray([p.years for p in people])
    skin = np.stack([p.complexion.skin for p in people])
    hues = _hues(np.stack([g.fabric.base for p in people for g in p.garments]))
    outfits = {tuple(sorted(g.kind for g in p.garments)) for p in people}
    numbers = {
        "described": len(people),
        "men": float(np.mean([p.male for p in people])),
        "stature": _spread(stature),
        "years": _spread(years),
        "weight": _spread(betas[:, body.shape_names.index("weight")]),
        "muscle": _spread(betas[:, body.shape_names.index("muscle")]),
        "shape_standard_deviations": dict(zip(body.shape_names, np.round(betas.std(0), 2).tolist(), strict=True)),
        "skin_brightness": _spread(skin.mean(1)),
        "garment_kinds": len(kinds),
        "garments": dict(kinds.most_common()),
        "garments_per_person": float(np.mean([len(p.garments) for p in people])),
        "different_sets_of_garments": len(outfits),
        "patterns": dict(patterns.most_common()),
        "haircuts": dict(cuts.most_common()),
        "beards": dict(beards.most_common()),
        "dyes_by_hue": hues,
    }
    return {
        "numbers": numbers,
        "stature": stature,
        "years": years,
        "betas": betas,
        "male": [p.male for p in people],
        "skin": skin,
    }


def look_at_all(body, arguments):
    """Faults, foreground shares, colors and angles of built people; and a row of faults for every pose."""
    import numpy as np

    from humangs_jax.people import cameras, rendering
    from humangs_jax.people.subject import make_subject
    from humangs_jax.people.writer import sample_pose

    rows, colors, angles, shares = [], np.zeros((12, 4, 4)), [], []
    for i in range(arguments.subjects):
        seed = arguments.first + i
        subject = make_subject(seed, body)
        for pose in range(arguments.poses):
            posed = sample_pose(subject, pose)
            angles.append(np.linalg.norm(posed.rotations, axis=1))
            rng = np.random.default_rng([seed, 77, pose])
            batch = cameras.cameras_around(
                rng, posed.vertices, cameras.spread_azimuths(rng, arguments.views), arguments.size
            )
            counts = np.zeros(1 + len(FAULTS))
            for k in range(arguments.views):
                counts += count_faults(body, posed, batch[k])
                if pose == 0 and k == 0:
                    image, mask = rendering.render_view(posed, batch[k])
                    colors += _color_histogram(image[mask == 1])
                    shares.append(float(mask.mean()))
            rows.append(
                {"seed": seed, "pose": pose, "pixels": counts[0]}
                | dict(zip(FAULTS, counts[1:] / counts[0], strict=True))
            )
    pixels = np.asarray([row["pixels"] for row in rows])
    numbers: dict = {"built": arguments.subjects, "pictures": len(rows) * arguments.views}
    for name in FAULTS:
        each = np.asarray([row[name] for row in rows])
        numbers[name] = {
            "mean": float((each * pixels).sum() / pixels.sum()),
            "worst": float(each.max()),
            "poses_above_0.1_percent": float((each > 1e-3).mean()),
        }
    numbers["foreground_share"] = _spread(np.asarray(shares))
    numbers["colour_cells_used"] = float((colors / colors.sum() > 1e-3).mean())
    angles = np.stack(angles)
    return {"numbers": numbers, "colours": colors, "angles": angles, "shares": np.asarray(shares)}, rows


def count_faults(body, posed, camera):
    """(6,) pixels of the person, then those of FAULTS."""
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.body.model import BodyPose, pose_body, shape_body
    from humangs_jax.people.rendering import padded
    from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh

    subject = posed.subject
    faces, materials = subject.surface.faces, subject.face_materials
    everything = rasterize_mesh(*padded(posed.vertices, faces), camera)
    ids = np.asarray(everything.face_ids)
    seen, depth = ids >= 0, np.asarray(everything.depth)
    weights = np.asarray(everything.barycentrics)
    cover = (subject.cover[faces[ids]] * weights).sum(-1)
    inside = seen & (materials[ids] == 0) & (cover > 0)
    cloth = np.where((materials >= 2)[:, None], faces, 0)
    behind = rasterize_mesh(*padded(posed.vertices, cloth), camera)
    cloth_ids, cloth_depth = np.asarray(behind.face_ids), np.asarray(behind.depth)
    eye = np.asarray(camera.center)
    outer = (cloth_ids >= 0) & _faces_the_eye(posed.vertices, faces, eye)[cloth_ids]
    poking = inside & outer & (cloth_depth - depth < DEPTH)
    pose = BodyPose(jnp.asarray(posed.rotations), jnp.asarray(posed.translation))
    naked = pose_body(body, shape_body(body, jnp.asarray(subject.betas)), pose)
    body_alone = rasterize_mesh(naked.vertices, body.faces, camera)
    bare, bare_depth = np.asarray(body_alone.face_ids) >= 0, np.asarray(body_alone.depth)
    inner = seen & (materials[ids] >= 2) & ~_faces_the_eye(posed.vertices, faces, eye)[ids]
    hollow = inner & bare & (depth - bare_depth > HOLLOW_DEPTH)
    deep = cover > DEEP
    found = (seen, poking, poking & deep, inside & deep, hollow, bare & ~seen)
    return np.asarray([pixels.sum() for pixels in found], float)


def _faces_the_eye(vertices, faces, eye):
    import numpy as np

    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.sum(np.cross(b - a, c - a) * (eye - a), -1) > 0


def _spread(values):
    import numpy as np

    marks = dict(
        zip(
            ("least", "5_percent", "median", "95_percent", "most"),
            np.percentile(values, [0, 5, 50, 95, 100]),
            strict=True,
        )
    )
    marks = {"mean": values.mean(), "standard_deviation": values.std(), **marks}
    return {name: round(float(value), 4) for name, value in marks.items()}


def _hsv(colors):
    """(n, 3) hue, saturation, value of (n, 3) colors."""
    import numpy as np

    high, low = colors.max(-1), colors.min(-1)
    chroma = np.maximum(high - low, 1e-9)
    r, g, b = colors.T
    hue = np.select([high == r, high == g], [((g - b) / chroma) % 6, (b - r) / chroma + 2], (r - g) / chroma + 4) / 6
    return np.stack([hue % 1, (high - low) / np.maximum(high, 1e-9), high], -1)


def _hues(colors):
    """Shares of dyes: neutral ones and 12 hues."""
    import numpy as np

    hue, saturation, _ = _hsv(colors).T
    colored = saturation > 0.15
    counts = np.bincount((hue[colored] * 12).astype(int) % 12, minlength=12)
    names = ["red", "orange", "yellow", "lime", "green", "sea", "cyan", "azure", "blue", "violet", "magenta", "rose"]
    shares = {"neutral": round(float((~colored).mean()), 3)}
    return shares | {name: round(float(c) / len(colors), 3) for name, c in zip(names, counts, strict=True)}


def _color_histogram(pixels):
    """(12, 4, 4) counts of hue, saturation, value, each image with the same weight."""
    import numpy as np

    cells = np.minimum((_hsv(pixels) * [12, 4, 4]).astype(int), [11, 3, 3])
    counts = np.zeros((12, 4, 4))
    np.add.at(counts, tuple(cells.T), 1 / max(len(pixels), 1))
    return counts


def draw(file, people, seen):
    """One image of eight plots."""
    import colorsys

    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    from humangs_jax.people import kinematics as poses

    figure = plt.figure(figsize=(17, 9.5))
    grid = figure.add_gridspec(2, 5)
    stature, years, build, share, worn, woven, hue, bent = (
        figure.add_subplot(grid[at])
        for at in ((0, 0), (0, 1), (0, 2), (0, 3), (slice(None), 4), (1, 0), (1, slice(1, 3)), (1, 3))
    )
    male, numbers = np.asarray(people["male"]), people["numbers"]
    for values, name, ax in ((people["stature"], "stature, m", stature), (people["years"], "years", years)):
        ax.hist([values[male], values[~male]], 30, stacked=True, label=["men", "women"])
        ax.set_xlabel(name)
        ax.legend()
    build.scatter(people["stature"], people["betas"][:, 2], s=6, c=np.clip(people["skin"], 0, 1))
    build.set_xlabel("stature, m")
    build.set_ylabel("weight coefficient (colour: skin)")
    share.hist(seen["shares"], SHARE_BINS)
    share.set_xlabel("share of the picture that is person")
    for kinds, ax, label in (
        (numbers["garments"], worn, f"garments among {numbers['described']} people"),
        (
            {k: v for k, v in numbers["patterns"].items() if k != "plain"},
            woven,
            f"patterns (plain: {numbers['patterns']['plain']})",
        ),
    ):
        ax.barh(list(kinds)[::-1], list(kinds.values())[::-1])
        ax.margins(y=0.01)
        ax.set_xlabel(label)
    shares = seen["colours"].sum((1, 2)) / seen["colours"].sum()
    hue.bar(range(12), shares, color=[colorsys.hsv_to_rgb((i + 0.5) / 12, 0.8, 0.8) for i in range(12)])
    hue.set_xlabel("hue of the person's pixels")
    joints = {"hip": poses.LEFT_HIP, "knee": poses.LEFT_KNEE, "shoulder": poses.LEFT_SHOULDER, "elbow": poses.LEFT_ELBOW,
              "spine": poses.SPINE2, "neck": poses.NECK}  # fmt: skip
    bent.boxplot(
        [np.rad2deg(seen["angles"][:, j]) for j in joints.values()], tick_labels=list(joints), showfliers=False
    )
    bent.set_ylabel("joint angle, degrees")
    bent.tick_params(axis="x", labelrotation=45)
    figure.tight_layout()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=70)


if __name__ == "__main__":
    main()
