"""Everything that a run carries from step to step, and the optimizer whose state is part of it.

Random numbers are not carried, because they follow from the seed and the step. By default the
optimizer is the published one: AdamW, warm-up and cosine, clipped gradients, and a guard against
bad steps. First a gradient is made finite entry by entry (NaN becomes 0, infinities +-1e-6). If
then its norm exceeds `skip_norm`, or the loss is not finite, the step is skipped. A skipped step
changes neither parameters nor batch statistics, moments or the schedule. Two numbers of steps are
kept: those that were skipped, and those whose loss or gradient was not finite.
"""

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from humangs_jax.core.array_types import Array, Float, Int, PyTree, Scalar
from humangs_jax.core.loops import one_after_the_other
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.parts import Variables
from humangs_jax.training.config import OptimizerConfig, TrainConfig

INFINITY_STAND_IN = 1e-6


@pytree_dataclass
class TrainState:
    """The arrays that a step of training changes."""

    step: Int[Array, ""]
    """Number of steps done, skipped ones included."""
    params: PyTree
    """The parameters of the network (`init_humangs`)."""
    batch_stats: PyTree
    """The batch statistics of the network."""
    opt_state: PyTree
    """The state of `make_optimizer`."""
    ema_params: PyTree | None
    """The running average of `params`; None if there is no average."""

    @property
    def variables(self) -> Variables:
        """Returns the network's variables to use, with the averaged parameters if there are any."""
        params = self.params if self.ema_params is None else self.ema_params
        return {"params": params, "batch_stats": self.batch_stats}


def init_state(config: TrainConfig, variables: Variables | None = None) -> TrainState:
    """Returns the state before the first step, with the given variables or fresh ones of
    `config.seed`.
    """
    if variables is None:
        variables = init_humangs(jax.random.key(config.seed), config.model)
    # copies: the training step gives its state's buffers away, so neither the caller nor two fields
    # may share one
    own = jax.tree.map(lambda x: jnp.array(x, jnp.float32), dict(variables))
    params, batch_stats = own["params"], own["batch_stats"]
    opt_state = make_optimizer(config.optimizer, config.steps).init(params)
    average = None
    if config.ema_decay is not None:
        average = jax.tree.map(jnp.copy, params)
    return TrainState(jnp.zeros((), jnp.int32), params, batch_stats, opt_state, average)


class GuardState(NamedTuple):
    """The state of `guard`."""

    skipped: Int[Array, ""]
    """Number of steps skipped so far."""
    nonfinite: Int[Array, ""]
    """Number of steps so far whose loss or gradient was not finite, skipped or not."""
    norm: Float[Array, ""]
    """Norm of the last gradient, after it was made finite and before it is clipped."""
    inner: PyTree
    """The state of the guarded optimizer."""


def learning_rate(config: OptimizerConfig, steps: int) -> optax.Schedule:
    """Returns the schedule of a run of `steps` steps: step number -> learning rate."""
    warmup = min(config.warmup_steps, steps)
    return optax.warmup_cosine_decay_schedule(
        0.0, config.learning_rate, warmup, max(steps, warmup + 1)
    )


def decayed(params: PyTree) -> PyTree:
    """Returns a tree of bools, True for each parameter that weight decay acts on."""
    return jax.tree.map(lambda x: x.ndim >= 2, params)


def finite_gradients(gradients: PyTree) -> PyTree:
    """Returns gradients whose NaN entries are replaced by 0, and infinite ones by +-1e-6."""
    stand_in = INFINITY_STAND_IN
    return jax.tree.map(
        lambda x: jnp.nan_to_num(x, nan=0.0, posinf=stand_in, neginf=-stand_in), gradients
    )


def gradient_norm(gradients: PyTree) -> Scalar:
    """Returns the Euclidean norm over all entries of all leaves."""
    return jnp.sqrt(sum(jnp.sum(jnp.square(x)) for x in jax.tree.leaves(gradients)))


def guard(
    inner: optax.GradientTransformation, skip_norm: float
) -> optax.GradientTransformationExtraArgs:
    """Returns an optimizer that makes gradients finite, then applies `inner`. A step is skipped if
    the norm exceeds `skip_norm` or the loss is not finite.

    The loss is the extra argument `value` of `update`.
    """

    def init(params):
        # two arrays: a state that is donated may not hold one buffer twice
        counts = jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)
        return GuardState(*counts, jnp.zeros(()), inner.init(params))

    def update(gradients: PyTree, state: GuardState, params: PyTree, *, value: Scalar, **_):
        finite = jnp.all(
            jnp.stack([jnp.all(jnp.isfinite(x)) for x in (value, *jax.tree.leaves(gradients))])
        )
        gradients = finite_gradients(gradients)
        norm = gradient_norm(gradients)
        good = jnp.isfinite(value) & (norm <= skip_norm)
        updates, advanced = inner.update(gradients, state.inner, params)

        def keep(new, old):
            return jnp.where(good, new, old)

        updates = jax.tree.map(lambda x: keep(x, jnp.zeros_like(x)), updates)
        advanced = jax.tree.map(keep, advanced, state.inner)
        return updates, GuardState(state.skipped + ~good, state.nonfinite + ~finite, norm, advanced)

    # optax types the constructor's second argument as that of its base class, which knows no extra
    # arguments
    return optax.GradientTransformationExtraArgs(init, update)  # ty: ignore[invalid-argument-type]


def make_optimizer(
    config: OptimizerConfig, steps: int, divided: bool = False
) -> optax.GradientTransformationExtraArgs:
    """Returns the optimizer of a run of `steps` steps. Its state is a `GuardState`.

    divided: whether arrays of the state are divided among devices.
    """
    named = getattr(optax, config.name)
    inner = named(
        learning_rate(config, steps), *config.betas, weight_decay=config.weight_decay, mask=decayed
    )
    whole = guard(optax.chain(optax.clip_by_global_norm(config.clip_norm), inner), config.skip_norm)
    # a CPU takes three times as long on long arrays, LAMB has a norm for each array, and arrays
    # that are divided along different axes cannot be joined
    if one_after_the_other() or config.name == "lamb" or divided:
        return whole
    return on_joined(whole)


# An accelerator works on seventy small arrays for as long as it takes to begin with each. Rules
# that treat every entry alike can have all entries in one place.


class Joined(NamedTuple):
    """The entries of all arrays of a tree, as two arrays."""

    decayed: Float[Array, "n 1"]
    """Entries of the arrays that weight decay acts on, (n, 1). The column has two axes, so weight
    decay acts on it, too.
    """
    others: Float[Array, " m"]
    """Entries of all other arrays, (m,)."""


def join(tree: PyTree) -> Joined:
    """Returns the entries of all arrays of a tree, joined in the order of the arrays."""
    leaves = jax.tree.leaves(tree)

    def entries(wanted: bool) -> Array:
        chosen = [x.reshape(-1) for x in leaves if decayed(x) == wanted]
        return jnp.concatenate([*chosen, jnp.zeros(0, jnp.float32)])

    return Joined(entries(True)[:, None], entries(False))


def part(joined: Joined, like: PyTree) -> PyTree:
    """Returns the tree of arrays that `join` joined. like: a tree with their shapes and types."""
    leaves, structure = jax.tree.flatten(like)
    begins = {True: 0, False: 0}
    entries = {True: joined.decayed[:, 0], False: joined.others}
    parts = []
    for leaf in leaves:
        kind, begin = decayed(leaf), begins[decayed(leaf)]
        begins[kind] = begin + leaf.size
        own = jax.lax.slice_in_dim(entries[kind], begin, begin + leaf.size)
        parts.append(own.reshape(leaf.shape).astype(leaf.dtype))
    return jax.tree.unflatten(structure, parts)


def on_joined(
    inner: optax.GradientTransformationExtraArgs,
) -> optax.GradientTransformationExtraArgs:
    """Returns an optimizer that applies `inner` to the joined entries of parameters and gradients.

    Its state has the same arrays as the state of `inner` for arrays that are not joined. So a run
    can continue on devices on which nothing is joined.
    """

    def update(gradients: PyTree, state: PyTree, params: PyTree, **extra: Any):
        structure = jax.tree.structure(params)

        def of_params(x: PyTree) -> bool:
            return jax.tree.structure(x) == structure

        def joined_state(x: PyTree) -> PyTree:
            return join(x) if of_params(x) else x

        def parted_state(x: PyTree) -> PyTree:
            return part(x, params) if isinstance(x, Joined) else x

        joined = jax.tree.map(joined_state, state, is_leaf=of_params)
        updates, joined = inner.update(join(gradients), joined, join(params), **extra)
        parted = jax.tree.map(parted_state, joined, is_leaf=lambda x: isinstance(x, Joined))
        return part(cast(Joined, updates), params), parted

    return optax.GradientTransformationExtraArgs(inner.init, update)  # ty: ignore[invalid-argument-type]
