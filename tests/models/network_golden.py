"""The published network's numbers at every stage: how to compute ours, and the copy of the reference that tests carry.

`data/golden_a.pt` is a checkpoint of the published network with random weights at small sizes, in the released format;
`data/golden_a_subject_0.npz` the reference's numbers for one subject, some stages thinned out (see `THINNED`). Both come
from the project's golden data `golden_a` (computed in float64 by the authors' release, stored as float32);
`python tests/models/network_golden.py GOLDEN_DIRECTORY` makes the npz again.
"""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.geometry.rays import pixel_rays, plucker_rays
from humangs_jax.models.humangs import Encoder, Encoding, HumanGSInputs, apply_humangs, sample_vertices, subject_unit
from humangs_jax.models.tokenizer import Tokenizer
from humangs_jax.models.transformer import Block, Transformer
from humangs_jax.models.vertex_decoder import VertexDecoder, corrected_skinning_weights, decoder_input
from humangs_jax.rendering.gaussians import skin_gaussians
from humangs_jax.sampling.triplane import sample_triplane

DATA = Path(__file__).parent / "data"
CHECKPOINT = DATA / "golden_a.pt"
SUBJECT = DATA / "golden_a_subject_0.npz"

every = lambda step, axes=1, before=0: (slice(None),) * before + (slice(None, None, step),) * axes
THINNED = {
    "out_ray_d": every(4, 2, 2),
    "out_pose_feature": every(4, 2, 2),
    "mid_feature_map_stride4": every(2, 1, 1),
    "mid_decoder_input": every(4),
    "mid_raw_geometry": every(4),
    "mid_raw_appearance": every(4),
    "asset_lbs_weights": every(20),
    **{f"asset_{name}": every(7) for name in ("means3D", "rotations", "scales", "colors", "opacity")},
    "posed_means3D": every(7),
    "posed_rotations": every(7),
}
"""What the carried copy keeps of each stage."""

POSITION_ENCODING = 39
PER_VIEW = ("mid_tokens", "mid_feature_map_stride4")
"""Stages whose first axis is subjects times views."""


def subject(arrays, index):
    """One subject of a golden file, per-view stages included."""
    views = arrays["in_image"].shape[1]
    take = lambda name, x: x[index * views : (index + 1) * views] if name in PER_VIEW else x[index]
    return {name: x if name == "in_lbs_weights" else take(name, x) for name, x in arrays.items()}


def inputs(arrays, dtype):
    """The network's inputs from the golden arrays of one subject."""
    cast = lambda name: jnp.asarray(arrays[name], dtype)
    images = jnp.moveaxis(cast("in_image"), 1, -1)
    height, width = images.shape[1:3]

    def camera(world_from_cam, intrinsics):
        fx, fy, cx, cy = intrinsics
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype)
        return Camera(jnp.asarray(K), jnp.asarray(np.linalg.inv(world_from_cam.astype(dtype))), width, height)

    return HumanGSInputs(
        images=images,
        cameras=stack_cameras([camera(*view) for view in zip(arrays["in_c2w"], arrays["in_fxfycxcy"], strict=True)]),
        posed_vertices=cast("in_smpl_posed_vertices"),
        canonical_vertices=cast("in_smpl_canonical_vertices")[0],
        position_maps=cast("in_position_map"),
        depth_maps=cast("in_depth_map")[:, 0],
        foreground=jnp.ones(images.shape[:3], bool),
    )


def stages(variables, inputs, config, skinning_weights, joint_transforms):
    """Everything that the golden files record, by their names and in their layouts."""
    channels_first = lambda x: jnp.moveaxis(x, -1, 1)
    encoder, unit = variables["params"]["encoder"], subject_unit(inputs.canonical_vertices)
    cameras = inputs.cameras.in_units(unit)
    found = {
        "out_ray_d": channels_first(jax.vmap(pixel_rays)(cameras)[1]),
        "out_pose_feature": channels_first(sample_triplane(encoder["tokenizer"]["texture"], inputs.position_maps)),
    }
    rays = jax.vmap(plucker_rays)(cameras.in_units(unit))  # twice, as in the release
    (maps, global_token), recorded = Encoder(config).apply(
        {"params": encoder, "batch_stats": variables["batch_stats"]["encoder"]},
        jnp.concatenate([inputs.images, rays, inputs.position_maps], axis=-1),
        capture_intermediates=lambda module, _: isinstance(module, Tokenizer | Transformer | Block),
        mutable=["intermediates"],
    )
    recorded = recorded["intermediates"]
    (tokens,), transformer = recorded["tokenizer"]["__call__"], recorded["transformer"]
    found["mid_tokens"] = tokens.reshape(len(maps), -1, tokens.shape[-1])
    found["mid_block_0"] = transformer["block_0"]["__call__"][0]
    found["mid_encoder_out"] = transformer["__call__"][0][-1]
    found["mid_feature_map_stride4"] = channels_first(maps)[:, :, ::4, ::4]

    features = sample_vertices(Encoding(maps, global_token), inputs, config)
    entering = decoder_input(features, inputs.canonical_vertices / unit)
    found["mid_decoder_input"] = entering[:, :-POSITION_ENCODING]
    raw = VertexDecoder(config.decoder).apply({"params": variables["params"]["decoder"]}, entering)
    found |= {"mid_raw_geometry": raw.geometry, "mid_raw_appearance": raw.appearance}

    outputs, _ = apply_humangs(variables, inputs, config)
    gaussians = outputs.gaussians
    weights = corrected_skinning_weights(
        skinning_weights, outputs.skinning_offsets, config.decoder.gaussians_per_vertex
    )
    posed = skin_gaussians(gaussians, jnp.einsum("gj,jab->gab", weights, joint_transforms), config.skinning)
    return found | {
        "asset_means3D": gaussians.means,
        "asset_rotations": gaussians.quats,
        "asset_scales": gaussians.scales,
        "asset_colors": gaussians.colors,
        "asset_opacity": gaussians.opacities[:, None],
        "asset_lbs_weights": weights[::5],
        "posed_means3D": posed.means,
        "posed_rotations": posed.quats,
    }


def relative_errors(found, expected, thinned):
    """Largest error of each stage over the stage's largest magnitude; the sign of posed quaternions is free."""
    errors = {}
    for name, ours in found.items():
        ours, reference = np.asarray(ours, np.float64), np.asarray(expected[name], np.float64)
        ours = ours[THINNED.get(name, ())] if thinned else ours
        assert ours.shape == reference.shape, (name, ours.shape, reference.shape)
        if name == "posed_rotations":
            ours = ours * np.sign(np.sum(ours * reference, axis=-1, keepdims=True))
        errors[name] = np.abs(ours - reference).max() / np.abs(reference).max()
    return errors


def float32_config(config, pool):
    """A checkpoint's configuration at full precision, with the pooling that shapes do not tell."""
    return dataclasses.replace(config, dtype="float32", sampling=dataclasses.replace(config.sampling, pool=pool))


if __name__ == "__main__":
    arrays = subject(dict(np.load(Path(sys.argv[1]) / "golden_a.npz")), 0)
    del arrays["in_lbs_weights"]  # the checkpoint carries them
    np.savez_compressed(SUBJECT, **{name: x[THINNED.get(name, ())] for name, x in arrays.items()})
