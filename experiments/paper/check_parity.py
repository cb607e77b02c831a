"""A checkpoint of the published network on stored inputs: every stage against the stored numbers.

A blended transform is no rotation, and the quaternion that the release makes of it jumps where two
of its four candidates tie. Where ours tie to within the bound, the nearer one counts: rounding
decides there, in the release as here.
"""

from pathlib import Path
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry
from experiments.results import markdown_table
from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.arrays import read_npz
from humangs_jax.io.reading import read_json
from humangs_jax.network.config import HumanGSConfig, paper_parts
from humangs_jax.network.conversion import load_checkpoint
from humangs_jax.network.encoder import encoder_pixels, sample_triplane
from humangs_jax.network.humangs import intermediates, part_variables
from humangs_jax.network.maps import Convolution
from humangs_jax.network.parts import HumanGSInputs
from humangs_jax.network.vertex_decoder import corrected_skinning_weights
from humangs_jax.rendering.gaussians import skin_gaussians

BOUNDS = {"float32": 2e-5, "float64": 1e-6, "bfloat16": 5e-2}
STAGES = {
    "rays": ("out_ray_d",),
    "pose features": ("out_pose_feature",),
    "tokens": ("mid_tokens",),
    "first block": ("mid_block_0",),
    "encoder": ("mid_encoder_out",),
    "feature map": ("mid_feature_map_stride4",),
    "decoder input": ("mid_decoder_input",),
    "raw heads": ("mid_raw_geometry", "mid_raw_appearance"),
    "canonical Gaussians": tuple(
        f"asset_{name}"
        for name in ("means3D", "rotations", "scales", "colors", "opacity", "lbs_weights")
    ),
    "skinned Gaussians": ("posed_means3D", "posed_rotations"),
}
INPUTS = {  # name: axes
    "in_image": "b v 3 h w",
    "in_c2w": "b v 4 4",
    "in_fxfycxcy": "b v 4",
    "in_smpl_canonical_vertices": "b v n 3",
    "in_smpl_posed_vertices": "b v n 3",
    "in_position_map": "b v h w 3",
    "in_depth_map": "b v 1 h w",
    "in_joint_transforms": "b j 4 4",
    "in_lbs_weights": "n j",
}
PER_VIEW = ("mid_tokens", "mid_feature_map_stride4")
"""Stages whose first axis is subjects times views."""
TIES, TIE_LEVELS = "candidates of posed_rotations", "their q_abs"
"""What `compute_stages` gives beside the stages: see `nearest_candidates`."""
MAP_STRIDE, WEIGHTS_STRIDE = 4, 5
"""Which pixels of the feature map and which Gaussians' skinning weights are stored."""


def load_arrays(path: Path) -> dict[str, Any]:
    """The arrays of a file, inputs checked: all there, finite, and of shapes that fit each
    other.
    """
    arrays = read_npz(path)[0]
    sizes: dict[str, int] = {}
    for name, axes in INPUTS.items():
        if name not in arrays:
            raise ValueError(f"{path}: array {name!r} is missing")
        shape, axes = arrays[name].shape, axes.split()
        wanted = tuple(
            int(a) if a.isdigit() else sizes.setdefault(a, n)
            for a, n in zip(axes, shape, strict=False)
        )
        if len(shape) != len(axes) or shape != wanted or 0 in shape:
            raise ValueError(
                f"{path}: {name} has shape {shape}, expected ({', '.join(axes)}) with {sizes}"
            )
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{path}: {name} holds numbers that are not finite")
    if all(name.startswith("in_") for name in arrays):
        raise ValueError(f"{path}: holds no stage to compare with")
    return arrays


def read_release_config(path: Path) -> dict[str, Any]:
    """The settings of a release's configuration, as "part.name".

    Raises: ValueError if it is no JSON object, or asks for what does not exist here.
    """
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("model"), dict):
        raise ValueError(f"{path}: expected an object with 'model'")
    parts = content["model"] | {"training": content.get("training")}
    found = {
        f"{part}.{name}": x
        for part, values in parts.items()
        if isinstance(values, dict)
        for name, x in values.items()
    }
    if found.get("training.use_canonical_maps"):
        raise ValueError(
            f"{path}: training.use_canonical_maps: the variant with canonical target maps is not"
            " supported"
        )
    if (height := found.get("training.target_height")) not in (None, 1.8):
        raise ValueError(f"{path}: training.target_height must be 1.8, got {height!r}")
    return found


def complete_config(
    config: HumanGSConfig, release: dict[str, Any], dtype: str, image_size: int
) -> HumanGSConfig:
    """A checkpoint's configuration with what the release's one adds to it.

    Raises: ValueError where they do not agree.
    """
    encoder, _, decoder = paper_parts(config.architecture)
    transformer = encoder.transformer
    found = {
        "neural_texture.resolution": encoder.texture.resolution,
        "neural_texture.dim": encoder.texture.channels,
        "image_tokenizer.patch_size": encoder.patch_size,
        "transformer.d": transformer.width,
        "transformer.d_head": transformer.head_width,
        "transformer.n_layer": transformer.layers,
        "transformer.use_qk_norm": transformer.qk_norm,
        "transformer.use_cls_token": transformer.class_token,
        "transformer.use_upsampler": encoder.upsampler is not None,
        "vertex_decoder.hidden_dim": decoder.hidden,
        "vertex_decoder.learnable_lbs_weights": decoder.skinning_joints is not None,
    }
    for name, value in found.items():
        if release.get(name) not in (None, value):
            raise ValueError(
                f"model.{name} is {release[name]!r} in the configuration, but {value!r} in the"
                " checkpoint"
            )
    tight, free = (
        release.get(f"vertex_decoder.num_{kind}_gaussians") for kind in ("tight", "free")
    )
    if tight is not None and free is not None:
        if tight + free != decoder.gaussians_per_vertex:
            raise ValueError(
                f"model.vertex_decoder: {tight} tight and {free} free Gaussians in the"
                f" configuration, but {decoder.gaussians_per_vertex} a vertex in the checkpoint"
            )
        decoder = decoder.clone(tight=tight, free=free)
    pool = "visible" if release.get("transformer.project_all_vertices") is False else "all"
    config = config.with_parts(decoder=decoder).with_conventions(image_size=image_size, pool=pool)
    return config.with_runtime(dtype="bfloat16" if dtype == "bfloat16" else "float32")


def subject_inputs(arrays: dict[str, Any], index: int, dtype: Any) -> Any:
    """The network's inputs of one subject, and its skinning weights (n, j) and joint transforms (j,
    4, 4).
    """

    def own(name):
        return jnp.asarray(arrays[name][index], dtype)

    images = jnp.moveaxis(own("in_image"), 1, -1)
    height, width = images.shape[1:3]
    fx, fy, cx, cy = np.moveaxis(arrays["in_fxfycxcy"][index].astype(np.float64), -1, 0)
    K = np.zeros((*fx.shape, 3, 3))
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = fx, fy, cx, cy, 1
    one = Camera(jnp.eye(3, dtype=dtype), jnp.eye(4, dtype=dtype), width, height)
    cam_from_world = np.linalg.inv(arrays["in_c2w"][index].astype(np.float64))
    cameras = replace(
        one, K=jnp.asarray(K, dtype), cam_from_world=jnp.asarray(cam_from_world, dtype)
    )
    inputs = HumanGSInputs(
        images=images,
        cameras=cameras,
        posed_vertices=own("in_smpl_posed_vertices"),
        canonical_vertices=own("in_smpl_canonical_vertices")[0],
        position_maps=own("in_position_map"),
        depth_maps=own("in_depth_map")[:, 0],
        foreground=jnp.ones(images.shape[:3], bool),
    )
    return inputs, jnp.asarray(arrays["in_lbs_weights"], dtype), own("in_joint_transforms")


def compute_stages(
    variables: Any, inputs: Any, config: Any, skinning_weights: Any, joint_transforms: Any
) -> dict:
    """Every stage of one subject, by its array's name and in its layout; jittable with `config`
    static.

    And TIES (g, 4, 4), TIE_LEVELS (g, 4): all readings of the posed rotations, see
    `nearest_candidates`.
    """

    def channels_first(x):
        return jnp.moveaxis(x, -1, 1)

    encoder, reader, decoder = paper_parts(config.architecture)
    stages = intermediates(variables, inputs, config)
    features, outputs = stages["reader"], stages["decoder"]
    gaussians, maps = outputs.gaussians, stages["encoder"].maps
    if (
        encoder.upsampler is not None
    ):  # vertices read the last convolution only where they need it; here it is everywhere
        convolution = Convolution(
            int(reader.output_width or 0), nn.initializers.zeros, config.runtime.compute_dtype
        )
        maps = convolution.apply(part_variables(variables, "reader"), maps)
    pixels, texture = (
        encoder_pixels(inputs, config.forward_context()),
        variables["params"]["encoder"]["tokenizer"]["texture"],
    )

    def heads(name):
        return stages[f"decoder.{name}_out"].reshape(
            len(features.local), decoder.gaussians_per_vertex, -1
        )

    entering = [features.local]
    if features.global_token is not None:
        entering.append(
            jnp.broadcast_to(
                features.global_token, (len(features.local), *features.global_token.shape)
            )
        )
    weights = corrected_skinning_weights(
        skinning_weights, outputs.skinning_offsets, decoder.gaussians_per_vertex
    )
    transforms = jnp.einsum("gj,jab->gab", weights, joint_transforms)
    posed = skin_gaussians(gaussians, transforms, config.conventions.skinning)
    rotations = quaternion.to_matrix(quaternion.normalize(gaussians.quats))
    candidates, q_abs = quaternion.candidates_from_matrix(transforms[:, :3, :3] @ rotations)
    return {
        "out_ray_d": channels_first(pixels[..., 6:9]),
        "out_pose_feature": channels_first(sample_triplane(texture, pixels[..., 9:])),
        "mid_tokens": (
            stages["encoder.tokenizer"].reshape(len(inputs.images), -1, encoder.transformer.width)
        ),
        "mid_block_0": stages["encoder.transformer.block_0"],
        "mid_encoder_out": stages["encoder.transformer.norm"],
        "mid_feature_map_stride4": channels_first(maps)[:, :, ::MAP_STRIDE, ::MAP_STRIDE],
        "mid_decoder_input": jnp.concatenate(entering, axis=-1),
        "mid_raw_geometry": heads("geometry"),
        "mid_raw_appearance": heads("appearance"),
        "asset_means3D": gaussians.means,
        "asset_rotations": gaussians.quats,
        "asset_scales": gaussians.scales,
        "asset_colors": gaussians.colors,
        "asset_opacity": gaussians.opacities[:, None],
        "asset_lbs_weights": weights[::WEIGHTS_STRIDE],
        "posed_means3D": posed.means,
        "posed_rotations": posed.quats,
        TIES: candidates,
        TIE_LEVELS: q_abs,
    }


def nearest_candidates(found: dict[str, Any], reference: Any, bound: float) -> Any:
    """Ours of the posed rotations; where candidates tie to within `bound`, the one nearest to the
    reference.
    """
    ours = np.asarray(found["posed_rotations"], np.float64)
    if TIES not in found or ours.shape != reference.shape:
        return ours
    readings, levels = (
        np.asarray(found[TIES], np.float64),
        np.asarray(found[TIE_LEVELS], np.float64),
    )
    tied = levels >= levels.max(-1, keepdims=True) - bound
    distances = [np.abs(readings - sign * reference[..., None, :]).max(-1) for sign in (1, -1)]
    best = np.argmin(np.where(tied, np.minimum(*distances), np.inf), axis=-1)
    nearest = np.take_along_axis(readings, best[..., None, None], axis=-2)[..., 0, :]
    return np.where(tied.sum(-1, keepdims=True) > 1, nearest, ours)


def relative_errors(
    found: dict[str, Any], expected: dict[str, Any], bound: float = 0.0
) -> dict[str, float | None]:
    """Largest error of each expected stage over its largest magnitude; None where none was found in
    its shape.

    bound: within which candidates of posed rotations tie.
    """
    errors: dict[str, float | None] = {}
    for name, reference in expected.items():
        ours, reference = (
            np.asarray(found.get(name, np.nan), np.float64),
            np.asarray(reference, np.float64),
        )
        if ours.shape != reference.shape or not (
            np.isfinite(ours).all() and np.isfinite(reference).all()
        ):
            errors[name] = None
            continue
        if name == "posed_rotations":
            ours = nearest_candidates(found, reference, bound)
            ours = ours * np.where(np.sum(ours * reference, axis=-1, keepdims=True) < 0, -1, 1)
        error, largest = np.abs(ours - reference).max(initial=0), np.abs(reference).max(initial=0)
        errors[name] = float(error / largest) if largest > 0 else float(error)
    return errors


def check(checkpoint: Path, dtype: str) -> dict[str, Any]:
    """{"dtype", "bound", "stages": {array: relative error, or None if it was not compared},
    "passed"}.

    For float64 `jax_enable_x64` must be set.
    """
    found, expected = run_checkpoint(checkpoint, dtype)
    bound = BOUNDS[dtype]
    errors = relative_errors(
        found, {name: x for name, x in expected.items() if not name.startswith("in_")}, bound
    )
    passed = all(error is not None and error <= bound for error in errors.values())
    return {"dtype": dtype, "bound": bound, "stages": errors, "passed": passed}


def run_checkpoint(checkpoint: Path, dtype: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """(what `compute_stages` gives for all subjects, the arrays of the file)."""
    config, arrays = (checkpoint.with_suffix(suffix) for suffix in (".json", ".npz"))
    release, expected = read_release_config(config), load_arrays(arrays)
    # the width of a head is only needed where the checkpoint does not tell it
    width = (
        release.get("transformer.d_head")
        if release.get("transformer.use_qk_norm") is False
        else None
    )
    converted = load_checkpoint(checkpoint, head_width=width)
    settings = complete_config(converted.config, release, dtype, expected["in_image"].shape[-2])
    if expected["in_lbs_weights"].shape != converted.skinning_weights.shape:
        raise ValueError(
            f"{arrays}: in_lbs_weights has shape {expected['in_lbs_weights'].shape}, the"
            f" checkpoint's {converted.skinning_weights.shape}"
        )
    working = (
        jnp.float64 if dtype == "float64" else jnp.float32
    )  # bfloat16: products only, see `network.runtime`
    variables = jax.tree.map(lambda x: jnp.asarray(x, working), converted.variables)
    compute = jax.jit(compute_stages, static_argnames="config")
    with jax.default_matmul_precision(
        "highest"
    ):  # GPUs and TPUs multiply float32 in fewer bits otherwise
        subjects = []
        for index in range(len(expected["in_image"])):
            inputs, weights, transforms = subject_inputs(expected, index, working)
            subjects.append(
                jax.tree.map(np.asarray, compute(variables, inputs, settings, weights, transforms))
            )
    found = {
        name: (np.concatenate if name in PER_VIEW else np.stack)(
            [subject[name] for subject in subjects]
        )
        for name in subjects[0]
    }
    return found, expected


@entry
def parity(
    run: Run,
    checkpoints: tuple[Path, ...],
    dtypes: tuple[Literal["float32", "float64", "bfloat16"], ...] = ("float32",),
) -> int:
    """Checkpoints of the published network on stored inputs: the largest error of every stage,
    relative to its largest magnitude.

    Beside a checkpoint STEM.pt, in the released format, or its state dict STEM.safetensors, are
    STEM.json, the release's configuration, which says what shapes do not tell (pooling, width of a
    head), and STEM.npz with b subjects of v views:

        in_image (b,v,3,h,w) in [0,1], in_c2w (b,v,4,4), in_fxfycxcy (b,v,4),
        in_smpl_canonical_vertices and in_smpl_posed_vertices (b,v,n,3), in_joint_transforms
        (b,j,4,4), in_lbs_weights (n,j), metric; in_position_map (b,v,h,w,3) and in_depth_map
        (b,v,1,h,w) in normalised units out_ray_d (b,v,3,h,w), out_pose_feature (b,v,c,h,w),
        mid_tokens (b*v,p,d), mid_block_0 and mid_encoder_out (b,l,d), mid_feature_map_stride4
        (b*v,d,h',w'), mid_decoder_input (b,n,c), mid_raw_geometry (b,n,k,10), mid_raw_appearance
        (b,n,k,4), asset_{means3D,rotations,scales,colors,opacity} (b,n*k,.), asset_lbs_weights
        (every fifth of n*k), posed_means3D, posed_rotations (b,n*k,.; the sign of a quaternion is
        free)

    Exit status 1 if an error exceeds 2e-5 (float32), 1e-6 (float64) or 5e-2 (bfloat16), or an array
    of a stage (any that is not in_*) could not be compared. Seconds for small networks.

    Tables: parity_stages

    Options:
    dtypes: to compute in
    """
    columns = {}
    for dtype in dtypes:
        with jax.enable_x64(dtype == "float64"):
            for path in checkpoints:
                columns[f"{dtype}, {path.stem}"] = check(path, dtype)
    found = list(dict.fromkeys(name for column in columns.values() for name in column["stages"]))
    rows = [(stage, name) for stage, names in STAGES.items() for name in names if name in found]
    rows += [("unknown stage", name) for name in found if name not in {name for _, name in rows}]
    table = [
        [stage, f"`{name}`", *(_shown(each, name) for each in columns.values())]
        for stage, name in rows
    ]
    text = markdown_table(["stage", "array", *columns], table, "ll" + "r" * len(columns))
    run.show(text, columns, "parity_stages")
    return int(not all(column["passed"] for column in columns.values()))


def _shown(column: dict[str, Any], name: str) -> str:
    error = column["stages"].get(name)
    if error is None:
        return "NOT COMPARED"
    if error <= column["bound"]:
        return f"{error:.1e}"
    return f"{error:.1e} TOO LARGE"
