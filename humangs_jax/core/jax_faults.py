"""Works around faults of published versions of JAX that silently change numbers."""

import os
import sys
import warnings
from importlib.metadata import PackageNotFoundError, version

WRONG_SUMS = "0.10.2"
"""The version of jaxlib that computes wrong sums on CPUs. If there are 32,769 rows or more, the sum
of a vmapped product of a small matrix and a vector is wrong in thousands of them
(https://github.com/jax-ml/jax/issues/39103). 0.10.1, and 0.11.1 and later, compute it right.
"""
RIGHT_SUMS = "--xla_cpu_experimental_ynn_fusion_type=-LIBRARY_FUSION_TYPE_REDUCE"
"""The flag of XLA that avoids the fault, because sums then do not go to the library YNNPACK. It
costs no time.
"""


def avoid_wrong_sums() -> None:
    """Sets the flag that jaxlib 0.10.2 needs to compute right sums on CPUs.

    `import humangs_jax` calls it. XLA reads its flags when the first array is made. If that has
    happened already, a warning says what to do. Nothing is changed for other versions of jaxlib, or
    if the user has set this flag.
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
    """Returns whether JAX has started a backend in this process."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and bool(getattr(bridge, "_backends", {}))
