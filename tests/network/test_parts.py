"""A part that is not the paper's takes the place of one: in the pass, in training, in weights files."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_cases import TINY, random_inputs

from humangs_jax.core.array_types import Float, Key
from humangs_jax.core.configuration import Width, config_from_json, config_to_json, part
from humangs_jax.network.config import Architecture, paper_parts
from humangs_jax.network.humangs import apply_humangs, decode, encode, init_humangs, read
from humangs_jax.network.inputs import HumanGSInputs
from humangs_jax.network.parts import Decoder, Encoder, Encoding, Pass, Reader, Variables, VertexFeatures
from humangs_jax.network.stages import Recorder
from humangs_jax.network.vertex_decoder import positional_encoding
from humangs_jax.network.weights import load_weights, save_weights


@part
class LookingReader:
    """Vertices look at all tokens of all views, by their canonical position."""

    width: Width = 8

    def init(self, key: Key, encoding: Encoding, inputs: HumanGSInputs, run: Pass) -> Variables:
        queries, keys = jax.random.split(key)
        tokens = encoding.maps.shape[-1]
        draw = lambda key, rows: jax.random.normal(key, (rows, self.width)) * rows**-0.5
        return {"params": {"query": draw(queries, 39), "key": draw(keys, tokens)}}

    def apply(self, variables: Variables, encoding: Encoding, inputs: HumanGSInputs, run: Pass) -> VertexFeatures:
        params, tokens = variables["params"], encoding.maps.reshape(-1, encoding.maps.shape[-1])
        queries: Float[jax.Array, "n e"] = positional_encoding(inputs.canonical_vertices) @ params["query"]
        attention = jax.nn.softmax(queries @ (tokens @ params["key"]).T * self.width**-0.5)
        return VertexFeatures(attention @ tokens, encoding.global_token, normals=inputs.canonical_normals)


DECODER = dataclasses.replace(paper_parts(TINY.architecture)[2], residual_color=False)
CONFIG = TINY.with_parts(reader=LookingReader(), decoder=DECODER)


def test_the_papers_parts_are_parts():
    encoder, reader, decoder = paper_parts(TINY.architecture)
    assert isinstance(encoder, Encoder) and isinstance(reader, Reader) and isinstance(decoder, Decoder)
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
    with pytest.raises(ValueError, match=r"part LookingReader of elsewhere: .*test_parts has one of this name"):
        part(type("LookingReader", (), {"__module__": "elsewhere", "__annotations__": {}}))
    plain = dataclasses.make_dataclass("Plain", [], bases=(LookingReader,), frozen=True)
    with pytest.raises(ValueError, match="Plain is no registered part"):
        config_to_json(TINY.with_parts(reader=plain()).architecture)


@pytest.mark.slow
def test_the_pass_is_its_three_parts_and_names_its_stages():
    variables, inputs, recorder = init_humangs(jax.random.key(0), TINY), random_inputs(), Recorder()
    outputs, _ = jax.jit(lambda v: apply_humangs(v, inputs, TINY))(variables)
    encoding = encode(variables, inputs, TINY)
    parts = decode(variables, read(variables, encoding, inputs, TINY), inputs, TINY)
    jax.eval_shape(lambda v: apply_humangs(v, inputs, TINY, stage=recorder)[0], variables)
    assert list(recorder.outputs) == ["pixels", "encoding", "vertex features", "raw heads", "canonical Gaussians"]
    for a, b in zip(jax.tree.leaves(outputs.gaussians), jax.tree.leaves(parts.gaussians), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)  # fused in other ways
