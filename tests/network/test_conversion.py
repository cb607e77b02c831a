import dataclasses
import os

import jax
import network_oracle as oracle
import numpy as np
import pytest
from command_line import run
from network_cases import random_variables
from network_golden import CHECKPOINT
from network_oracle import Options
from safetensors.numpy import save_file
from torch_writer import FakeTensor, tensors, write_checkpoint

from humangs_jax.losses.loss_networks import expected_tensors, load_lpips
from humangs_jax.network.config import paper_parts
from humangs_jax.network.conversion import (
    describe,
    expected_shapes,
    infer_config,
    load_checkpoint,
    read_state_dict,
    to_release,
)
from humangs_jax.network.presets import published
from humangs_jax.network.transformer import TransformerConfig
from humangs_jax.network.weights import load_weights

VARIANTS = [
    Options(),
    Options(class_token=False, gaussians=1, patch=12, texture=(9, 5)),
    Options(upsampler=False, layers=3, gaussians=3, skinning_head=True, joints=21),
    Options(class_token=False, upsampler=False, skinning_head=True, layers=1, patch=4),
    Options(width=48, head=16, layers=8),
]


def write(folder, state, **others):
    return write_checkpoint(folder / "a.pt", {"model": tensors(state), **others})


@pytest.mark.slow
@pytest.mark.parametrize("options", VARIANTS)
def test_the_configuration_is_read_off_the_shapes(options, tmp_path):
    state = oracle.random_state(options)
    converted = load_checkpoint(write(tmp_path, state))
    config = converted.config
    encoder, reader, decoder = paper_parts(config.architecture)
    transformer = encoder.transformer
    assert (transformer.width, transformer.layers, transformer.mlp_ratio) == (
        options.width,
        options.layers,
        4,
    )
    assert transformer.head_width == options.head and transformer.qk_norm
    assert (
        transformer.class_token == options.class_token
        and (encoder.upsampler is not None) == options.upsampler
    )
    assert encoder.patch_size == options.patch
    assert (encoder.texture.resolution, encoder.texture.channels) == options.texture
    assert (decoder.hidden, decoder.tight, decoder.free) == (8, 1, options.gaussians - 1)
    assert decoder.skinning_joints == (options.joints if options.skinning_head else None)
    if options.upsampler:
        assert (encoder.upsampler.hidden, reader.output_width) == (8, options.width)
    # conventions are those of the paper, in a size that patches divide
    size = config.conventions.image_size
    assert (
        config.conventions == published().with_conventions(image_size=size).conventions
        and size % options.patch == 0
    )
    back = to_release(converted.variables) | {"tpose_lbs_weights": converted.skinning_weights}
    assert {key: x.shape for key, x in back.items()} == {key: x.shape for key, x in state.items()}
    for key, value in state.items():
        assert key.endswith("num_batches_tracked") or np.array_equal(back[key], value), key


def test_the_golden_checkpoint():
    converted = load_checkpoint(CHECKPOINT)
    assert converted.skipped == 4  # frozen loss networks
    assert converted.skinning_weights.shape == (300, 55)
    encoder, _, _ = paper_parts(converted.config.architecture)
    assert (encoder.transformer.width, encoder.upsampler.hidden) == (64, 16)
    line = describe(converted)
    assert "4 layers of 4 heads" in line and ", upsampler" in line and "no skinning head" in line


def test_shapes_of_the_published_network():
    shapes = expected_shapes(published())
    assert shapes["image_tokenizer.1.weight"] == (768, 64 * 57) and shapes["neural_texture"] == (
        3,
        128,
        128,
        16,
    )
    assert shapes["transformer_blocks.11.mlp.mlp.2.weight"] == (768, 3072) and shapes[
        "cls_token"
    ] == (1, 1, 768)
    assert shapes["upsampler.up1.0.weight"] == (512, 256, 4, 4) and shapes[
        "upsampler.up2.3.weight"
    ] == (768, 128, 3, 3)
    assert shapes["vertex_decoder.trunk.0.weight"] == (256, 768 + 768 + 39)
    state = {key: np.broadcast_to(np.float32(0), shape) for key, shape in shapes.items()}
    assert infer_config(state) == published()
    learned = [n for key, n in shapes.items() if "running" not in key and "num_batches" not in key]
    assert 95e6 < sum(np.prod(shape) for shape in learned) < 103e6


def test_a_made_up_network_goes_there_and_back(tmp_path):
    config = infer_config(oracle.random_state(Options()))
    sizes = TransformerConfig(width=128, layers=4)
    config = config.with_parts(
        encoder=dataclasses.replace(config.architecture.encoder, transformer=sizes)
    )
    variables = random_variables(config)
    state = to_release(variables) | {"tpose_lbs_weights": np.ones((2, 55), np.float32)}
    back = load_checkpoint(write(tmp_path, state))
    assert back.config == config
    assert all(
        np.array_equal(*pair)
        for pair in zip(*map(jax.tree.leaves, (variables, back.variables)), strict=True)
    )


def test_heads_without_norms_need_their_width(tmp_path):
    path = write(tmp_path, oracle.random_state(Options(qk_norm=False)))
    with pytest.raises(
        ValueError, match=r"a\.pt: no tensor .*q_norm.weight' tells the width of a head"
    ):
        load_checkpoint(path)
    transformer = load_checkpoint(path, head_width=4).config.architecture.encoder.transformer
    assert transformer.head_width == 4 and not transformer.qk_norm
    for wrong, message in ((5, "multiple of head_width 5"), (0, "at least 1")):
        with pytest.raises(ValueError, match=message):
            load_checkpoint(path, head_width=wrong)
    with pytest.raises(ValueError, match="says heads of 8, not 4"):
        load_checkpoint(write(tmp_path, oracle.random_state(Options())), head_width=4)


def test_safetensors_state_dicts(tmp_path):
    state = oracle.random_state(Options())
    save_file(state | {"loss_computer.x": np.zeros(2, np.float32)}, tmp_path / "a.safetensors")
    ours, other = (
        load_checkpoint(tmp_path / "a.safetensors"),
        load_checkpoint(write(tmp_path, state)),
    )
    assert ours.config == other.config and ours.skipped == 1 and other.skipped == 0
    leaves = zip(*(jax.tree.leaves(x.variables) for x in (ours, other)), strict=True)
    assert all(np.array_equal(*pair) for pair in leaves)
    (tmp_path / "broken.safetensors").write_bytes((tmp_path / "a.safetensors").read_bytes()[:-9])
    with pytest.raises(ValueError, match="not a readable safetensors file"):
        read_state_dict(tmp_path / "broken.safetensors")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_state_dict(tmp_path / "nowhere.safetensors")


def test_half_precision_checkpoints(tmp_path):
    state = {
        key: x if x.ndim == 0 else x.astype(np.float16)
        for key, x in oracle.random_state(Options()).items()
    }
    variables = load_checkpoint(write(tmp_path, state)).variables
    assert all(x.dtype == np.float32 for x in jax.tree.leaves(variables))


@pytest.mark.parametrize("options", (VARIANTS[0], VARIANTS[2]))
def test_every_missing_tensor_is_named(options, monkeypatch):
    from humangs_jax.network import conversion

    state = oracle.random_state(options)
    for key in state:
        if key == "cls_token":
            continue  # a network without one; the decoder's width tells that it is not
        rest = {name: x for name, x in state.items() if name != key}
        monkeypatch.setattr(conversion, "read_state_dict", lambda path, rest=rest: (rest, 0))
        with pytest.raises(ValueError, match=f"x: tensor '{key.replace('.', '[.]')}' is missing"):
            load_checkpoint("x")


@pytest.mark.slow
def test_every_wrong_shape_is_noticed(monkeypatch):
    from humangs_jax.network import conversion

    state = oracle.random_state(Options(skinning_head=True))
    named = 0
    for key, value in state.items():
        if key in ("tpose_lbs_weights", "neural_texture"):
            continue  # the number of vertices, and of texels, is free
        for wrong in (np.concatenate([value, value]) if value.ndim else np.zeros(1), value[None]):
            spoilt = state | {key: wrong}
            monkeypatch.setattr(
                conversion, "read_state_dict", lambda path, spoilt=spoilt: (spoilt, 0)
            )
            with pytest.raises(ValueError, match=r"x: .*(shape|inputs|multiple)") as error:
                load_checkpoint("x")
            named += f"'{key}'" in str(error.value)
    assert named > 1.7 * len(state)  # a tensor that tells a size may put the blame on the others


def change(key, value):
    return lambda state: state | {key: value}


REFUSED = {
    "unknown": (
        change("decoder.weight", np.zeros(3, np.float32)),
        "tensor 'decoder.weight' is not part",
    ),
    "a block of no number": (
        change("transformer_blocks.x.norm1.weight", np.zeros(3, np.float32)),
        "transformer_blocks",
    ),
    "a block too far": (
        change("transformer_blocks.99.norm1.weight", np.zeros(16, np.float32)),
        "'transformer_blocks.4.norm1.weight' is missing",
    ),
    "canonical target maps": (
        change("target_pose_tokenizer.1.weight", np.zeros(3, np.float32)),
        "target_pose_tokenizer",
    ),
    "not finite": (
        change("norm.bias", np.full(16, np.nan, np.float32)),
        "'norm.bias' holds numbers that are not finite",
    ),
    "class token removed": (
        lambda state: {key: x for key, x in state.items() if key != "cls_token"},
        "'vertex_decoder.trunk.0.weight' has shape",
    ),
    "no square patch": (
        change("image_tokenizer.1.weight", np.zeros((16, 64 * 15 + 1), np.float32)),
        "image_tokenizer.1.weight' has 961 inputs",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_the_command_refuses_by_name_and_writes_nothing(case, tmp_path, monkeypatch, capsys):
    spoil, message = REFUSED[case]
    path = write(tmp_path, spoil(oracle.random_state(Options())))
    code, out, error = run(
        monkeypatch, capsys, "convert", path, "--out", tmp_path / "w.safetensors"
    )
    assert (
        code == 1 and out == "" and error.count("\n") == 1 and message in error and "a.pt" in error
    )
    assert os.listdir(tmp_path) == ["a.pt"]


def test_the_command_refuses_code(tmp_path, monkeypatch, capsys):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "owned"),)

    path = write(tmp_path, oracle.random_state(Options()), lr_scheduler=Evil())
    code, _, error = run(monkeypatch, capsys, "convert", path, "--out", tmp_path / "w.safetensors")
    assert code == 1 and error.count("\n") == 1 and "refused to load" in error and ".mkdir" in error
    assert os.listdir(tmp_path) == ["a.pt"]


def test_the_command_converts(tmp_path, monkeypatch, capsys):
    state = oracle.random_state(Options(qk_norm=False))
    # tensors of the training losses are no part of the network
    losses = {
        "loss_computer.a": FakeTensor(np.ones(2, np.float32)),
        "loss_computer.b": FakeTensor(np.ones(2, np.float32)),
    }
    path = write_checkpoint(tmp_path / "a.pt", {"model": tensors(state) | losses, "optimizer": {}})
    weights = tmp_path / "w.safetensors"
    code, out, error = run(
        monkeypatch,
        capsys,
        "convert",
        path,
        "--out",
        weights,
        "--head-width",
        "4",
        "--pool",
        "visible",
    )
    assert code == 0, error
    assert "skipped 2 tensors" in out and "loss_computer" in out and "4 layers of 4 heads" in out
    variables, config = load_weights(weights)
    converted = load_checkpoint(path, head_width=4)
    assert config.conventions.pool == "visible" and converted.config.conventions.pool == "all"
    assert config.with_conventions(pool="all") == converted.config.trained
    leaves = zip(*map(jax.tree.leaves, (variables, converted.variables)), strict=True)
    assert all(np.array_equal(*pair) for pair in leaves)
    # what is converted already, and a file onto itself, are refused
    code, _, error = run(
        monkeypatch, capsys, "convert", weights, "--out", tmp_path / "again.safetensors"
    )
    assert code == 1 and "a weights file already" in error
    code, _, error = run(monkeypatch, capsys, "convert", weights, "--out", weights)
    assert code == 2 and "is read by this command" in error
    assert sorted(os.listdir(tmp_path)) == ["a.pt", "w.safetensors"]


def loss_networks():
    """Returns LPIPS squeeze as a released checkpoint has it, with its heads twice."""
    draw = np.random.default_rng(0)
    layers = expected_tensors("SqueezeNet 1.1").items()
    state = {
        f"net.slice1.{key}": draw.normal(size=shape).astype(np.float32) for key, shape in layers
    }
    for i, count in enumerate((64, 128, 256, 384, 384, 512, 512)):
        state[f"lin{i}.model.1.weight"] = state[f"lins.{i}.model.1.weight"] = np.ones(
            (1, count, 1, 1), np.float32
        )
    return {f"loss_computer.lpips_loss_module.{key}": x for key, x in state.items()}


def test_the_command_keeps_the_loss_networks(tmp_path, monkeypatch, capsys):
    losses, weights, networks = (
        tmp_path / "losses.safetensors",
        tmp_path / "w.safetensors",
        loss_networks(),
    )
    path = write(tmp_path, oracle.random_state(Options()) | networks)
    code, out, error = run(
        monkeypatch, capsys, "convert", path, "--out", weights, "--losses", losses
    )
    assert code == 0 and f"{losses}: LPIPS squeeze" in out and "skipped" not in out, error
    assert sorted(os.listdir(tmp_path)) == ["a.pt", "losses.safetensors", "w.safetensors"]
    kernel = load_lpips("squeeze", losses).backbone["3.squeeze"].kernel
    expected = networks["loss_computer.lpips_loss_module.net.slice1.3.squeeze.weight"]
    assert np.array_equal(kernel, expected.transpose(2, 3, 1, 0))


def test_parts_of_loss_networks_are_refused(tmp_path, monkeypatch, capsys):
    """The golden checkpoint has only four small tensors of them."""
    arguments = ("--out", tmp_path / "w.safetensors", "--losses", tmp_path / "losses.safetensors")
    code, _, error = run(monkeypatch, capsys, "convert", CHECKPOINT, *arguments)
    assert code == 1 and "perceptual_loss_module.vgg.features.0.bias' of VGG-19 is missing" in error
    assert os.listdir(tmp_path) == []
