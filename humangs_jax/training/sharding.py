"""How a run is divided among many devices: batches among all of them, the state among those along
one axis of the mesh.

Data parallelism over both axes of the mesh ("data", "fsdp"); parameters, moments and averages are
divided along "fsdp" and equal along "data". A step gathers the parameters once, works on its
subjects, and sends every device the sum of its part of the gradient (ZeRO stage 3, Rajbhandari
et al., 2020, https://arxiv.org/abs/1910.02054, with one gathering a step: the network is small
beside what it computes).
"""

import functools
from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from humangs_jax.core.array_types import PyTree
from humangs_jax.core.pytree import replace
from humangs_jax.training.state import TrainState

AXES = ("data", "fsdp")
SMALLEST_DIVIDED = 1 << 10
"""Elements of the smallest array that is worth dividing: below, the messages cost more than the
memory.
"""

T = TypeVar("T")


def training_mesh(fsdp: int | None = None, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """All devices (of all processes) as a mesh of `AXES`. fsdp: devices that share one copy of the
    state; None: all.

    Raises: ValueError if fsdp does not divide the number of devices.
    """
    devices = jax.devices() if devices is None else list(devices)
    if fsdp is None:
        fsdp = len(devices)
    if fsdp < 1 or len(devices) % fsdp:
        raise ValueError(f"fsdp {fsdp} does not divide {len(devices)} devices")
    # automatic axes: with explicit ones, the default of newer jax, every gather of a divided array
    # is an error
    return Mesh(np.asarray(devices).reshape(-1, fsdp), AXES, axis_types=(AxisType.Auto,) * 2)


def divided_axis(shape: tuple[int, ...], parts: int) -> int | None:
    """The axis of an array of the state along which it is divided: the longest that can be; None
    for none.
    """
    if np.prod(shape) < SMALLEST_DIVIDED or parts == 1:
        return None
    axes = [axis for axis, length in enumerate(shape) if length % parts == 0]
    return max(axes, key=lambda axis: shape[axis], default=None)


def partition(tree: PyTree, mesh: Mesh) -> PyTree:
    """PartitionSpec of every leaf of parameters, or of what has their shapes."""

    def spec(leaf):
        axis = divided_axis(leaf.shape, mesh.shape["fsdp"])
        if axis is None:
            return PartitionSpec()
        return PartitionSpec(*[None] * axis, "fsdp")

    return jax.tree.map(spec, tree)


def state_shardings(state: TrainState, mesh: Mesh) -> TrainState:
    """NamedSharding of every leaf of a state; batch statistics are whole everywhere."""

    def named(spec):
        return NamedSharding(mesh, spec)

    divided = replace(state, batch_stats={})
    shardings = jax.tree.map(named, partition(divided, mesh))
    return replace(
        shardings, batch_stats=jax.tree.map(lambda _: named(PartitionSpec()), state.batch_stats)
    )


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Sharding of a batch: its first axis is divided among all devices."""
    return NamedSharding(mesh, PartitionSpec(AXES))


def replicated(mesh: Mesh) -> NamedSharding:
    """Sharding of arrays of which every device has a copy."""
    return NamedSharding(mesh, PartitionSpec())


def place(tree: T, shardings: PyTree) -> T:
    """Equal host or local arrays of every process as global ones; `shardings`: a tree of them, or
    one for all leaves.
    """
    if isinstance(shardings, NamedSharding):
        shardings = jax.tree.map(lambda _: shardings, tree)

    def put(leaf, sharding):
        host = np.asarray(leaf)
        return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])

    return jax.tree.map(put, tree, shardings)


def whole(tree: T, mesh: Mesh) -> T:
    """Arrays of this process's default device equal to those that are divided among devices.

    All processes must call it.
    """
    return jax.tree.map(lambda x: x.addressable_data(0), _replicate(mesh)(tree))


@functools.cache
def _replicate(mesh: Mesh) -> Callable[[PyTree], PyTree]:
    return jax.jit(lambda tree: tree, out_shardings=replicated(mesh))


def gather(params: PyTree, specs: PyTree) -> PyTree:
    """Inside `shard_map`: whole parameters from this device's parts."""

    def one(part, spec):
        if len(spec):
            return jax.lax.all_gather(part, "fsdp", axis=len(spec) - 1, tiled=True)
        return part

    return jax.tree.map(one, params, specs)


def mean_parts(gradients: PyTree, specs: PyTree, mesh: Mesh) -> PyTree:
    """Inside `shard_map`: this device's parts of the mean over all devices of whole gradients."""

    def one(gradient, spec):
        if len(spec):
            part = jax.lax.psum_scatter(
                gradient, "fsdp", scatter_dimension=len(spec) - 1, tiled=True
            )
            return jax.lax.psum(part, "data") / mesh.size
        return jax.lax.pmean(gradient, AXES)

    return jax.tree.map(one, gradients, specs)


def join_processes(
    coordinator: str | None = None,
    process_count: int | None = None,
    process_index: int | None = None,
) -> None:
    """Become one of several processes; call it before anything else asks for devices.

    Arguments: coordinator "host:port" of process 0, how many processes, which of them this is. All
    None: as the cluster tells (SLURM, Open MPI, Kubernetes and TPU pods do, see
    `jax.distributed.initialize`).
    Raises: ValueError unless all or none are given, or where no cluster is recognised.
    """
    given = (coordinator, process_count, process_index)
    if None in given and any(value is not None for value in given):
        raise ValueError(
            "several processes: give coordinator, number of processes and process index, or none of"
            " them"
        )
    jax.config.update(
        "jax_cpu_collectives_implementation", "gloo"
    )  # CPUs have no others; no matter elsewhere
    jax.distributed.initialize(coordinator, process_count, process_index)
