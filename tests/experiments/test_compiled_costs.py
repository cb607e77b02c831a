"""Counts of compiled programs against what the arithmetic is known to be."""

import functools
import math
import re

import jax
import jax.numpy as jnp
import pytest

from experiments.common import compiled_costs as costs
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.network.config import paper_parts
from humangs_jax.network.humangs import encode
from humangs_jax.network.inputs import HumanGSInputs
from humangs_jax.network.presets import tiny
from humangs_jax.network.weights import expected_variables

SMALL_EXTRAS = 1.02  # of loop counters, indices and the like beside the arrays that a test counts
NORMS_SHARE = 0.1  # of transcendentals: one root per normalised vector
ENCODE_SHARE = 0.01  # of dots that the sum over the layers leaves out: inverses of cameras


def arrays(*shapes, dtype=jnp.float32):
    return [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]


def compile_for(function, *shapes):
    return jax.jit(function).lower(*arrays(*shapes)).compile()


def nested(xs):
    """For each of xs five products."""

    def outer(carry, x):
        inner = lambda y, _: (jnp.tanh(y @ x), None)
        return jax.lax.scan(inner, carry, None, length=5)[0], None

    return jax.lax.scan(outer, xs[0], xs)[0]


def test_matrix_product():
    counted = costs.compiled_costs(compile_for(jnp.matmul, (64, 32), (32, 48)))
    assert counted.dot_flops == counted.matrix_flops == 2 * 64 * 32 * 48
    assert counted.bytes_accessed == 4 * (64 * 32 + 32 * 48 + 64 * 48)
    assert (counted.convolution_flops, counted.transcendentals, counted.uncounted, counted.unknown_trips) == (
        0,
        0,
        (),
        0,
    )
    assert counted.argument_bytes == 4 * (64 * 32 + 32 * 48) and counted.output_bytes == 4 * 64 * 48


@pytest.mark.parametrize("equation", ["bij,bjk->bik", "bji,bjk->bik", "ibj,bkj->bik"])
def test_batched_products(equation):
    sizes = {"b": 4, "i": 24, "j": 32, "k": 16}
    shapes = [[sizes[axis] for axis in operand] for operand in equation.split("->")[0].split(",")]
    counted = costs.compiled_costs(compile_for(functools.partial(jnp.einsum, equation), *shapes))
    assert counted.dot_flops == 2 * math.prod(sizes.values())


def test_two_contracted_axes():
    counted = costs.compiled_costs(compile_for(lambda a, b: jnp.tensordot(a, b, 2), (10, 6, 8), (6, 8, 12)))
    assert counted.dot_flops == 2 * 10 * 6 * 8 * 12


def test_loops_count_as_often_as_they_run():
    compiled = compile_for(lambda xs: jax.lax.map(lambda x: x @ x, xs), (8, 32, 32))
    counted = costs.compiled_costs(compiled)
    assert counted.dot_flops == 8 * 2 * 32**3 and counted.unknown_trips == 0
    analysis = compiled.cost_analysis()  # XLA's own counts the body once: the reason for this module
    assert analysis["flops"] < 1.1 * 2 * 32**3
    # in turn: a slice read and written, x @ x, the result read and written; and the buffer of the results set to 0
    assert 1 <= counted.bytes_accessed / (4 * 32 * 32 * (8 * 6 + 8)) < SMALL_EXTRAS


def test_nested_loops():
    counted = costs.compiled_costs(compile_for(nested, (7, 32, 32)))
    assert counted.dot_flops == 7 * 5 * 2 * 32**3
    assert counted.transcendentals == 7 * 5 * 32 * 32


def test_trips_from_the_condition():
    text = compile_for(nested, (7, 32, 32)).as_text()
    bare = re.sub(r'"known_trip_count":\{[^}]*\}', '"dynamic":[]', text)
    assert bare != text
    assert costs.program_costs(bare) == costs.program_costs(text)
    assert costs.program_costs(bare).unknown_trips == 0


def test_trips_that_depend_on_data():
    def until_large(x):
        return jax.lax.while_loop(lambda y: jnp.sum(y) < 1e9, lambda y: y @ y, x)

    def as_long(x, count):
        return jax.lax.fori_loop(0, count, lambda _, y: y @ y, x)

    assert costs.compiled_costs(compile_for(until_large, (32, 32))).unknown_trips == 1
    compiled = jax.jit(as_long).lower(*arrays((32, 32)), *arrays((), dtype=jnp.int32)).compile()
    counted = costs.compiled_costs(compiled)
    assert counted.unknown_trips == 1 and counted.dot_flops == 2 * 32**3


@pytest.mark.parametrize("groups", [1, 2])
@pytest.mark.parametrize("padding", ["SAME", "VALID"])
def test_convolution(groups, padding):
    convolve = functools.partial(
        jax.lax.conv_general_dilated,
        window_strides=(1, 1),
        padding=padding,
        feature_group_count=groups,
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    counted = costs.compiled_costs(compile_for(convolve, (2, 16, 12, 8), (3, 5, 8 // groups, 12)))
    height, width = (16, 12) if padding == "SAME" else (14, 8)
    assert counted.convolution_flops == 2 * (2 * height * width * 12) * 3 * 5 * (8 // groups)
    assert counted.dot_flops == 0 and counted.matrix_flops == counted.convolution_flops


@pytest.mark.parametrize("stride", [1, 2])
def test_gradients_of_a_convolution_cost_what_it_does(stride):
    def loss(x, w):
        layout = ("NHWC", "HWIO", "NHWC")
        return jnp.sum(jax.lax.conv_general_dilated(x, w, (stride, stride), "SAME", dimension_numbers=layout) ** 2)

    counted = costs.compiled_costs(compile_for(jax.grad(loss, (0, 1)), (2, 16, 16, 8), (3, 3, 8, 12)))
    forward = 2 * (2 * (16 // stride) ** 2 * 12) * 9 * 8
    assert counted.convolution_flops == 3 * forward


def test_transposed_convolution_multiplies_no_inserted_zeros():
    up = lambda x, w: jax.lax.conv_transpose(x, w, (2, 2), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))
    counted = costs.compiled_costs(compile_for(up, (1, 8, 8, 6), (4, 4, 6, 10)))
    assert counted.convolution_flops == 2 * (16 * 16 * 10) * 4 * 4 * 6 // 4


def test_gradient_of_what_is_recomputed():
    def loss(x, w):
        return jnp.sum(jnp.tanh(jnp.tanh(x @ w) @ w))

    plain = costs.compiled_costs(compile_for(jax.grad(loss), (48, 32), (32, 32)))
    product = 2 * 48 * 32 * 32
    assert plain.dot_flops == 4 * product  # each product, and each one's gradient to its left factor

    policy = jax.checkpoint_policies.nothing_saveable
    # a barrier, as a scan has: without it XLA would find the two computations to be the same
    remat = jax.checkpoint(
        lambda x, w: jax.lax.scan(lambda y, _: (jnp.tanh(y @ w), None), x, None, 6)[0], policy=policy
    )
    counted = costs.compiled_costs(compile_for(jax.grad(lambda x, w: jnp.sum(remat(x, w))), (48, 32), (32, 32)))
    assert counted.dot_flops == 2 * 6 * product  # XLA drops the first pass: its results are not asked for


def test_transcendentals():
    counted = costs.compiled_costs(compile_for(lambda x: jnp.exp(x) + jnp.log(x[:16]).sum(), (64, 48)))
    assert counted.transcendentals == 64 * 48 + 16 * 48
    softmax = costs.compiled_costs(compile_for(lambda x: jax.nn.softmax(x @ x.T), (64, 48)))
    assert softmax.transcendentals == 64 * 64
    assert softmax.dot_flops == 2 * 64 * 64 * 48


def test_conditional_costs_its_largest_branch():
    def branches(which, x):
        return jax.lax.switch(which, [lambda x: x, lambda x: x @ x @ x, lambda x: jnp.exp(x @ x)], x)

    compiled = jax.jit(branches).lower(*arrays((), dtype=jnp.int32), *arrays((32, 32))).compile()
    counted = costs.compiled_costs(compiled)
    assert counted.dot_flops == 2 * 2 * 32**3 and counted.transcendentals == 0


def test_fusions_move_only_what_enters_and_leaves():
    chain = lambda x, y: jnp.sin(x * y + 1) * jnp.cos(x - y)
    counted = costs.compiled_costs(compile_for(chain, (512, 100), (512, 100)))
    assert counted.bytes_accessed == 3 * 4 * 512 * 100
    assert counted.transcendentals == 2 * 512 * 100
    large = costs.compiled_costs(compile_for(chain, (1024, 2048), (1024, 2048)))  # CPUs share it among threads
    assert large.bytes_accessed == 3 * 4 * 1024 * 2048
    assert large.transcendentals == 2 * 1024 * 2048


def test_slices_read_their_part_of_a_buffer():
    def read(buffer, index):
        return 2 * jax.lax.dynamic_slice_in_dim(buffer, index, 4)

    compiled = jax.jit(read).lower(*arrays((5000, 32)), *arrays((), dtype=jnp.int32)).compile()
    assert 1 <= costs.compiled_costs(compiled).bytes_accessed / (2 * 4 * 4 * 32) < SMALL_EXTRAS


def test_updates_write_their_part_of_a_buffer():
    def write(buffer, rows):
        body = lambda i, x: jax.lax.dynamic_update_slice_in_dim(x, rows[i][None] + 1, 3 * i, 0)
        return jax.lax.fori_loop(0, 100, body, buffer)

    lowered = jax.jit(write, donate_argnums=0).lower(*arrays((5000, 32), (100, 32)))
    row = 4 * 32
    counted = costs.compiled_costs(lowered.compile())
    assert 100 * 2 * row <= counted.bytes_accessed < 100 * 5 * row  # a row may go through memory on its way
    kept = costs.compiled_costs(jax.jit(write).lower(*arrays((5000, 32), (100, 32))).compile())
    assert kept.bytes_accessed == counted.bytes_accessed + 2 * 5000 * row  # what is not given away is copied first


def empty_inputs(views, size, vertices=20):
    """What the encoder takes, all zeros."""
    K = intrinsics_from_fov(0.8, size, size)
    return HumanGSInputs(
        images=jnp.zeros((views, size, size, 3)),
        cameras=orbit(jnp.zeros(3), 3.0, jnp.zeros(views), 0.1, K, size, size),
        posed_vertices=jnp.zeros((views, vertices, 3)),
        canonical_vertices=jnp.zeros((vertices, 3)),
        position_maps=jnp.zeros((views, size, size, 3)),
        depth_maps=jnp.zeros((views, size, size)),
        foreground=jnp.zeros((views, size, size), bool),
        posed_normals=jnp.zeros((views, vertices, 3)),
        canonical_normals=jnp.zeros((vertices, 3)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("tokens", ["all", "foreground"])
def test_encoder_of_the_tiny_preset(tokens):
    config = tiny().with_execution(tokens=tokens)
    encoder = paper_parts(config.architecture)[0]
    views, size = 2, 32
    inputs = jax.eval_shape(lambda: empty_inputs(views, size))
    compiled = encode.lower(expected_variables(config), inputs, config=config).compile()
    counted = costs.compiled_costs(compiled)

    side, width, hidden = size // encoder.patch_size, encoder.transformer.width, encoder.upsampler.hidden
    patches = views * side**2
    slots = patches if tokens == "all" else config.execution.token_capacity
    length = slots + 1
    channels = 9 + 3 * encoder.texture.channels
    layer = length * width * (3 + 1 + 2 * encoder.transformer.mlp_ratio) * width + 2 * length * length * width
    products = {
        "rays": views * size**2 * 3 * 3,
        "tokenizer": slots * encoder.patch_size**2 * channels * width,
        "layers": encoder.transformer.layers * layer,
        "projections": 4 * patches * width * hidden,
        "up1": views * (side + 1) ** 2 * 4 * (2 * hidden) * 4 * hidden,
        "up2": views * (2 * side + 1) ** 2 * 4 * hidden * 4 * (hidden // 2),
    }
    assert counted.dot_flops == pytest.approx(2 * sum(products.values()), rel=ENCODE_SHARE)
    # the first 3x3 convolution and the one between the doublings
    convolutions = views * side**2 * 9 * 4 * hidden * 2 * hidden + views * (2 * side) ** 2 * 9 * hidden * hidden
    assert counted.convolution_flops >= 2 * convolutions
    softmax = (width // encoder.transformer.head_width) * length**2
    gelu = length * encoder.transformer.mlp_ratio * width
    transcendentals = encoder.transformer.layers * (softmax + gelu) + views * size**2  # rays are made unit vectors
    assert 1 <= counted.transcendentals / transcendentals < 1 + NORMS_SHARE
    assert counted.unknown_trips == 0 and counted.uncounted == ()


GEMM = '"dot_dimension_numbers":{"lhs_contracting_dimensions":["1"],"rhs_contracting_dimensions":["0"]}'
FMHA = '"intermediate_tensor_shape":{"element_type":"BF16","dimensions":["1","2","50","40"],"tuple_shapes":[]}'
CONVOLUTION = 'window={size=3x3 pad=1_1x1_1}, dim_labels=b01f_o01i->b01f, custom_call_target="__cudnn$conv'
QUERIES, KEYS = "bf16[1,2,50,16]{3,1,2,0}", "bf16[1,2,40,16]{3,1,2,0}"
ON_A_GPU = f"""HloModule jit_step, is_scheduled=true

%gemm_fusion_dot_computation (p.0: bf16[64,32], p.1: bf16[32,48]) -> bf16[64,48] {{
  %p.0 = bf16[64,32]{{1,0}} parameter(0)
  %p.1 = bf16[32,48]{{1,0}} parameter(1)
  ROOT %dot.1 = bf16[64,48]{{1,0}} dot(%p.0, %p.1), lhs_contracting_dims={{1}}, rhs_contracting_dims={{0}}
}}

%command_buffer (q.0: bf16[64,32], q.1: bf16[32,48]) -> bf16[64,48] {{
  %q.0 = bf16[64,32]{{1,0}} parameter(0)
  %q.1 = bf16[32,48]{{1,0}} parameter(1)
  ROOT %gemm_fusion_dot = bf16[64,48]{{1,0}} fusion(%q.0, %q.1), kind=kCustom, calls=%gemm_fusion_dot_computation
}}

ENTRY %main (a: bf16[64,32], b: bf16[32,48], q: bf16[1,50,2,16]) -> (bf16[64,48], f32[1,8,8,6]) {{
  %a = bf16[64,32]{{1,0}} parameter(0), metadata={{op_name="a[{{\\"(x\\"}}]"}}
  %b = bf16[32,48]{{1,0}} parameter(1)
  %q = bf16[1,50,2,16]{{3,2,1,0}} parameter(2)
  %k = bf16[1,40,2,16]{{3,2,1,0}} parameter(3)
  %x = f32[1,8,8,4]{{3,2,1,0}} parameter(4)
  %w = f32[6,3,3,4]{{3,2,1,0}} parameter(5)
  %gemm.1 = (bf16[64,48]{{1,0}}, s8[4194304]{{0}}) custom-call(%a, %b), custom_call_target="__cublas$gemm", \
backend_config={{"gemm_backend_config":{{{GEMM}}}}}
  %matmul.2 = (bf16[64,48]{{1,0}}, /*index=1*/s8[33554432]{{0}}) custom-call(%a, %b), \
custom_call_target="__cublas$lt$matmul", backend_config={{"gemm_backend_config":{{{GEMM},"epilogue":"GELU"}}}}
  %call = bf16[64,48]{{1,0}} call(%a, %b), to_apply=%command_buffer
  %fmha.3 = ({QUERIES}, u8[0]{{0}}) custom-call(%q, %k, %k), custom_call_target="__cudnn$fmhaSoftmax", \
backend_config={{"cudnn_fmha_backend_config":{{{FMHA},"is_flash_attention":true}}}}
  %fmha.4 = ({QUERIES}, {KEYS}, {KEYS}, u8[0]{{0}}) custom-call(%q, %k, %k), \
custom_call_target="__cudnn$fmhaSoftmaxBackward", backend_config={{"cudnn_fmha_backend_config":{{{FMHA}}}}}
  %conv.5 = (f32[1,8,8,6]{{3,2,1,0}}, u8[0]{{0}}) custom-call(%x, %w), {CONVOLUTION}Forward"
  %y = f32[1,8,8,6]{{3,2,1,0}} get-tuple-element(%conv.5), index=0
  %conv.7 = (f32[1,8,8,4]{{3,2,1,0}}, u8[0]{{0}}) custom-call(%y, %w), {CONVOLUTION}BackwardInput"
  %conv.8 = (f32[6,3,3,4]{{3,2,1,0}}, u8[0]{{0}}) custom-call(%x, %y), {CONVOLUTION}BackwardFilter"
  %triton.9 = f32[8]{{0}} custom-call(%x), custom_call_target="__gpu$xla.gpu.triton", backend_config={{name = "k"}}
  %copy-start.1 = (bf16[64,32]{{1,0:T(8,128)(2,1)S(1)}}, bf16[64,32]{{1,0}}, u32[]) copy-start(%a)
  %copy-done.1 = bf16[64,32]{{1,0:T(8,128)(2,1)S(1)}} copy-done(%copy-start.1)
  ROOT %tuple.1 = (bf16[64,48]{{1,0}}, f32[1,8,8,6]{{3,2,1,0}}) tuple(%call, %y)
}}
"""


def test_libraries_of_a_gpu():
    counted = costs.program_costs(ON_A_GPU)
    product, attention = 2 * 64 * 32 * 48, 2 * 2 * 50 * 40 * 16
    assert counted.dot_flops == 3 * product + (2 + 5) * attention
    assert counted.convolution_flops == 3 * 2 * (8 * 8 * 6) * 9 * 4
    assert counted.uncounted == ("__gpu$xla.gpu.triton",)
    assert counted.bytes_accessed > 4194304 + 33554432  # workspaces are results of those calls


def test_what_is_no_program_is_refused():
    with pytest.raises(ValueError, match="ENTRY"):
        costs.program_costs("")
