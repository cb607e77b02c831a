"""All that a run carries from step to step. Random numbers are not in it: they follow from the seed and the step."""

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Int, PyTree
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.parts import Variables
from humangs_jax.training.config import TrainConfig
from humangs_jax.training.optimizer import make_optimizer


@pytree_dataclass
class TrainState:
    """step: steps done, skipped ones included. params, batch_stats: of the network (`init_humangs`).

    opt_state: of `make_optimizer`. ema_params: running average of params, or None.
    """

    step: Int[Array, ""]
    params: PyTree
    batch_stats: PyTree
    opt_state: PyTree
    ema_params: PyTree | None

    @property
    def variables(self) -> Variables:
        """The network's variables to use: averaged parameters where there are any."""
        params = self.params if self.ema_params is None else self.ema_params
        return {"params": params, "batch_stats": self.batch_stats}


def init_state(config: TrainConfig, variables: Variables | None = None) -> TrainState:
    """The state before the first step, from fresh variables of `config.seed` or from given ones."""
    if variables is None:
        variables = init_humangs(jax.random.key(config.seed), config.model)
    # copies: the training step gives its state's buffers away, so neither the caller nor two fields may share one
    params, batch_stats = (
        jax.tree.map(lambda x: jnp.array(x, jnp.float32), variables[name]) for name in ("params", "batch_stats")
    )
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        batch_stats=batch_stats,
        opt_state=make_optimizer(config.optimizer, config.steps).init(params),
        ema_params=None if config.ema_decay is None else jax.tree.map(jnp.copy, params),
    )
