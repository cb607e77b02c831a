"""Runs a function for things that do not depend on each other: the photos, targets and images of
one subject.

A CPU runs them one after the other. It then needs memory for one at a time, and the loops over
tiles and faces of an image end when this image is done. An accelerator runs them side by side.
Otherwise it would wait for thousands of small operations, one after the other.
"""

from collections.abc import Callable
from typing import TypeVar

import jax

from humangs_jax.core.array_types import PyTree

T = TypeVar("T", bound=PyTree)
PIXELS_AT_ONCE = 1 << 22
"""Largest number of pixels that an accelerator works on side by side for one subject. Sixteen
images of 512 x 512 have this number. Images that have more pixels together are worked on in several
parts.
"""


def one_after_the_other() -> bool:
    """Says whether loops are faster than `vmap` on the default backend. They are on a CPU."""
    return jax.default_backend() == "cpu"


def over(function: Callable[[PyTree], T], xs: PyTree, pixels: int = 1) -> T:
    """Calls `function` for each element along the first axis of `xs`, and returns the stacked
    results as `jax.lax.map` does.

    Args:
        function: a pure function of one element.
        xs: arrays with one leading axis.
        pixels: number of pixels in an element's image. An accelerator works on several elements
            side by side, as long as they have at most `PIXELS_AT_ONCE` pixels together, and at
            least on one. All parts have the same number of elements.
    """
    if one_after_the_other():
        return jax.lax.map(function, xs)
    count = len(jax.tree.leaves(xs)[0])
    most = max(1, PIXELS_AT_ONCE // pixels)
    # equal parts: a last one of another size would need another program
    size = max((n for n in range(1, count + 1) if count % n == 0 and n <= most), default=1)
    if size == count:
        return jax.vmap(function)(xs)
    return jax.lax.map(function, xs, batch_size=size)
