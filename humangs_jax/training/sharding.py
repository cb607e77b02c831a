"""Divides a run among many devices: each batch among all devices, and the state among the devices
along one axis of the mesh.

The mesh has the axes "data" and "fsdp". Data parallelism uses both. Parameters, moments and
averages are divided along "fsdp" and equal along "data". A step gathers the parameters once, works
on its subjects, and sends every device the mean of its part of the gradient. This is ZeRO stage 3
(Rajbhandari et al., 2020, https://arxiv.org/abs/1910.02054), but with one gathering per step,
because the network is small compared to what it computes.
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
"""Number of elements of the smallest array that is divided. Every device keeps a copy of smaller
arrays, because messages would cost more than the memory is worth.
"""

T = TypeVar("T")


def training_mesh(fsdp: int | None = None, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """Returns a mesh of all devices (of all processes) with the axes `AXES`. fsdp: number of
    devices that share one copy of the state; None: all. devices: None for `jax.devices()`.

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
    """Returns the axis along which an array of the state is divided: the longest one that `parts`
    divides. None if the array is not divided.
    """
    if np.prod(shape) < SMALLEST_DIVIDED or parts == 1:
        return None
    axes = [axis for axis, length in enumerate(shape) if length % parts == 0]
    return max(axes, key=lambda axis: shape[axis], default=None)


def partition(tree: PyTree, mesh: Mesh) -> PyTree:
    """Returns the PartitionSpec of every leaf of parameters, or of another tree with their
    shapes.
    """

    def spec(leaf):
        axis = divided_axis(leaf.shape, mesh.shape["fsdp"])
        if axis is None:
            return PartitionSpec()
        return PartitionSpec(*[None] * axis, "fsdp")

    return jax.tree.map(spec, tree)


def state_shardings(state: TrainState, mesh: Mesh) -> TrainState:
    """Returns the NamedSharding of every leaf of a state. Batch statistics are not divided."""

    def named(spec):
        return NamedSharding(mesh, spec)

    divided = replace(state, batch_stats={})
    shardings = jax.tree.map(named, partition(divided, mesh))
    return replace(
        shardings, batch_stats=jax.tree.map(lambda _: named(PartitionSpec()), state.batch_stats)
    )


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Returns the sharding of a batch, whose first axis is divided among all devices."""
    return NamedSharding(mesh, PartitionSpec(AXES))


def replicated(mesh: Mesh) -> NamedSharding:
    """Returns the sharding of arrays that every device has as a whole."""
    return NamedSharding(mesh, PartitionSpec())


def place(tree: T, shardings: PyTree) -> T:
    """Returns global arrays made from host or local arrays, which have to be equal in all
    processes. shardings: a tree of shardings, or one for all leaves.
    """
    if isinstance(shardings, NamedSharding):
        shardings = jax.tree.map(lambda _: shardings, tree)

    def put(leaf, sharding):
        host = np.asarray(leaf)
        return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])

    return jax.tree.map(put, tree, shardings)


def whole(tree: T, mesh: Mesh) -> T:
    """Returns whole arrays on this process's default device, made from arrays that are divided
    among devices.

    All processes must call this function.
    """
    return jax.tree.map(lambda x: x.addressable_data(0), _replicate(mesh)(tree))


@functools.cache
def _replicate(mesh: Mesh) -> Callable[[PyTree], PyTree]:
    return jax.jit(lambda tree: tree, out_shardings=replicated(mesh))


def gather(params: PyTree, specs: PyTree) -> PyTree:
    """Returns whole parameters, gathered from the parts on the devices. Only for use inside
    `shard_map`. specs: PartitionSpec of every leaf.
    """

    def one(part, spec):
        if len(spec):
            return jax.lax.all_gather(part, "fsdp", axis=len(spec) - 1, tiled=True)
        return part

    return jax.tree.map(one, params, specs)


def mean_parts(gradients: PyTree, specs: PyTree, mesh: Mesh) -> PyTree:
    """Averages whole gradients over all devices, and returns this device's part of the mean. Only
    for use inside `shard_map`. specs: PartitionSpec of every leaf.
    """

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
    """Makes this process one of several. Call it before anything else asks for devices.

    If all arguments are None, the cluster gives them (SLURM, Open MPI, Kubernetes and TPU pods do,
    see `jax.distributed.initialize`).

    Arguments:
        coordinator: "host:port" of process 0.
        process_count: number of processes.
        process_index: index of this process.
    Raises: ValueError if some arguments are None and others are not, if no cluster is recognised,
    or if `process_index` is not below `process_count`; RuntimeError if JAX has started already.
    """
    given = (coordinator, process_count, process_index)
    if None in given and any(value is not None for value in given):
        raise ValueError(
            "several processes: give coordinator, number of processes and process index, or none of"
            " them"
        )
    # CPUs have no others; no matter elsewhere
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(coordinator, process_count, process_index)
