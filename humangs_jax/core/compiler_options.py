"""How XLA compiles for a CPU, where its defaults are not the best. Options do not reach a `jax.jit` inside another."""

from typing import Any

import jax

CPU_COMPILER_OPTIONS = {
    "xla_cpu_prefer_vector_width": 512,
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner,cse_barrier_expander,small-while-loop-hoisting",
}
"""`jax.jit(..., compiler_options=compiler_options())` of a program that draws on a CPU: wide vectors make the loops over
pixels up to a third faster where there is AVX-512; XLA no longer divides its small kernels, tens of microseconds each,
among several threads, which took twice the CPU time and gained nothing; and it keeps barriers, so that tables are stored
before they are gathered from (the loops of tiny images must then not become single kernels, which know no barriers).
Eager calls use it; your own jitted functions need it themselves. Works from jax 0.10 to 0.12."""


def compiler_options() -> dict[str, Any] | None:
    """`CPU_COMPILER_OPTIONS` if the default backend is the CPU, else None. Call it late: asking for the backend starts it."""
    return CPU_COMPILER_OPTIONS if jax.default_backend() == "cpu" else None
