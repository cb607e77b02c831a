"""Loops over what does not depend on each other: the photos, targets and images of one subject.

A CPU runs them one after the other: memory for one, and loops of tiles and faces that end when
their own image is done. An accelerator would then wait for thousands of small operations, so it
runs them side by side.
"""

from collections.abc import Callable
from typing import TypeVar

import jax

from humangs_jax.core.array_types import PyTree

T = TypeVar("T", bound=PyTree)
PIXELS_AT_ONCE = 1 << 22
"""Pixels of the images that an accelerator works on side by side for one subject: sixteen of 512 x
512, so that four photos or targets of the published size are worked on together. More go in parts.
"""


def one_after_the_other() -> bool:
    """Says whether loops are faster than `vmap` on the default backend, which is so on a CPU."""
    return jax.default_backend() == "cpu"


def over(function: Callable[[PyTree], T], xs: PyTree, pixels: int = 1) -> T:
    """Calls `function` for each element along the first axis of `xs`; results are stacked, as
    `jax.lax.map` does.

    Args:
        function: a pure function of one element.
        xs: arrays with one leading axis.
        pixels: pixels of an element's image. No more than `PIXELS_AT_ONCE` are worked on side by
            side.
    """
    if one_after_the_other():
        return jax.lax.map(function, xs)
    count = len(jax.tree.leaves(xs)[0])
    most = max(1, PIXELS_AT_ONCE // pixels)
    # equal parts: a last one of another size would be a program of its own
    size = max((n for n in range(1, count + 1) if count % n == 0 and n <= most), default=1)
    if size == count:
        return jax.vmap(function)(xs)
    return jax.lax.map(function, xs, batch_size=size)
