"""Views of a synthetic person: rasterized at twice the size, shaded per pixel, box-averaged."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.geometry.camera import Camera
from humangs_jax.people import shading
from humangs_jax.people.anatomy import Rotations, Vector
from humangs_jax.people.fabrics import Spots
from humangs_jax.people.subject import SyntheticSubject
from humangs_jax.people.surfaces import Faces, Field, Folds, Points, vertex_normals
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh

SUPERSAMPLING = 2
VERTEX_STEP, FACE_STEP, POINT_STEP = 4096, 8192, 1 << 15
"""Sizes of meshes are padded to multiples of these, and points are colored in steps of that length: few shapes are compiled."""
FOLD_SLOPE = 0.6
"""Slope of painted creases on the most wrinkled cloth."""

_shaded_vertices, _seen_from_behind = jax.jit(shading.shaded_vertices), jax.jit(shading.seen_from_behind)
_light_points = jax.jit(shading.light_points)
Image = Float[np.ndarray, "h w 3"]
Map = Float[np.ndarray, "h w"]
Ids = Int[np.ndarray, " m"]
Values = Float[np.ndarray, "m 3"]


@dataclasses.dataclass(frozen=True)
class PosedSubject:
    """A person in one pose: rotations (j, 3), translation (3,); vertices (n, 3), unit normals (n, 3), openness (n,).

    lit: (n,) share of the key light that arrives.
    """

    subject: SyntheticSubject
    rotations: Rotations
    translation: Vector
    vertices: Points
    normals: Points
    openness: Field
    lit: Field


def pose_subject(subject: SyntheticSubject, rotations: Rotations, translation: Vector) -> PosedSubject:
    """Skin the mesh and gather what its shading needs."""
    faces, count = subject.surface.faces, len(subject.surface.vertices)
    vertices = subject.posed_vertices(rotations, translation).astype(np.float32)
    normals = vertex_normals(vertices, faces)
    shades = _shaded_vertices(padded(vertices, faces)[0], padded(normals, faces)[0], subject.lights.directions[0])
    return PosedSubject(subject, rotations, translation, vertices, normals, *(np.asarray(x)[:count] for x in shades))


def padded(vertices: Points, faces: Faces) -> tuple[Float[Array, "n_padded 3"], Int[Array, "f_padded 3"]]:
    """A mesh with repeated vertices and faces without area up to the next step of sizes."""
    spare_vertices, spare_faces = -len(vertices) % VERTEX_STEP, -len(faces) % FACE_STEP
    vertices = np.concatenate([vertices, np.repeat(vertices[:1], spare_vertices, axis=0)]).astype(np.float32)
    return jnp.asarray(vertices), jnp.asarray(np.pad(faces, ((0, spare_faces), (0, 0))))


def render_view(posed: PosedSubject, camera: Camera, background: float = 1.0) -> tuple[Image, Map]:
    """(h, w, 3) image on the background and (h, w) coverage of one camera, both in [0, 1]."""
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
    posed: PosedSubject, face_ids: Ids, weights: Values, albedo: Values, slopes: Values, eye: Array | None = None
) -> Values:
    """Colors (m, 3) in the subject's light of painted points (see `paint`) on faces, given by the weights of the corners.

    eye: camera centre (3,), which decides whether the inner side of cloth is seen; None: everything is seen from outside.
    """
    subject, faces = posed.subject, posed.subject.surface.faces
    values = np.concatenate([posed.normals, posed.openness[:, None], posed.lit[:, None]], axis=1)
    behind = np.zeros(len(faces), bool)
    if eye is not None:
        behind = np.asarray(_seen_from_behind(*padded(posed.vertices, faces), eye))
    sheen = np.asarray([material.sheen for material in subject.materials], np.float32)[subject.face_materials]
    colors = [np.zeros((0, 3), np.float32)]
    for start in range(0, len(face_ids), POINT_STEP):
        part = slice(start, start + POINT_STEP)
        ids = face_ids[part]
        points = values[faces[ids]].reshape(-1, 15), weights[part], behind[ids], albedo[part], slopes[part], sheen[ids]
        full = (np.pad(x, [(0, POINT_STEP - len(ids))] + [(0, 0)] * (x.ndim - 1)) for x in points)
        colors.append(np.asarray(_light_points(subject.lights, *full))[: len(ids)])
    return np.concatenate(colors)


def spots_at(subject: SyntheticSubject, face_ids: Ids, weights: Values) -> Spots:
    """Points on faces, given by the weights of their corners, as materials see them."""
    attributes = subject.surface.attributes
    values = np.concatenate([attributes["cloth"], attributes["template"]], axis=1)
    corners = subject.surface.faces[face_ids]
    blended = sum(weights[:, i : i + 1] * values[corners[:, i]] for i in range(3))
    return Spots(blended[:, :4], blended[:, 4:])


def paint(subject: SyntheticSubject, face_ids: Ids, spots: Spots) -> tuple[Values, Values]:
    """The materials at points on given faces: albedo (m, 3) and slope (m, 3) of the painted folds."""
    material_ids = subject.face_materials[face_ids]
    albedo, slope = np.empty((len(face_ids), 3), np.float32), np.zeros((len(face_ids), 3), np.float32)
    for k in np.unique(material_ids):
        material, chosen = subject.materials[k], np.flatnonzero(material_ids == k)
        own = Spots(spots.cloth[chosen], spots.template[chosen])
        albedo[chosen] = material.albedo(own)
        if material.wrinkles > 0:
            folds = Folds(np.random.default_rng([subject.seed, 100 + k]), upright=material.draped)
            slope[chosen] = FOLD_SLOPE * material.wrinkles * folds.slope(own.cloth[:, :3])
    return np.clip(albedo, 0.01, None), slope
