"""Packs a face for the page: how vertices and hidden Gaussians move with each expression."""

from typing import Any

import jax
import numpy as np
from scipy.spatial import KDTree

from humangs_jax.avatar.animate import with_hidden_among
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.face import BLINKS, Face
from humangs_jax.body.expressions import EYES
from humangs_jax.body.motion import Motion


def pack_face(
    avatar: Avatar, motion: Motion | None, header: dict[str, Any], arrays: dict[str, np.ndarray]
) -> Avatar:
    """Adds the face to the header and to the arrays. Returns the avatar without its face. There the
    hidden Gaussians of the face are ordinary Gaussians after the others.

    face_rows uint16 (g,): the row of `face_directions` that each Gaussian follows, 65535 for none.
    face_directions int16 (e, rows, 3): how rows move with each expression, in metres, divided by
    face.step. face_eyes uint8 (g, 2): shares by which each Gaussian belongs to the left and the
    right eye, times 255. face_vertices uint16 (hidden,): the nearest vertex of each hidden
    Gaussian, for sliders of shape. face_shown uint8 (hidden,): the expression that shows a hidden
    Gaussian, or 255 for one that is seen between the lips. face_lips float32 (4, 3): points of the
    lips, metres. face_lip_directions float32 (e, 4, 3): how these points move with each expression,
    metres. face_turns float32 (e, 2, 3): how both eyes turn with each expression, axis-angle,
    radians. motion_faces int16 (m, e): the motion's coefficients of the expressions, divided by
    motion.face_step; only if the motion has such coefficients. Here g counts the hidden Gaussians,
    too.
    """
    face = avatar.face
    assert face is not None
    names = avatar.expression_names
    moved, hidden = len(face.expressions.vertices), len(face.in_mouth)
    directions = np.concatenate(
        [np.asarray(face.expressions.directions), np.asarray(face.hidden_directions)]
    )
    directions = np.moveaxis(directions, -1, 0)
    # one step (metres) for all offsets, so that the page scales them by one number
    step = max(1e-5, float(np.abs(directions).max(initial=0)) / 32767)
    # rows beyond the moved vertices stand for Gaussians that no expression moves
    rows = np.asarray(face.row)
    rows = np.where(rows < moved, rows, 65535)
    arrays["face_rows"] = np.concatenate([rows, moved + np.arange(hidden)]).astype("<u2")
    arrays["face_directions"] = np.rint(directions / step).astype("<i2")
    eyes = np.concatenate([np.asarray(face.eyes), np.zeros((hidden, 2))])
    arrays["face_eyes"] = np.rint(255 * eyes).astype("u1")
    # sliders of shape move a hidden Gaussian with the vertex that is nearest
    tree = KDTree(np.asarray(avatar.rest_vertices))
    if hidden:
        nearest = tree.query(np.asarray(face.hidden.means))[1]
    else:
        nearest = np.zeros(0)
    arrays["face_vertices"] = nearest.astype("<u2")
    # what is in the mouth is shown by the gap between the lips, the rest by an expression
    shown = np.asarray(face.hidden_shown)
    in_mouth = np.asarray(face.in_mouth) > 0
    arrays["face_shown"] = np.where(in_mouth, 255, shown.argmax(axis=1)).astype("u1")
    arrays["face_lips"] = np.asarray(face.lips, "<f4")
    arrays["face_lip_directions"] = np.moveaxis(np.asarray(face.lip_directions, "<f4"), -1, 0)
    arrays["face_turns"] = _eye_turns(avatar, face)
    header["face"] = {
        "names": names,
        "step": step,
        "hidden": hidden,
        "blinks": [names.index(name) if name in names else -1 for name in BLINKS],
        "eyes": [avatar.joint_names.index(name) for name in EYES],
    }
    # the motion's coefficients, in 16 bits as its rotations
    faces = None
    if motion is not None:
        faces = motion.expressions_of(names)
    if faces is not None:
        values = np.asarray(faces, np.float64)
        scale = max(float(np.abs(values).max()), 1.0) / 32767
        arrays["motion_faces"] = np.rint(values / scale).astype("<i2")
        header["motion"]["face_step"] = scale
    return jax.jit(with_hidden_among)(avatar, face.hidden)


def _eye_turns(avatar: Avatar, face: Face) -> np.ndarray:
    turns = face.expressions.joint_turns
    if turns is None:
        return np.zeros((len(avatar.expression_names), 2, 3), "<f4")
    eyes = [avatar.joint_names.index(name) for name in EYES]
    return np.moveaxis(np.asarray(turns, "<f4")[eyes], -1, 0)
