"""The published network in numpy and float64, one subject at a time.

It reads a state dict in the release's names. It is written from the description of the network
alone (equations, names of tensors, layouts), with all its options, and shares no line with
`humangs_jax`. Stages have the names and layouts of the golden files.
"""

import dataclasses
import math

import numpy as np

erf = np.vectorize(math.erf)


@dataclasses.dataclass(frozen=True)
class Options:
    """Sizes of a made-up network and its inputs.

    The hidden layers of upsampler and heads are 8 wide.
    """

    width: int = 16
    head: int = 8
    layers: int = 4
    patch: int = 8
    size: tuple[int, int] = (32, 32)  # height, width
    views: int = 2
    subjects: int = 1
    gaussians: int = 2
    vertices: int = 23
    joints: int = 55
    texture: tuple[int, int] = (6, 2)  # resolution, channels
    class_token: bool = True
    upsampler: bool = True
    skinning_head: bool = False
    qk_norm: bool = True
    all_views: bool = True

    def release_config(self):
        """Returns the content of the release's configuration file."""
        model = {
            "neural_texture": {"resolution": self.texture[0], "dim": self.texture[1]},
            "image_tokenizer": {"patch_size": self.patch, "image_size": self.size[0]},
            "transformer": {
                "d": self.width,
                "d_head": self.head,
                "n_layer": self.layers,
                "use_qk_norm": self.qk_norm,
                "use_cls_token": self.class_token,
                "use_upsampler": self.upsampler,
                "project_all_vertices": self.all_views,
            },
            "vertex_decoder": {
                "hidden_dim": 8,
                "num_tight_gaussians": 1,
                "num_free_gaussians": self.gaussians - 1,
                "learnable_lbs_weights": self.skinning_head,
            },
        }
        return {"model": model, "training": {"use_canonical_maps": False, "target_height": 1.8}}


def random_state(options, seed=0):
    """Returns a checkpoint of random float32 weights, every one of which matters."""
    rng = np.random.default_rng(seed)
    o, hidden, state = options, 8, {}

    def weight(key, *shape, fan_in=None):
        state[key] = rng.normal(size=shape) / np.sqrt(fan_in or np.prod(shape[1:]))

    def norm(key, width, bias=True, batch=False):
        state[f"{key}.weight"] = rng.uniform(0.5, 1.5, width)
        if bias:
            state[f"{key}.bias"] = rng.normal(size=width) * 0.1
        if batch:
            state[f"{key}.running_mean"] = rng.normal(size=width) * 0.3
            state[f"{key}.running_var"] = rng.uniform(0.5, 1.5, width)
            state[f"{key}.num_batches_tracked"] = np.asarray(7)

    def affine(key, *shape, fan_in=None, outputs=None):
        weight(f"{key}.weight", *shape, fan_in=fan_in)
        state[f"{key}.bias"] = rng.normal(size=outputs or shape[0]) * 0.3

    # the encoder
    R, C = o.texture
    state["neural_texture"] = rng.normal(size=(3, R, R, C))
    if o.class_token:
        state["cls_token"] = rng.normal(size=(1, 1, o.width))
    state["tpose_lbs_weights"] = rng.dirichlet(np.full(o.joints, 0.05), o.vertices)
    weight("image_tokenizer.1.weight", o.width, o.patch**2 * (9 + 3 * C))
    norm("transformer_input_layernorm", o.width, bias=False)
    norm("norm", o.width)
    for i in range(o.layers):
        block = f"transformer_blocks.{i}"
        norm(f"{block}.norm1", o.width, bias=False)
        norm(f"{block}.norm2", o.width, bias=False)
        weight(f"{block}.attn.to_qkv.weight", 3 * o.width, o.width)
        weight(f"{block}.attn.fc.weight", o.width, o.width)
        weight(f"{block}.mlp.mlp.0.weight", 4 * o.width, o.width)
        weight(f"{block}.mlp.mlp.2.weight", o.width, 4 * o.width)
        if o.qk_norm:
            norm(f"{block}.attn.q_norm", o.head, bias=False)
            norm(f"{block}.attn.k_norm", o.head, bias=False)
    # the upsampler: convolutions, and transposed ones, whose first axis is the input
    if o.upsampler:
        for i in range(4):
            affine(f"upsampler.proj.{i}", hidden, o.width, 1, 1)
        affine("upsampler.fuse.0", 2 * hidden, 4 * hidden, 3, 3)
        affine("upsampler.up1.0", 2 * hidden, hidden, 4, 4, outputs=hidden)
        affine("upsampler.up1.3", hidden, hidden, 3, 3)
        affine("upsampler.up2.0", hidden, hidden // 2, 4, 4, outputs=hidden // 2)
        affine("upsampler.up2.3", o.width, hidden // 2, 3, 3)
        for key, width in (
            ("fuse.1", 2 * hidden),
            ("up1.1", hidden),
            ("up1.4", hidden),
            ("up2.1", hidden // 2),
        ):
            norm(f"upsampler.{key}", width, batch=True)
    # the decoder reads a token, the class token and an encoded place
    entering = o.width * (1 + o.class_token) + 39
    affine("vertex_decoder.trunk.0", 8, entering)
    affine("vertex_decoder.trunk.2", 8, 8)
    heads = {"geo_head": 10, "app_head": 4} | ({"lbs_head": o.joints} if o.skinning_head else {})
    for head, numbers in heads.items():
        affine(f"vertex_decoder.{head}.0", 8, 8)
        affine(f"vertex_decoder.{head}.2", o.gaussians * numbers, 8)
    return {key: np.asarray(x, np.int64 if x.ndim == 0 else np.float32) for key, x in state.items()}


def random_inputs(options, state, seed=1):
    """Returns the `in_*` arrays, float32: vertices of which some views see some."""
    rng = np.random.default_rng(seed)
    o = options
    b, v, n, (h, w) = o.subjects, o.views, o.vertices, o.size
    canonical = rng.uniform(-1, 1, (b, 1, n, 3)) * [0.5, 0.9, 0.3]
    posed = canonical + rng.normal(size=(b, v, n, 3)) * 0.1
    c2w = np.tile(np.eye(4), (b, v, 1, 1))
    for camera in c2w.reshape(-1, 4, 4):  # on a circle, looking at the origin, y down
        angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(2, 3)
        back = np.asarray([np.sin(angle), 0, np.cos(angle)])
        camera[:3, :3] = np.stack([np.cross([0, -1, 0], -back), [0, -1, 0], -back], axis=1)
        camera[:3, 3] = distance * back + rng.normal(size=3) * 0.1
    intrinsics = np.asarray([1.1 * h, 1.2 * h, 0.48 * w, 0.52 * h]) * rng.uniform(
        0.95, 1.05, (b, v, 4)
    )
    position = rng.uniform(-1.05, 1.05, (b, v, h, w, 3))
    position[rng.uniform(size=(b, v, h, w)) < 0.3] = 1
    depth = np.where(
        rng.uniform(size=(b, v, 1, h, w)) < 0.3, -1, rng.uniform(2, 4, (b, v, 1, h, w))
    )
    joints = np.tile(np.eye(4), (b, o.joints, 1, 1))
    q, r = np.linalg.qr(np.eye(3) + 0.5 * rng.normal(size=(b, o.joints, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=-2, axis2=-1))[..., None, :]
    joints[..., :3, :3] = q * np.linalg.det(q)[..., None, None]
    joints[..., :3, 3] = rng.normal(size=(b, o.joints, 3)) * 0.2
    arrays = {
        "in_image": rng.uniform(0, 1, (b, v, 3, h, w)),
        "in_c2w": c2w,
        "in_fxfycxcy": intrinsics,
        "in_smpl_canonical_vertices": np.repeat(canonical, v, axis=1),
        "in_smpl_posed_vertices": posed,
        "in_position_map": position,
        "in_depth_map": depth,
        "in_joint_transforms": joints,
        "in_lbs_weights": state["tpose_lbs_weights"],
    }
    return {name: x.astype(np.float32) for name, x in arrays.items()}


def layer_norm(x, weight, bias=0.0):
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-5) * weight + bias


def softmax(x):
    x = np.exp(x - x.max(-1, keepdims=True))
    return x / x.sum(-1, keepdims=True)


def bilinear(grid, x, y):
    """Samples grid (c, h, w) at texel positions, corners aligned, zeros outside: (*x.shape, c)."""
    c, h, w = grid.shape
    out = np.zeros((*x.shape, c))
    for j in (np.floor(y), np.floor(y) + 1):
        for i in (np.floor(x), np.floor(x) + 1):
            inside = (i >= 0) & (i < w) & (j >= 0) & (j < h)
            texel = grid[:, np.where(inside, j, 0).astype(int), np.where(inside, i, 0).astype(int)]
            weight = np.where(inside, (1 - np.abs(x - i)) * (1 - np.abs(y - j)), 0)
            out += weight[..., None] * np.moveaxis(texel, 0, -1)
    return out


def convolution(x, weight, bias):
    """Convolves x (v, c, h, w) with an odd kernel; the size stays."""
    p = weight.shape[-1] // 2
    h, w = x.shape[2:]
    x = np.pad(x, ((0, 0), (0, 0), (p, p), (p, p)))
    taps = [(a, b) for a in range(2 * p + 1) for b in range(2 * p + 1)]
    y = sum(
        np.einsum("oi,vihw->vohw", weight[:, :, a, b], x[:, :, a : a + h, b : b + w])
        for a, b in taps
    )
    return y + bias[:, None, None]


def transposed_convolution(x, weight, bias):
    """Convolves transposed, with kernel 4, stride 2 and padding 1.

    Input pixel (i, j) adds kernel[a, b] to output pixel (2i + a - 1, 2j + b - 1).
    """
    v, _, h, w = x.shape
    y = np.zeros((v, weight.shape[1], 2 * h + 2, 2 * w + 2))
    for a in range(4):
        for b in range(4):
            y[:, :, a : a + 2 * h : 2, b : b + 2 * w : 2] += np.einsum(
                "io,vihw->vohw", weight[:, :, a, b], x
            )
    return y[:, :, 1:-1, 1:-1] + bias[:, None, None]


class Network:
    """The network of a state dict; `head` is the width of an attention head."""

    def __init__(self, state, options):
        self.state = {key: np.asarray(x, np.float64) for key, x in state.items()}
        self.options = options

    def linear(self, name, x):
        return x @ self.state[f"{name}.weight"].T + self.state.get(f"{name}.bias", 0.0)

    def batch_norm_relu(self, name, x):
        s = {
            field: self.state[f"{name}.{field}"]
            for field in ("weight", "bias", "running_mean", "running_var")
        }
        s = {field: value[:, None, None] for field, value in s.items()}
        x = (x - s["running_mean"]) / np.sqrt(s["running_var"] + 1e-5) * s["weight"] + s["bias"]
        return np.where(x > 0, x, 0.2 * x)

    def conv(self, name, x, function=convolution):
        return function(x, self.state[f"{name}.weight"], self.state[f"{name}.bias"])

    def block(self, i, x):
        name, d, e = f"transformer_blocks.{i}", x.shape[-1], self.options.head
        qkv = self.linear(f"{name}.attn.to_qkv", layer_norm(x, self.state[f"{name}.norm1.weight"]))
        q, k, v = (part.reshape(len(x), d // e, e) for part in np.split(qkv, 3, axis=-1))
        if self.options.qk_norm:
            rms = lambda y, weight: y / np.sqrt((y**2).mean(-1, keepdims=True) + 1e-5) * weight
            q, k = (
                rms(q, self.state[f"{name}.attn.q_norm.weight"]),
                rms(k, self.state[f"{name}.attn.k_norm.weight"]),
            )
        weights = softmax(np.einsum("qhe,khe->hqk", q, k) / np.sqrt(e))
        x = x + self.linear(
            f"{name}.attn.fc", np.einsum("hqk,khe->qhe", weights, v).reshape(len(x), d)
        )
        hidden = self.linear(f"{name}.mlp.mlp.0", layer_norm(x, self.state[f"{name}.norm2.weight"]))
        return x + self.linear(f"{name}.mlp.mlp.2", hidden * 0.5 * (1 + erf(hidden / np.sqrt(2))))

    def upsample(self, depths):
        x = np.concatenate(
            [self.conv(f"upsampler.proj.{i}", x) for i, x in enumerate(depths)], axis=1
        )
        x = self.batch_norm_relu("upsampler.fuse.1", self.conv("upsampler.fuse.0", x))
        x = self.batch_norm_relu(
            "upsampler.up1.1", self.conv("upsampler.up1.0", x, transposed_convolution)
        )
        x = self.batch_norm_relu("upsampler.up1.4", self.conv("upsampler.up1.3", x))
        x = self.batch_norm_relu(
            "upsampler.up2.1", self.conv("upsampler.up2.0", x, transposed_convolution)
        )
        return self.conv("upsampler.up2.3", x)

    def head(self, name, x):
        hidden = np.maximum(self.linear(f"vertex_decoder.{name}.0", x), 0)
        return self.linear(f"vertex_decoder.{name}.2", hidden).reshape(
            len(x), self.options.gaussians, -1
        )

    def subject(self, arrays):
        """Returns every stage of one subject's `in_*` arrays."""
        o, stages = self.options, {}
        image, c2w, posed = arrays["in_image"], arrays["in_c2w"], arrays["in_smpl_posed_vertices"]
        canonical = arrays["in_smpl_canonical_vertices"][0]
        v, _, h, w = image.shape
        s = (canonical[:, 1].max() - canonical[:, 1].min()) / 1.8
        c2w = np.concatenate([c2w[:, :3], np.tile([[[0.0, 0, 0, 1]]], (v, 1, 1))], axis=1)
        c2w[:, :3, 3] /= s
        posed, canonical = posed / s, canonical / s
        fx, fy, cx, cy = (x[:, None, None] for x in arrays["in_fxfycxcy"].T)

        x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
        d = np.stack(np.broadcast_arrays((x - cx) / fx, (y - cy) / fy, 1.0), axis=-1)
        d = np.einsum(
            "vab,vhwb->vhwa", c2w[:, :3, :3], d / np.linalg.norm(d, axis=-1, keepdims=True)
        )
        # the release divides ray origins once more
        o_ = np.broadcast_to(c2w[:, None, None, :3, 3] / s, d.shape)
        stages["out_ray_d"] = np.moveaxis(d, -1, 1)

        texture, position = self.state["neural_texture"], arrays["in_position_map"]
        index = (position + 1) / 2 * (o.texture[0] - 1)
        planes = [
            bilinear(np.moveaxis(plane, -1, 0), index[..., i], index[..., j])
            for plane, (i, j) in zip(texture, ((0, 1), (0, 2), (1, 2)), strict=True)
        ]
        pose = np.concatenate(planes, axis=-1)
        stages["out_pose_feature"] = np.moveaxis(pose, -1, 1)

        pixels = np.concatenate(
            [2 * np.moveaxis(image, 1, -1) - 1, np.cross(o_, d), d, pose], axis=-1
        )
        p, rows, columns = o.patch, h // o.patch, w // o.patch
        patches = pixels.reshape(v, rows, p, columns, p, -1).transpose(0, 1, 3, 2, 4, 5)
        tokens = self.linear("image_tokenizer.1", patches.reshape(v, rows * columns, -1))
        stages["mid_tokens"] = tokens

        x = tokens.reshape(-1, o.width)
        if o.class_token:
            x = np.concatenate([self.state["cls_token"][0], x])
        x = layer_norm(x, self.state["transformer_input_layernorm.weight"])
        depths = []
        for i in range(o.layers):
            x = self.block(i, x)
            depths.append(x)
        stages["mid_block_0"] = depths[0]
        x = stages["mid_encoder_out"] = layer_norm(
            x, self.state["norm.weight"], self.state["norm.bias"]
        )
        as_map = lambda x: np.moveaxis(x[o.class_token :].reshape(v, rows, columns, -1), -1, 1)
        if o.upsampler:
            maps = self.upsample(
                [as_map(y) for y in (*(depths[i * o.layers // 4 - 1] for i in (1, 2, 3)), x)]
            )
            stages["mid_feature_map_stride4"] = maps[:, :, ::4, ::4]
        else:
            maps = as_map(x)

        local, count = 0.0, 0.0
        for view in range(v):
            at = (np.c_[posed[view], np.ones(len(canonical))] @ np.linalg.inv(c2w[view]).T)[:, :3]
            z, (fx, fy, cx, cy) = at[:, 2], arrays["in_fxfycxcy"][view]
            ndc = (
                np.stack([fx * at[:, 0] / (z + 1e-6) + cx, fy * at[:, 1] / (z + 1e-6) + cy])
                / [[w], [h]]
                * 2
                - 1
            )
            seen = np.ones(len(z))
            if not o.all_views:
                i, j = (np.round((ndc[k] + 1) / 2 * (size - 1)) for k, size in enumerate((w, h)))
                inside = (i >= 0) & (i < w) & (j >= 0) & (j < h)
                surface = arrays["in_depth_map"][view, 0][
                    np.where(inside, j, 0).astype(int), np.where(inside, i, 0).astype(int)
                ]
                surface = np.where(inside, surface, 0)
                seen = (z < surface + 0.05) & (z > 0) & (np.abs(ndc) < 1).all(0)
            grid = maps[view]
            index = [
                (ndc[k] + 1) / 2 * (size - 1)
                for k, size in enumerate((grid.shape[2], grid.shape[1]))
            ]
            local, count = local + bilinear(grid, *index) * seen[:, None], count + seen
        entering = local / (count + 1e-8)[:, None]
        if o.class_token:
            entering = np.concatenate([entering, np.repeat(x[:1], len(entering), axis=0)], axis=-1)
        stages["mid_decoder_input"] = entering

        waves = [f(2.0**k * np.pi * canonical) for k in range(6) for f in (np.sin, np.cos)]
        y = np.concatenate([entering, canonical, *waves], axis=-1)
        for layer in ("trunk.0", "trunk.2"):
            y = np.maximum(self.linear(f"vertex_decoder.{layer}", y), 0)
        geometry, appearance = self.head("geo_head", y), self.head("app_head", y)
        stages |= {"mid_raw_geometry": geometry, "mid_raw_appearance": appearance}

        sigmoid = lambda x: 1 / (1 + np.exp(-x))
        flat = lambda x: x.reshape(-1, x.shape[-1])
        means = flat(canonical[:, None] + geometry[..., :3]) * s
        quats = flat(geometry[..., 3:7])
        quats = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
        weights = np.repeat(arrays["in_lbs_weights"], o.gaussians, axis=0)
        if o.skinning_head:
            weights = softmax(np.log(weights + 1e-9) + flat(self.head("lbs_head", y)))
        stages |= {
            "asset_means3D": means,
            "asset_rotations": quats,
            "asset_scales": flat(np.log1p(np.exp(geometry[..., 7:]))) * s,
            "asset_colors": flat(sigmoid(appearance[..., :3])),
            "asset_opacity": flat(sigmoid(appearance[..., 3:])),
            "asset_lbs_weights": weights[::5],
        }
        T = np.einsum("gj,jab->gab", weights, arrays["in_joint_transforms"])
        stages["posed_means3D"] = np.einsum("gab,gb->ga", T[:, :3, :3], means) + T[:, :3, 3]
        stages["posed_rotations"] = np.stack(
            [skinned_quaternion(m, q) for m, q in zip(T[:, :3, :3], quats, strict=True)]
        )
        return stages


def skinned_quaternion(linear, q):
    w, x, y, z = q
    rotation = np.asarray(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
    m = linear @ rotation
    a, b, c = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    d, e, f = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    signs = np.asarray([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    squared = np.maximum(0, 1 + signs @ np.diag(m))
    candidates = np.asarray([[0, a, b, c], [a, 0, d, e], [b, d, 0, f], [c, e, f, 0]]) + np.diag(
        squared
    )
    best = np.argmax(squared)
    return candidates[best] / (2 * max(np.sqrt(squared[best]), 0.1))


def triple(options, seed=0):
    """Returns (state dict, arrays, release configuration) of made-up numbers.

    The arrays are inputs and every stage, stored as float32.
    """
    state = random_state(options, seed)
    arrays = random_inputs(options, state, seed + 1)
    network, subjects = Network(state, options), []
    for index in range(options.subjects):
        take = lambda name, x, index=index: x if name == "in_lbs_weights" else x[index]
        subjects.append(
            network.subject({name: take(name, x).astype(np.float64) for name, x in arrays.items()})
        )
    per_view = ("mid_tokens", "mid_feature_map_stride4")

    def join(name):
        return (np.concatenate if name in per_view else np.stack)(
            [stages[name] for stages in subjects]
        )

    return (
        state,
        arrays | {name: join(name).astype(np.float32) for name in subjects[0]},
        options.release_config(),
    )
