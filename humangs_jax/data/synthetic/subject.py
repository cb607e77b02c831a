"""A synthetic person from a seed: one skinned triangle mesh, a material per face, lights, and a source of poses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.array_types import Bool, Float, Int
from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.data.synthetic import anatomy as anatomy_module
from humangs_jax.data.synthetic import complexion, fabrics, hair, poses, wardrobe
from humangs_jax.data.synthetic.anatomy import Anatomy
from humangs_jax.data.synthetic.fabrics import Material
from humangs_jax.data.synthetic.shading import Lights, sample_lights
from humangs_jax.data.synthetic.surfaces import Surface, compact, join

SHAPE_SPREAD = 0.55
"""Standard deviation of the shape coefficients other than sex; beyond 2 of them nothing is drawn."""


@dataclasses.dataclass(frozen=True)
class SyntheticSubject:
    """A dressed person.

    seed. betas: (s,) shape of the body. surface: the mesh at rest with attributes `template`, `cloth`. face_materials: (f,)
    indices into materials. lights. build: what the pose prior knows. under_cloth: (n,) skin vertices kept below a hem.
    """

    seed: int
    betas: Float[np.ndarray, " s"]
    surface: Surface
    face_materials: Int[np.ndarray, " f"]
    materials: tuple[Material, ...]
    lights: Lights
    build: poses.Build
    under_cloth: Bool[np.ndarray, " n"]

    def posed_vertices(
        self, rotations: Float[np.ndarray, "j 3"], translation: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "n 3"]:
        """(n, 3) world positions of the mesh in a pose: rotations (j, 3), translation (3,)."""
        transforms = self._transforms(rotations, translation)
        blended = (self.surface.weights @ transforms[:, :3].reshape(len(transforms), 12)).reshape(-1, 3, 4)
        return np.einsum("nij,nj->ni", blended[..., :3], self.surface.vertices) + blended[..., 3]

    def _transforms(self, rotations, translation):
        """(j, 4, 4) rest -> posed, by the pose prior's own kinematics: no compilation, the same on every backend."""
        world, positions = poses.joint_positions(self.build, np.asarray(rotations, np.float64))
        transforms = np.zeros((len(world), 4, 4))
        transforms[:, :3, :3] = world
        transforms[:, :3, 3] = positions - np.einsum("jab,jb->ja", world, self.build.joints) + translation
        transforms[:, 3, 3] = 1
        return transforms.astype(np.float32)


_shape = jax.jit(shape_body)


def make_subject(seed: int, body: BodyModel) -> SyntheticSubject:
    """The person of a seed.

    Raises: ValueError if the body is not the package's own: cuts and paint are given in its coordinates.
    """
    if body.name != anatomy_module.BODY_NAME or body.template.shape[0] != anatomy_module.BODY_VERTICES:
        raise ValueError(f"synthetic people need the shipped body '{anatomy_module.BODY_NAME}', got '{body.name}'")
    rng = np.random.default_rng([seed, 0])
    betas, male = sample_shape(rng, body.shape_names)
    rest = _shape(body, jnp.asarray(betas))
    template, faces, weights = _host_arrays(body)
    anatomy = anatomy_module.measure(
        np.asarray(rest.vertices), np.asarray(rest.joints), template, faces, weights, body.parents
    )
    outfit = wardrobe.dress_up(rng, anatomy, male)
    tones, styled = _style_hair(rng, anatomy, male)
    for piece in styled:
        outfit.add(piece.surface, piece.material)
    skin, under = _visible_skin(anatomy, outfit.hidden)
    pieces = [
        wardrobe.Piece(skin, complexion.skin_material(rng, tones)),
        wardrobe.Piece(hair.eyeballs(anatomy), complexion.eye_material(tones)),
        *outfit.pieces,
    ]
    surface = join([piece.surface for piece in pieces])
    return SyntheticSubject(
        seed=seed,
        betas=betas,
        surface=surface,
        face_materials=np.concatenate([np.full(len(p.surface.faces), i, np.int32) for i, p in enumerate(pieces)]),
        materials=tuple(piece.material for piece in pieces),
        lights=sample_lights(rng),
        build=_build(anatomy, surface),
        under_cloth=np.concatenate([under, np.zeros(len(surface.vertices) - len(under), bool)]),
    )


def sample_shape(rng: np.random.Generator, names: tuple[str, ...]) -> tuple[Float[np.ndarray, " s"], bool]:
    """(s,) shape coefficients and whether the person is dressed as a man."""
    betas = np.clip(rng.normal(0, 1, len(names)), -2, 2) * SHAPE_SPREAD
    male = bool(rng.random() < 0.5)
    at = {name: i for i, name in enumerate(names)}
    betas[at["sex_male"]] = (1 if male else -1) * rng.uniform(0.55, 1.0)
    betas[at["age"]] = rng.uniform(-0.2, 0.8)
    betas[at["weight"]] = np.clip(rng.normal(0.1, 0.6), -0.9, 1.6)
    return betas.astype(np.float32), male


_HOST: dict[int, tuple] = {}


def _host_arrays(body):
    """Template, faces and weights as numpy; kept for the body used last."""
    if id(body) not in _HOST:
        _HOST.clear()
        arrays = (body.template, body.faces, body.skinning_weights)
        _HOST[id(body)] = (body, *(np.asarray(a) for a in arrays))
    return _HOST[id(body)][1:]


def _visible_skin(anatomy: Anatomy, hidden: np.ndarray) -> tuple[Surface, np.ndarray]:
    """Skin without the faces that are wholly under cloth, and which of its vertices (n,) are under cloth."""
    skin = anatomy.skin.with_attributes(hidden=hidden)
    bare = compact(skin, ~hidden[skin.faces].all(1))
    kept = {name: bare.attributes[name] for name in ("template", "cloth")}
    return Surface(bare.vertices, bare.faces, bare.weights, kept), bare.attributes["hidden"]


def _style_hair(rng, anatomy, male):
    """Complexion, and the pieces of hair (or a cap)."""
    tones = complexion.sample_complexion(rng, male)
    odds = {
        "cropped": (0.3, 0.04),
        "short": (0.32, 0.12),
        "curly": (0.1, 0.12),
        "buzz": (0.1, 0.02),
        "bob": (0.03, 0.2),
        "long": (0.05, 0.26),
        "ponytail": (0.02, 0.12),
        "bun": (0.02, 0.07),
        "cap": (0.06, 0.05),
    }
    column = np.asarray([value[0 if male else 1] for value in odds.values()])
    style = list(odds)[rng.choice(len(odds), p=column / column.sum())]
    material = complexion.hair_material(rng, tones.hair, rng.uniform(0.35, 0.7))
    pieces, receding = [], rng.uniform(-0.004, 0.012) if male else rng.uniform(-0.006, 0.004)
    if style == "buzz":
        tones = dataclasses.replace(tones, scalp_stubble=rng.uniform(0.5, 0.9))
    elif style == "bob" or style == "long":
        bottom = rng.uniform(0.16, 0.2) if style == "bob" else rng.uniform(-0.12, 0.1)
        tube = hair.falling_tube(rng, anatomy, rng.uniform(0.014, 0.026), bottom, wave=rng.uniform(0.003, 0.01))
        pieces.append(wardrobe.Piece(tube, material))
        tones = dataclasses.replace(tones, scalp_stubble=0.9)
    else:
        thickness = {
            "cropped": rng.uniform(0.006, 0.011),
            "short": rng.uniform(0.013, 0.026),
            "curly": rng.uniform(0.03, 0.06),
        }.get(style, 0.009)
        bumps = {"curly": 0.22, "short": 0.16}.get(style, 0.1)
        pieces.append(wardrobe.Piece(hair.scalp_shell(rng, anatomy, thickness, bumps, shift=receding), material))
        tones = dataclasses.replace(tones, scalp_stubble=0.9)
    if style == "ponytail":
        pieces.append(wardrobe.Piece(hair.ponytail(rng, anatomy, rng.uniform(0.2, 0.38)), material))
    if style == "bun":
        pieces.append(wardrobe.Piece(hair.bun(rng, anatomy, rng.uniform(0.032, 0.05), rng.uniform(0.0, 1.1)), material))
    if style == "cap":
        knit = Material(fabrics.random_fabric(rng, plainness=0.5), wrinkles=0.2)
        pieces.append(
            wardrobe.Piece(hair.scalp_shell(rng, anatomy, rng.uniform(0.012, 0.018), 0.03, hair.CAP_LINE), knit)
        )
    if male and rng.random() < 0.25:
        pieces.append(wardrobe.Piece(hair.beard(rng, anatomy, rng.uniform(0.004, 0.018)), material))
    return tones, pieces


def _build(anatomy, surface):
    """Radii of the dressed body for the pose prior."""
    chest = anatomy.trunk.radii[(anatomy.trunk.levels > -0.35) & (anatomy.trunk.levels < 0.0)]
    depth = float(np.median(0.5 * (chest[:, 0] + chest[:, chest.shape[1] // 2])))
    thigh = float(np.median(anatomy.legs[0].radii[(anatomy.legs[0].levels > -0.65) & (anatomy.legs[0].levels < -0.5)]))
    low = surface.vertices[(surface.vertices[:, 1] < -0.5) & (surface.vertices[:, 1] > -0.9)]
    spread = float(np.quantile(np.abs(low[:, 0]), 0.98)) if len(low) else 0.2  # wide skirts keep the hands away
    leg_line = float(np.abs(anatomy.joints[poses.LEFT_KNEE, 0]))
    return poses.Build(
        joints=anatomy.joints.astype(np.float64),
        parents=anatomy.parents,
        torso_radius=depth + 0.015,
        thigh_radius=max(thigh + 0.02, spread - leg_line),
        shin_radius=max(0.07, spread - leg_line - 0.02),
        arm_radius=0.035,
    )
