"""Several processes that train together, each with its own devices: jax's distributed runtime, nothing else."""

import jax


def join_processes(
    coordinator: str | None = None, process_count: int | None = None, process_index: int | None = None
) -> None:
    """Become one of several processes; call it before anything else asks for devices.

    Arguments: coordinator "host:port" of process 0, how many processes, which of them this is. All None: as the cluster
    tells (SLURM, Open MPI, Kubernetes and TPU pods do, see `jax.distributed.initialize`).
    Raises: ValueError unless all or none are given, or where no cluster is recognised.
    """
    given = (coordinator, process_count, process_index)
    if None in given and any(value is not None for value in given):
        raise ValueError("several processes: give coordinator, number of processes and process index, or none of them")
    jax.config.update("jax_cpu_collectives_implementation", "gloo")  # CPUs have no others; no matter elsewhere
    jax.distributed.initialize(coordinator, process_count, process_index)
