"""A synthetic person from a seed: one skinned triangle mesh, a material per face, lights, and a source of poses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.people import anatomy as anatomy_module
from humangs_jax.people import complexion, hair, poses, wardrobe
from humangs_jax.people.anatomy import Anatomy
from humangs_jax.people.fabrics import Material
from humangs_jax.people.person import Person, describe
from humangs_jax.people.shading import Lights
from humangs_jax.people.surfaces import Surface, compact, join

UNDER_CLOTH = 0.003
"""Skin this far inside of a hem is meant to be covered, metres."""


@dataclasses.dataclass(frozen=True)
class SyntheticSubject:
    """A dressed person.

    seed. betas: (s,) shape of the body. surface: the mesh at rest with attributes `template`, `cloth`. face_materials: (f,)
    indices into materials. lights. build: what the pose prior knows. under_cloth: (n,) skin vertices kept below a hem.
    cover: (n,) metres that a vertex of the skin lies inside of a hem, negative on bare skin and on everything else.
    person: what all of this was built from.
    """

    seed: int
    betas: Float[np.ndarray, " s"]
    surface: Surface
    face_materials: Int[np.ndarray, " f"]
    materials: tuple[Material, ...]
    lights: Lights
    build: poses.Build
    under_cloth: Bool[np.ndarray, " n"]
    cover: Float[np.ndarray, " n"]
    person: Person

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
    person = describe(seed, body)
    rest = _shape(body, jnp.asarray(person.betas))
    template, faces, weights = _host_arrays(body)
    anatomy = anatomy_module.measure(
        np.asarray(rest.vertices), np.asarray(rest.joints), template, faces, weights, body.parents
    )
    rng = np.random.default_rng([seed, 20])
    outfit = wardrobe.dress_up(rng, anatomy, person.garments)
    if hair.over_ears(person.haircut) or any(g.kind == "headscarf" or "hood_up" in g.details for g in person.garments):
        outfit.removed = outfit.removed | hair.ears(template)
    hairs = _hair(np.random.default_rng([seed, 21]), anatomy, person, outfit.trunk)
    skin, cover = _visible_skin(anatomy, outfit)
    tones = person.complexion
    pieces = [
        wardrobe.Piece(skin, complexion.skin_material(np.random.default_rng([seed, 22]), tones, person.haircut)),
        wardrobe.Piece(hair.eyeballs(anatomy), complexion.eye_material(tones)),
        *outfit.pieces,
        *hairs,
    ]
    surface = join([piece.surface for piece in pieces])
    cover = np.concatenate([cover, np.full(len(surface.vertices) - len(cover), -1.0, np.float32)])
    return SyntheticSubject(
        seed=seed,
        betas=person.betas,
        surface=surface,
        face_materials=np.concatenate([np.full(len(p.surface.faces), i, np.int32) for i, p in enumerate(pieces)]),
        materials=tuple(piece.material for piece in pieces),
        lights=person.lights,
        build=_build(anatomy, surface),
        under_cloth=cover > UNDER_CLOTH,
        cover=cover,
        person=person,
    )


_HOST: dict[int, tuple] = {}


def _host_arrays(body):
    """Template, faces and weights as numpy; kept for the body used last."""
    if id(body) not in _HOST:
        _HOST.clear()
        arrays = (body.template, body.faces, body.skinning_weights)
        _HOST[id(body)] = (body, *(np.asarray(a) for a in arrays))
    return _HOST[id(body)][1:]


def _visible_skin(anatomy: Anatomy, outfit: wardrobe.Outfit) -> tuple[Surface, np.ndarray]:
    """Skin without the faces that nobody can see, and how far inside of a hem its vertices (n,) lie, metres."""
    skin = anatomy.skin.with_attributes(cover=outfit.cover.astype(np.float32))
    bare = compact(skin, ~outfit.removed[skin.faces].all(1))
    kept = {name: bare.attributes[name] for name in ("template", "cloth")}
    return Surface(bare.vertices, bare.faces, bare.weights, kept), bare.attributes["cover"]


def _hair(rng, anatomy, person, over):
    """The pieces of hair; what a hat or hood covers is left out."""
    material = complexion.hair_material(rng, person.complexion.hair, person.haircut)
    if any("hood_up" in g.details or g.kind == "headscarf" for g in person.garments):
        parts = hair.style(rng, anatomy, dataclasses.replace(person.haircut, cut="buzz"))
        return [wardrobe.Piece(surface, material) for surface in parts]
    pieces = [wardrobe.Piece(surface, material) for surface in hair.style(rng, anatomy, person.haircut, over)]
    if not any(g.kind in ("cap", "beanie", "brim_hat") for g in person.garments):
        return pieces
    if pieces:  # the scalp's; tails, buns and beards hang out
        hidden = hair.above_line(pieces[0].surface.attributes["template"], hair.CAP_LINE) > 0.008
        pieces[0] = dataclasses.replace(pieces[0], hidden=hidden).visible()
    return pieces


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
