"""Matrix products state their precision: by default, accelerators round factors to 10 bits."""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import humangs_jax
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.network.reader import photo_colors, sample_shells
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.reference import render_reference

PRODUCTS = ("einsum", "matmul", "dot", "tensordot", "vdot", "inner", "dot_general")
SAYS = {"precision", "preferred_element_type"}
"""Arguments that state it; the second is the network's, whose type its configuration gives."""
PACKAGE = Path(humangs_jax.__file__).parent
VIEWS, POINTS, SIZE = 2, 5, 8


def products_that_say_nothing(file):
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        called = node.func if isinstance(node, ast.Call) else None
        product = isinstance(called, ast.Attribute) and called.attr in PRODUCTS
        of_jax = (
            product and isinstance(called.value, ast.Name) and called.value.id in ("jnp", "lax")
        )
        if of_jax and not SAYS & {keyword.arg for keyword in node.keywords}:
            yield f"{file.relative_to(PACKAGE)}:{node.lineno}"


@pytest.mark.wings
def test_every_product_of_jax_says_how_exact_it_is():
    assert [
        place for file in sorted(PACKAGE.rglob("*.py")) for place in products_that_say_nothing(file)
    ] == []


def camera():
    return Camera(jnp.eye(3), jnp.eye(4), SIZE, SIZE)


def colors():
    images, pixels = jnp.ones((VIEWS, SIZE, SIZE, 3)), jnp.ones((VIEWS, POINTS, 2))
    return lambda seen: photo_colors(images, pixels, seen, "half_pixel"), jnp.ones(
        (VIEWS, POINTS), bool
    )


def shells():
    points, image = jnp.ones((VIEWS, POINTS, 3)), jnp.ones((VIEWS, SIZE, SIZE))
    cameras, present, distances = (
        stack_cameras([camera()] * VIEWS),
        jnp.ones(VIEWS, bool),
        (0.0, 0.1),
    )

    def sample(images):
        found = sample_shells(
            images, image > 0, image, cameras, points, points, distances, present, "half_pixel"
        )
        return found.colors

    return sample, jnp.ones((VIEWS, SIZE, SIZE, 3))


def reference():
    gaussians = Gaussians(
        means=jnp.ones((POINTS, 3)),
        quats=jnp.ones((POINTS, 4)),
        scales=jnp.ones((POINTS, 3)),
        opacities=jnp.ones(POINTS),
        colors=jnp.ones((POINTS, 3)),
        harmonics=jnp.ones((POINTS, 3, 3)),
    )
    return lambda gaussians: render_reference(gaussians, camera()).rgb, gaussians


@pytest.mark.parametrize("program", [colors, shells, reference])
def test_colors_are_summed_exactly(program):
    function, argument = program()
    text = jax.jit(function).lower(argument).as_text()
    found = [line for line in text.splitlines() if "dot_general" in line]
    assert found and all("HIGHEST, HIGHEST" in line for line in found), found
