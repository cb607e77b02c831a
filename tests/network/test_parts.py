"""Another part in place of one of the paper's: in the network, in training, in files of weights."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_cases import TINY, random_inputs

from humangs_jax.core.configuration import (
    Width,
    config_from_json,
    config_to_json,
    field_names,
    part,
    vary,
)
from humangs_jax.network.config import Architecture, paper_parts
from humangs_jax.network.humangs import (
    apply_humangs,
    decode,
    encode,
    init_humangs,
    intermediates,
    read,
)
from humangs_jax.network.parts import (
    Decoder,
    Encoder,
    Encoding,
    ForwardContext,
    HumanGSInputs,
    Reader,
    VertexFeatures,
)
from humangs_jax.network.vertex_decoder import positional_encoding
from humangs_jax.network.weights import load_weights, save_weights


@part
class LookingReader(Reader):
    """Vertices attend to all tokens of all views, by their canonical position."""

    width: Width = 8

    @nn.compact
    def __call__(
        self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> VertexFeatures:
        tokens = encoding.maps.reshape(-1, encoding.maps.shape[-1])
        dense = lambda name: nn.Dense(self.width, use_bias=False, name=name)
        queries = dense("query")(positional_encoding(inputs.canonical_vertices))
        attention = jax.nn.softmax(queries @ dense("key")(tokens).T * self.width**-0.5)
        return VertexFeatures(
            attention @ tokens, encoding.global_token, normals=inputs.canonical_normals
        )


DECODER = dataclasses.replace(paper_parts(TINY.architecture)[2], residual_color=False)
CONFIG = TINY.with_parts(reader=LookingReader(), decoder=DECODER)


def test_the_papers_parts_are_parts():
    encoder, reader, decoder = paper_parts(TINY.architecture)
    assert (
        isinstance(encoder, Encoder) and isinstance(reader, Reader) and isinstance(decoder, Decoder)
    )
    with pytest.raises(ValueError, match="LookingReader"):
        paper_parts(CONFIG.architecture)


@pytest.mark.slow
def test_another_reader_is_trained_and_saved_like_the_papers(tmp_path):
    variables, inputs = init_humangs(jax.random.key(0), CONFIG), random_inputs()
    assert set(variables["params"]["reader"]) == {"query", "key"}

    def loss(params):
        outputs, _ = apply_humangs({**variables, "params": params}, inputs, CONFIG, train=True)
        return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(outputs.gaussians))

    gradients = jax.jit(jax.grad(loss))(variables["params"])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(gradients))
    assert all(np.abs(x).max() > 0 for x in jax.tree.leaves(gradients["reader"]))

    save_weights(tmp_path / "w.safetensors", variables, CONFIG)
    loaded, config = load_weights(tmp_path / "w.safetensors")
    assert config == CONFIG.trained
    for ours, saved in zip(jax.tree.leaves(loaded), jax.tree.leaves(variables), strict=True):
        np.testing.assert_array_equal(ours, saved)


def test_a_part_is_named_in_json_and_found_again():
    text = config_to_json(CONFIG.architecture)
    assert config_from_json(Architecture, text) == CONFIG.architecture
    with pytest.raises(ValueError, match=r"config\.decoder\.kind: expected .* Decoder"):
        config_from_json(Architecture, '{"decoder": {"kind": "Runtime"}}')


def test_a_part_of_this_name_exists_once_and_only_a_registered_one_is_written():
    with pytest.raises(
        ValueError, match=r"part LookingReader of elsewhere: .*test_parts has one of this name"
    ):
        part(type("LookingReader", (Reader,), {"__module__": "elsewhere", "__annotations__": {}}))

    class Plain(LookingReader):
        pass

    with pytest.raises(ValueError, match="Plain is no registered part"):
        config_to_json(TINY.with_parts(reader=Plain()).architecture)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LookingReader(width=0), r"LookingReader\.width 0: expected 1 to"),
        (lambda: LookingReader(width="8"), "LookingReader.width: expected int, got '8'"),
        (
            lambda: vary(CONFIG, {"architecture.reader.parent": None}),
            r"reader\.parent: .* no such field; did you mean",
        ),
    ],
)
def test_fields_of_parts_are_checked(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_parts_are_compared_by_their_configuration():
    assert (
        LookingReader(width=4) == vary(CONFIG, {"architecture.reader.width": 4}).architecture.reader
    )
    assert (
        LookingReader(width=4) != LookingReader()
        and len({LookingReader(), LookingReader(width=8)}) == 1
    )
    for made in (LookingReader(), TINY.architecture.decoder):
        with pytest.raises(dataclasses.FrozenInstanceError, match="cannot assign to field"):
            setattr(made, next(iter(field_names(type(made)))), 4)


@pytest.mark.slow
def test_the_pass_is_its_three_parts_and_can_be_looked_into():
    variables, inputs = init_humangs(jax.random.key(0), TINY), random_inputs()
    outputs, _ = jax.jit(lambda v: apply_humangs(v, inputs, TINY))(variables)
    encoding = encode(variables, inputs, TINY)
    parts = decode(variables, read(variables, encoding, inputs, TINY), inputs, TINY)
    for a, b in zip(
        jax.tree.leaves(outputs.gaussians), jax.tree.leaves(parts.gaussians), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)  # fused in other ways
    found = jax.eval_shape(lambda v: intermediates(v, inputs, TINY), variables)
    assert {
        "encoder",
        "encoder.tokenizer",
        "encoder.transformer.block_3",
        "reader",
        "decoder.geometry_out",
    } <= set(found)
    assert (
        found["encoder"].maps.shape == encoding.maps.shape
        and found[""].gaussians.means.shape == outputs.gaussians.means.shape
    )
