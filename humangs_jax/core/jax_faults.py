"""Faults of published versions of JAX that change numbers in silence, and how a process avoids
them.
"""

import os
import sys
import warnings
from importlib.metadata import PackageNotFoundError, version

WRONG_SUMS = "0.10.2"
"""The version of jaxlib that computes wrong sums on CPUs. A vmapped product of a small matrix and a
vector, then summed, is wrong in thousands of rows from 32,769 rows on
(https://github.com/jax-ml/jax/issues/39103). 0.10.1 and 0.11.1 and later compute it right."""
RIGHT_SUMS = "--xla_cpu_experimental_ynn_fusion_type=-LIBRARY_FUSION_TYPE_REDUCE"
"""The flag of XLA that cures it: sums are not given to the library YNNPACK. It costs no time."""


def avoid_wrong_sums() -> None:
    """Set the flag that jaxlib 0.10.2 needs to compute right sums on CPUs.

    `import humangs_jax` calls it. XLA reads its flags when the first array is made: if that has
    happened, a warning says what to do. Other versions of jaxlib, and a flag of the user for the
    same option, are left alone.
    """
    try:
        installed = version("jaxlib")
    except PackageNotFoundError:
        return
    flags = os.environ.get("XLA_FLAGS", "")
    if installed != WRONG_SUMS or "xla_cpu_experimental_ynn_fusion_type" in flags:
        return
    os.environ["XLA_FLAGS"] = f"{flags} {RIGHT_SUMS}".strip()
    if _has_started():
        warnings.warn(
            f"jaxlib {WRONG_SUMS} computes wrong sums on CPUs, and it has read its flags already: "
            "import humangs_jax before the first array is made, or use Python 3.12 with jax 0.11.2 "
            "or newer",
            RuntimeWarning,
            stacklevel=3,
        )


def _has_started() -> bool:
    """Says whether JAX has started a backend in this process."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and bool(getattr(bridge, "_backends", {}))
