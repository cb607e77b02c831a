"""Makes a synthetic person from a seed, and renders the person in a pose.

`describe` makes only the description, which is a few numbers. It takes milliseconds, so that
thousands of people can be counted without any geometry. `make_subject` builds the mesh and the
materials from the description, and the measures that the pose prior needs. Views are rasterized at
twice their size, shaded at each sample, and averaged.

A seed names a person. Each purpose, such as training or testing, has a range of seeds (`SPLITS`),
and the ranges share no person. People that are written to files are made from the seed, by numpy.
Examples on the fly are made from keys, whose two words are (appearance, seed). A key therefore
shows which split its example belongs to. The example may show another person of that split.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.core.array_types import Array, Bool, Float, Int, Key
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh
from humangs_jax.synthetic import complexion, hair, surroundings, wardrobe
from humangs_jax.synthetic.anatomy import (
    BODY,
    Anatomy,
    Build,
    Joint,
    Rotations,
    Vector,
    joint_positions,
    measure,
)
from humangs_jax.synthetic.complexion import Complexion, sample_complexion
from humangs_jax.synthetic.fabrics import Material, Spots
from humangs_jax.synthetic.hair import Haircut, sample_haircut
from humangs_jax.synthetic.outfits import Garment, sample_outfit
from humangs_jax.synthetic.surfaces import (
    Faces,
    Field,
    Folds,
    Points,
    Surface,
    compact,
    join,
    vertex_normals,
)
from humangs_jax.synthetic.surroundings import Lights, sample_lights

# Seeds
# --------------------------------------------------------------------------------------------------


GENERATOR_VERSION = 2
"""Version of the generator. It is raised whenever a seed makes another person, pose or image than
before. Manifests record it; sets of different versions are not mixed in one folder.
"""

SPLITS = {
    "train": range(0, 1_000_000),
    "validation": range(1_000_000, 1_001_000),
    # held out of training and of every choice made on the validation people
    "test": range(2_000_000, 2_001_000),
    # people of the documentation and the tests
    "demo": range(3_000_000, 3_001_000),
    # people that fitting and refinement are tuned and measured on: no other result sees them
    "fitting": range(4_000_000, 4_001_000),
    # people that the presets of speed and accuracy are chosen on
    "tradeoff": range(5_000_000, 5_001_000),
}
"""Ranges of seeds by purpose. No person is in two ranges."""
APPEARANCES = 2**32
"""Number of appearances that a person has."""


def split_of(seed: int) -> str:
    """Returns the name of the split that a seed belongs to.

    Raises: ValueError if it belongs to none.
    """
    for name, seeds in SPLITS.items():
        if seed in seeds:
            return name
    ranges = ", ".join(f"{name} {seeds.start}..{seeds.stop - 1}" for name, seeds in SPLITS.items())
    raise ValueError(f"seed {seed} lies in no range: {ranges}")


def seeds_of(split: str, first: int, count: int) -> range:
    """Returns `count` seeds of a split, from number `first` on.

    Raises: ValueError if the split has no such seeds, or if `count` is less than 1; KeyError if
    there is no such split.
    """
    people = SPLITS[split]
    if first < 0 or count < 1 or first + count > len(people):
        raise ValueError(
            f"subjects {first}..{first + count - 1} reach beyond the split '{split}', which has"
            f" {len(people)}"
        )
    return people[first : first + count]


def subject_key(seed: int, appearance: int = 0) -> Key:
    """Returns the random key of a person in an appearance. Dyes of the clothes, poses, light and
    cameras are drawn from it.

    Raises: ValueError if the seed lies in no range of `SPLITS`.
    """
    split_of(seed)
    # the words of a key of this implementation are its seed
    words = np.asarray([appearance % APPEARANCES, seed], np.uint32)
    return jax.random.wrap_key_data(jnp.asarray(words), impl="threefry2x32")


# People
# --------------------------------------------------------------------------------------------------


HEIGHT_RANGE = (1.42, 2.08)
"""Range of statures, metres."""
YEARS = (15.0, 85.0)
"""Range of ages, years."""


@dataclasses.dataclass(frozen=True)
class Person:
    """The description of a synthetic person."""

    seed: int
    """The seed of the person, from which all fields are drawn."""
    betas: Float[np.ndarray, " s"]
    """Shape coefficients of the body, (s,)."""
    male: bool
    """Whether the person is a man. The odds of shape, colors, hair and clothes depend on it."""
    years: float
    """Age, years."""
    stature: float
    """Height without shoes, metres."""
    complexion: Complexion
    """Colors of skin, hair and eyes."""
    haircut: Haircut
    """Hair and beard."""
    garments: tuple[Garment, ...]
    """Clothes, innermost first, then shoes and accessories."""
    lights: Lights
    """The light around the person."""


def describe(seed: int, body: BodyModel) -> Person:
    """Describes the person of a seed, without building any geometry. Raises: KeyError if the body
    lacks a shape direction of the package's body, such as "age".
    """
    rng = np.random.default_rng([seed, 0])
    male = bool(rng.random() < 0.5)
    years = float(np.clip(YEARS[0] + 70 * rng.beta(1.15, 1.9), *YEARS))
    betas, stature = _sample_shape(rng, body, male, years)
    garments = sample_outfit(np.random.default_rng([seed, 11]), male, years)
    complexion = sample_complexion(np.random.default_rng([seed, 12]), male, years)
    haircut = sample_haircut(
        np.random.default_rng([seed, 13]), male, years, {g.kind for g in garments}
    )
    lights = sample_lights(np.random.default_rng([seed, 14]))
    return Person(seed, betas, male, years, stature, complexion, haircut, garments, lights)


def _sample_shape(
    rng: np.random.Generator, body: BodyModel, male: bool, years: float
) -> tuple[np.ndarray, float]:
    """Draws shape coefficients. Returns them, (s,), and the stature that they give, metres."""
    at = {name: i for i, name in enumerate(body.shape_names)}
    # coefficients without another rule: standard deviation 0.55, at most twice that
    betas = np.clip(rng.normal(0, 1, len(at)), -2, 2) * 0.55
    betas[at["sex_male"]] = (1 if male else -1) * rng.uniform(0.55, 1.0)
    # age is 0 at 25 years and 1 at 90
    if years > 25.0:
        betas[at["age"]] = (years - 25.0) / (90.0 - 25.0)
    else:
        betas[at["age"]] = 0.03 * (years - 25.0)
    heavier = 0.25 * np.clip((years - 20) / 30, 0, 1)
    betas[at["weight"]] = np.clip(rng.normal(0.05 + heavier, 0.62), -1.0, 1.8)
    betas[at["muscle"]] = np.clip(rng.normal(0.1 - 0.4 * (years > 60), 0.6), -1.0, 1.5)
    # the wanted stature, metres
    mean, std, tallest = (1.765, 0.085, HEIGHT_RANGE[1]) if male else (1.645, 0.08, 1.95)
    youth = 0.04 * np.clip(18 - years, 0, 3) / 3 + 0.03 * np.clip((years - 60) / 25, 0, 1)
    if rng.random() < 0.85:
        tall = rng.standard_t(5)
    else:
        tall = rng.uniform(-2.6, 3.4)
    wanted = np.clip(mean - youth + std * tall, HEIGHT_RANGE[0], tallest)
    *_, stature, gains = _host_arrays(body)
    # three coefficients share what is missing to it
    lengths = [at[name] for name in ("height", "leg_length", "torso_length")]
    missing = wanted - (stature + gains @ betas)
    betas[lengths] += missing * gains[lengths] / (gains[lengths] @ gains[lengths])
    return betas.astype(np.float32), float(wanted)


@dataclasses.dataclass(frozen=True)
class SyntheticSubject:
    """A dressed person."""

    seed: int
    """Seed of the person."""
    betas: Float[np.ndarray, " s"]
    """Shape coefficients of the body, (s,)."""
    surface: Surface
    """The mesh at rest, with the attributes `template` and `cloth` of its vertices."""
    face_materials: Int[np.ndarray, " f"]
    """Index of each face's material, (f,)."""
    materials: tuple[Material, ...]
    """Materials of skin, eyes, clothes and hair, in this order."""
    lights: Lights
    """The light around the person."""
    build: Build
    """Joints and radii of the body, which the pose prior needs."""
    cover: Field
    """How far each vertex of the mesh lies inside of a hem if it is skin, (n,), metres. It is
    negative on bare skin, and -1 on everything that is not skin.
    """
    person: Person
    """The description that the other fields were built from."""

    def posed_vertices(self, rotations: Rotations, translation: Vector) -> Points:
        """Returns the mesh's vertices in a pose, in the world (n, 3), metres.

        rotations: of the joints (j, 3), axis-angle, radians. translation: of the body (3,), metres.
        """
        # by the pose prior's own kinematics: no compilation, the same on every backend
        world, positions = joint_positions(self.build, np.asarray(rotations, np.float64))
        moved = positions - np.einsum("jab,jb->ja", world, self.build.joints) + translation
        transforms = np.concatenate([world, moved[..., None]], -1).astype(np.float32)
        blended = (self.surface.weights @ transforms.reshape(-1, 12)).reshape(-1, 3, 4)
        return np.einsum("nij,nj->ni", blended[..., :3], self.surface.vertices) + blended[..., 3]

    def vertices_of(self, piece: int) -> Bool[np.ndarray, " n"]:
        """Returns for each vertex whether it belongs to a piece (n,).

        piece: the index of the piece's material in `materials`.
        """
        found = np.zeros(len(self.surface.vertices), bool)
        found[self.surface.faces[self.face_materials == piece]] = True
        return found


SKIN = 0
"""Index of the skin in `SyntheticSubject.materials`."""
_shape = jax.jit(shape_body)


def check_body(body: BodyModel) -> None:
    """Raises ValueError if a body does not have the name and the number of vertices of the
    package's body. Cuts and paint of clothes are given in coordinates of the package's body.
    """
    if (body.name, len(body.template)) != BODY:
        raise ValueError(f"synthetic people need the shipped body '{BODY[0]}', got '{body.name}'")


def make_subject(seed: int, body: BodyModel, person: Person | None = None) -> SyntheticSubject:
    """Builds the person of a seed.

    person: the description to build from, for example one with other clothes. None: the description
    of the seed.

    Raises: ValueError if the body is not the package's body.
    """
    check_body(body)
    if person is None:
        person = describe(seed, body)
    rest = _shape(body, jnp.asarray(person.betas))
    # the body is measured at rest, and dressed from the inside out
    template, faces, weights, *_ = _host_arrays(body)
    vertices, joints = np.asarray(rest.vertices), np.asarray(rest.joints)
    anatomy = measure(vertices, joints, template, faces, weights, body.parents)
    outfit = wardrobe.dress_up(np.random.default_rng([seed, 20]), anatomy, person.garments)
    hooded = any(g.kind == "headscarf" or "hood_up" in g.details for g in person.garments)
    removed = outfit.removed
    # what hair or cloth covers is taken out of the skin
    if person.haircut.cut in hair.LONG_CUTS or hooded:
        removed = removed | hair.ears(template)
    hairs = _hair(np.random.default_rng([seed, 21]), anatomy, person, outfit.trunk, hooded)
    skin = anatomy.skin.with_attributes(cover=outfit.cover.astype(np.float32))
    skin = compact(skin, ~removed[skin.faces].all(1))
    skin_material = complexion.skin_material(
        np.random.default_rng([seed, 22]), person.complexion, person.haircut
    )
    eyes = wardrobe.Piece(hair.eyeballs(anatomy), complexion.eye_material(person.complexion))
    # one mesh; the order of the pieces is that of the materials
    pieces = [wardrobe.Piece(skin, skin_material), eyes, *outfit.pieces, *hairs]
    surface = join([piece.surface for piece in pieces])
    materials = tuple(piece.material for piece in pieces)
    cover = np.pad(
        skin.attributes["cover"],
        (0, len(surface.vertices) - len(skin.vertices)),
        constant_values=-1.0,
    )
    ids = np.repeat(
        np.arange(len(pieces), dtype=np.int32), [len(piece.surface.faces) for piece in pieces]
    )
    build = _build(anatomy, surface)
    return SyntheticSubject(
        seed, person.betas, surface, ids, materials, person.lights, build, cover, person
    )


_HOST: dict[int, tuple] = {}


def _host_arrays(
    body: BodyModel,
) -> tuple[
    Points, Int[np.ndarray, "f 3"], Float[np.ndarray, "n j"], float, Float[np.ndarray, " s"]
]:
    """Returns numpy arrays of a body, which are kept for the body that was used last.

    Returns: template (n, 3), faces (f, 3), skinning weights (n, j), the height of the mean body in
    metres, and the metres (s,) that a unit of each shape coefficient adds to the height.
    """
    if id(body) not in _HOST:
        template, faces, weights = (
            np.asarray(a) for a in (body.template, body.faces, body.skinning_weights)
        )
        top, bottom = np.argmax(template[:, 1]), np.argmin(template[:, 1])
        directions = np.asarray(body.shape_directions)
        gains = (directions[top, 1] - directions[bottom, 1]).astype(float)
        _HOST.clear()
        _HOST[id(body)] = (
            body,
            template,
            faces,
            weights,
            float(template[top, 1] - template[bottom, 1]),
            gains,
        )
    return _HOST[id(body)][1:]


def _hair(
    rng: np.random.Generator, anatomy: Anatomy, person: Person, over: float, hooded: bool
) -> list[wardrobe.Piece]:
    """Makes the pieces of hair, without what a hat or hood covers.

    over: how far clothes stand off the trunk, as `hair.style` takes it.
    """
    material = complexion.hair_material(rng, person.complexion.hair, person.haircut)
    haircut = person.haircut
    if hooded:
        haircut = dataclasses.replace(person.haircut, cut="buzz")
    pieces = [
        wardrobe.Piece(surface, material) for surface in hair.style(rng, anatomy, haircut, over)
    ]
    hat = any(g.kind in ("cap", "beanie", "brim_hat") for g in person.garments)
    if hat and pieces and not hooded:  # the scalp's; tails, buns and beards hang out
        hidden = hair.above_line(pieces[0].surface.template, hair.CAP_LINE) > 0.008
        pieces[0] = dataclasses.replace(pieces[0], hidden=hidden).visible()
    return pieces


def _build(anatomy: Anatomy, surface: Surface) -> Build:
    """Measures the radii of the dressed body for the pose prior."""
    chest = anatomy.trunk.radii[(anatomy.trunk.levels > -0.35) & (anatomy.trunk.levels < 0.0)]
    depth = float(np.median(0.5 * (chest[:, 0] + chest[:, chest.shape[1] // 2])))
    thigh = float(
        np.median(
            anatomy.legs[0].radii[
                (anatomy.legs[0].levels > -0.65) & (anatomy.legs[0].levels < -0.5)
            ]
        )
    )
    low = surface.vertices[(surface.vertices[:, 1] < -0.5) & (surface.vertices[:, 1] > -0.9)]
    # wide skirts keep the hands away
    spread = float(np.quantile(np.abs(low[:, 0]), 0.98)) if len(low) else 0.2
    leg_line = float(np.abs(anatomy.joints[Joint.LEFT_KNEE, 0]))
    radii = (
        depth + 0.015,
        max(thigh + 0.02, spread - leg_line),
        max(0.07, spread - leg_line - 0.02),
        0.035,
    )
    return Build(anatomy.joints.astype(np.float64), anatomy.parents, *radii)


def expressed_subject(
    subject: SyntheticSubject, body: BodyModel, coefficients: Float[np.ndarray, " e"]
) -> SyntheticSubject:
    """Returns the person with an expression of the face. Eyes do not turn, and there are no teeth.

    coefficients: of the body's expressions (e,).

    Raises: ValueError if the body has no expressions.
    """
    if body.expressions is None:
        raise ValueError(f"body '{body.name}' has no expressions")
    vertices, known = np.array(subject.surface.vertices), np.asarray(body.expressions.vertices)
    # the skin's vertices, some of which are cut away, are found by their places in the template
    template = np.asarray(body.template)[known]
    distances, nearest = KDTree(template).query(subject.surface.attributes["template"])
    rows = np.flatnonzero((distances < 1e-6) & subject.vertices_of(SKIN))  # metres
    moves = np.asarray(body.expressions.directions) @ np.asarray(coefficients, np.float32)
    vertices[rows] += moves[nearest[rows]]
    return dataclasses.replace(
        subject, surface=dataclasses.replace(subject.surface, vertices=vertices)
    )


# Posed and rendered
# --------------------------------------------------------------------------------------------------


SUPERSAMPLING = 2
"""Number of samples of a pixel along each of its sides."""
_POINT_STEP = 1 << 15
"""Number of points that are colored at a time."""

_shaded_vertices = jax.jit(surroundings.shaded_vertices)
_seen_from_behind = jax.jit(surroundings.seen_from_behind)
_light_points = jax.jit(surroundings.light_points)
_Ids = Int[np.ndarray, " m"]
_Values = Float[np.ndarray, "m 3"]


@dataclasses.dataclass(frozen=True)
class PosedSubject:
    """A person in one pose, with the values at vertices that shading needs."""

    subject: SyntheticSubject
    """The dressed person."""
    rotations: Rotations
    """Rotations of the joints, (j, 3), axis-angle, radians."""
    translation: Vector
    """Translation of the body, (3,), metres."""
    vertices: Points
    """Vertices in the world, (n, 3), metres."""
    normals: Points
    """Unit normals, (n, 3)."""
    openness: Field
    """How much of the surroundings each vertex sees, (n,), 0.35 to 1."""
    lit: Field
    """Share of the key light that arrives at each vertex, (n,)."""


def pose_subject(
    subject: SyntheticSubject, rotations: Rotations, translation: Vector
) -> PosedSubject:
    """Poses the mesh of a person, and computes the values at vertices that shading needs."""
    faces, count = subject.surface.faces, len(subject.surface.vertices)
    vertices = subject.posed_vertices(rotations, translation).astype(np.float32)
    normals = vertex_normals(vertices, faces)
    shades = _shaded_vertices(
        padded(vertices, faces)[0], padded(normals, faces)[0], subject.lights.directions[0]
    )
    return PosedSubject(
        subject, rotations, translation, vertices, normals, *(np.asarray(x)[:count] for x in shades)
    )


def padded(
    vertices: Points, faces: Faces
) -> tuple[Float[Array, "n_padded 3"], Int[Array, "f_padded 3"]]:
    """Pads a mesh, so that functions are compiled for few shapes.

    Vertices are padded to a multiple of 4096 with copies of the first vertex, faces to a multiple
    of 8192 with faces without area.
    """
    spare_vertices, spare_faces = -len(vertices) % 4096, -len(faces) % 8192
    vertices = np.concatenate([vertices, np.repeat(vertices[:1], spare_vertices, axis=0)]).astype(
        np.float32
    )
    return jnp.asarray(vertices), jnp.asarray(np.pad(faces, ((0, spare_faces), (0, 0))))


def render_view(
    posed: PosedSubject, camera: Camera, background: float = 1.0
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Renders a posed person in one camera. background: gray level of the background, 0 to 1.

    Returns: the image (h, w, 3), and the covered share of each pixel (h, w), both in [0, 1].
    """
    s, subject = SUPERSAMPLING, posed.subject
    fine = camera.resized(camera.width * s, camera.height * s)
    fragments = rasterize_mesh(*padded(posed.vertices, subject.surface.faces), fine)
    ids = np.asarray(fragments.face_ids).reshape(-1)
    seen = np.flatnonzero(ids >= 0)
    weights = np.asarray(fragments.barycentrics).reshape(-1, 3)[seen]
    albedo, slopes = paint(subject, ids[seen], spots_at(subject, ids[seen], weights))
    samples = np.full((len(ids), 3), background, np.float32)
    samples[seen] = light_points(posed, ids[seen], weights, albedo, slopes, camera.center)
    shape = (camera.height, s, camera.width, s)
    image = samples.reshape(*shape, 3).mean(axis=(1, 3))
    mask = (ids >= 0).astype(np.float32).reshape(shape).mean(axis=(1, 3))
    return np.clip(image, 0, 1), mask


def light_points(
    posed: PosedSubject,
    face_ids: _Ids,
    weights: _Values,
    albedo: _Values,
    slopes: _Values,
    eye: Array | None = None,
) -> _Values:
    """Returns the colors (m, 3) of points on faces, in the subject's light.

    face_ids: index of each point's face (m,). weights: the point's weights of the three corners (m,
    3). albedo, slopes: as `paint` returns them. eye: centre of the camera (3,), which decides where
    the inner side of cloth is seen. None: everything is seen from outside.
    """
    subject, faces = posed.subject, posed.subject.surface.faces
    values = np.concatenate([posed.normals, posed.openness[:, None], posed.lit[:, None]], axis=1)
    behind = np.zeros(len(faces), bool)
    if eye is not None:
        behind = np.asarray(_seen_from_behind(*padded(posed.vertices, faces), eye))
    sheen = np.asarray([material.sheen for material in subject.materials], np.float32)[
        subject.face_materials
    ]
    colors = [np.zeros((0, 3), np.float32)]
    for start in range(0, len(face_ids), _POINT_STEP):
        part = slice(start, start + _POINT_STEP)
        ids = face_ids[part]
        points = (
            values[faces[ids]].reshape(-1, 15),
            weights[part],
            behind[ids],
            albedo[part],
            slopes[part],
            sheen[ids],
        )
        full = (np.pad(x, [(0, _POINT_STEP - len(ids))] + [(0, 0)] * (x.ndim - 1)) for x in points)
        colors.append(np.asarray(_light_points(subject.lights, *full))[: len(ids)])
    return np.concatenate(colors)


def spots_at(subject: SyntheticSubject, face_ids: _Ids, weights: _Values) -> Spots:
    """Returns coordinates of points on faces, as materials take them.

    face_ids: index of each point's face (m,). weights: the point's weights of the three corners (m,
    3).
    """
    attributes = subject.surface.attributes
    values = np.concatenate([attributes["cloth"], attributes["template"]], axis=1)
    corners = subject.surface.faces[face_ids]
    blended = sum(weights[:, i : i + 1] * values[corners[:, i]] for i in range(3))
    return Spots(blended[:, :4], blended[:, 4:])


def paint(subject: SyntheticSubject, face_ids: _Ids, spots: Spots) -> tuple[_Values, _Values]:
    """Returns the albedo (m, 3) of points on faces, and the slope (m, 3) of their painted folds.

    face_ids: index of each point's face (m,). spots: the points, as `spots_at` returns them.
    """
    material_ids = subject.face_materials[face_ids]
    albedo = np.empty((len(face_ids), 3), np.float32)
    slope = np.zeros((len(face_ids), 3), np.float32)
    for k in np.unique(material_ids):
        material, chosen = subject.materials[k], np.flatnonzero(material_ids == k)
        own = Spots(spots.cloth[chosen], spots.template[chosen])
        albedo[chosen] = material.albedo(own)
        if material.wrinkles > 0:
            folds = Folds(np.random.default_rng([subject.seed, 100 + k]), upright=material.draped)
            # creases of the most wrinkled cloth have a slope of 0.6
            slope[chosen] = 0.6 * material.wrinkles * folds.slope(own.cloth[:, :3])
    return np.clip(albedo, 0.01, None), slope
