"""What is wrong with synthetic people, and how much they differ."""

import collections
import colorsys
import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry, figure
from experiments.results import markdown_table
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.people import anatomy, cameras
from humangs_jax.people.subject import describe, make_subject, padded, render_view
from humangs_jax.people.writer import sample_pose
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh

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


@dataclasses.dataclass(frozen=True)
class Looked:
    """Options:
    subjects: people that are built, posed and rendered
    described: people whose descriptions are counted
    poses: of every built person
    views: cameras around every pose
    size: side of the pictures
    first: first seed (training people by default)
    """

    subjects: int = 1000
    described: int = 1000
    poses: int = 1
    views: int = 1
    size: int = 256
    first: int = 0


@entry
def people_faults(run: Run, options: Looked = Looked(), plots: Path | None = None, worst: int = 0) -> None:
    """What is wrong with synthetic people, and how much they differ; also the table people_diversity.

    Faults are counted in images of random poses from random cameras, as shares of the person's pixels. Skin seen up a sleeve or
    under a skirt has the inner side of cloth behind it: no fault; skin that cloth covers well is not in the mesh at all and
    cannot poke: see hollow. Diversity is that of descriptions (a millisecond each) and of images. 1,000 descriptions take 3 s,
    1,000 subjects with images about 15 minutes on 2 CPU cores. Expected: poking below 0.1 %.

    Options:
    plots: the diversity plots
    worst: print so many seeds with most faults
    """
    body = load_body()
    people = describe_all(body, options)
    seen, faults = look_at_all(body, options)
    result = people["numbers"] | seen["numbers"]
    for name in ("poking", "hollow", "gaps") if worst else ():
        ranked = sorted(faults, key=lambda row: -row[name])[:worst]
        print(name, [(row["seed"], row["pose"], f"{row[name]:.2%}") for row in ranked])
    rows = []
    for name, definition in FAULTS.items():
        mean, most, poses = (result[name][key] for key in ("mean", "worst", "poses_above_0.1_percent"))
        rows.append([name.replace("_", ", "), definition, f"{mean:.4%}", f"{most:.2%}", f"{poses:.1%}"])
    text = markdown_table(["fault", "definition", "mean", "worst pose", "poses above 0.1 %"], rows, "lllll")
    run.show(text, {name: result[name] for name in FAULTS})
    rows = [[label, *(f"{x:.{digits}f}" for x in result[name].values())] for name, (label, digits) in SPREADS.items()]
    marks = ["mean", "standard deviation", "least", "5 %", "median", "95 %", "most"]
    header = [f"of {result['described']:,} people", *marks]
    run.show(markdown_table(header, rows, "l" * len(header)), result, "people_diversity")
    if plots:
        draw(plots, people, seen)


def describe_all(body, options):
    """Counts and spreads over descriptions."""
    people = [describe(options.first + i, body) for i in range(options.described)]
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


def look_at_all(body, options):
    """Faults, foreground shares, colors and angles of built people; and a row of faults for every pose."""
    rows, colors, angles, shares = [], np.zeros((12, 4, 4)), [], []
    for i in range(options.subjects):
        seed = options.first + i
        subject = make_subject(seed, body)
        for pose in range(options.poses):
            posed = sample_pose(subject, pose)
            angles.append(np.linalg.norm(posed.rotations, axis=1))
            rng = np.random.default_rng([seed, 77, pose])
            batch = cameras.cameras_around(
                rng, posed.vertices, cameras.spread_azimuths(rng, options.views), options.size
            )
            counts = np.zeros(1 + len(FAULTS))
            for k in range(options.views):
                counts += count_faults(body, posed, batch[k])
                if pose == 0 and k == 0:
                    image, mask = render_view(posed, batch[k])
                    colors += _color_histogram(image[mask == 1])
                    shares.append(float(mask.mean()))
            rows.append(
                {"seed": seed, "pose": pose, "pixels": counts[0]}
                | dict(zip(FAULTS, counts[1:] / counts[0], strict=True))
            )
    pixels = np.asarray([row["pixels"] for row in rows])
    numbers: dict = {"built": options.subjects, "pictures": len(rows) * options.views}
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

    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.sum(np.cross(b - a, c - a) * (eye - a), -1) > 0


def _spread(values):

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
    high, low = colors.max(-1), colors.min(-1)
    chroma = np.maximum(high - low, 1e-9)
    r, g, b = colors.T
    hue = np.select([high == r, high == g], [((g - b) / chroma) % 6, (b - r) / chroma + 2], (r - g) / chroma + 4) / 6
    return np.stack([hue % 1, (high - low) / np.maximum(high, 1e-9), high], -1)


def _hues(colors):
    """Shares of dyes: neutral ones and 12 hues."""
    hue, saturation, _ = _hsv(colors).T
    colored = saturation > 0.15
    counts = np.bincount((hue[colored] * 12).astype(int) % 12, minlength=12)
    names = ["red", "orange", "yellow", "lime", "green", "sea", "cyan", "azure", "blue", "violet", "magenta", "rose"]
    shares = {"neutral": round(float((~colored).mean()), 3)}
    return shares | {name: round(float(c) / len(colors), 3) for name, c in zip(names, counts, strict=True)}


def _color_histogram(pixels):
    """(12, 4, 4) counts of hue, saturation, value, each image with the same weight."""
    cells = np.minimum((_hsv(pixels) * [12, 4, 4]).astype(int), [11, 3, 3])
    counts = np.zeros((12, 4, 4))
    np.add.at(counts, tuple(cells.T), 1 / max(len(pixels), 1))
    return counts


def draw(file, people, seen):
    """One image of eight plots."""
    male, numbers = np.asarray(people["male"]), people["numbers"]
    with figure(file, 4, (17, 9.5), rows=2) as axes:
        (stature, years, build, share), (worn, woven, hue, bent) = axes
        for values, name, ax in ((people["stature"], "stature, m", stature), (people["years"], "years", years)):
            ax.hist([values[male], values[~male]], 30, stacked=True, label=["men", "women"])
            ax.set_xlabel(name)
            ax.legend()
        build.scatter(people["stature"], people["betas"][:, 2], s=6, c=np.clip(people["skin"], 0, 1))
        build.set(xlabel="stature, m", ylabel="weight coefficient (color: skin)")
        share.hist(seen["shares"], SHARE_BINS)
        share.set_xlabel("share of the picture that is person")
        patterned = {k: v for k, v in numbers["patterns"].items() if k != "plain"}
        for kinds, ax, label in (
            (numbers["garments"], worn, f"garments among {numbers['described']} people"),
            (patterned, woven, f"patterns (plain: {numbers['patterns']['plain']})"),
        ):
            ax.barh(list(kinds)[::-1], list(kinds.values())[::-1])
            ax.set_xlabel(label)
        shares = seen["colours"].sum((1, 2)) / seen["colours"].sum()
        hue.bar(range(12), shares, color=[colorsys.hsv_to_rgb((i + 0.5) / 12, 0.8, 0.8) for i in range(12)])
        hue.set_xlabel("hue of the person's pixels")
        joints = {"hip": anatomy.LEFT_HIP, "knee": anatomy.LEFT_KNEE, "shoulder": anatomy.LEFT_SHOULDER}
        joints |= {"elbow": anatomy.LEFT_ELBOW, "spine": anatomy.SPINE2, "neck": anatomy.NECK}
        angles = [np.rad2deg(seen["angles"][:, j]) for j in joints.values()]
        bent.boxplot(angles, tick_labels=list(joints), showfliers=False)
        bent.set_ylabel("joint angle, degrees")
