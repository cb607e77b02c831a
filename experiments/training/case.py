"""What a step of training is timed on: settings, a person that the loader reads, random weights; and the step's program."""

import time
from pathlib import Path
from typing import Any

CASES = {
    "small 256": ("small", 256, 4, 2),
    "published 256": ("published", 256, 4, 4),
    "published 512": ("published", 512, 4, 4),
    "tiny 32": ("tiny", 32, 2, 2),
}
"""Preset, size of photographs and targets, input views, targets. The last one is for tests."""


class Case:
    """Everything that a step of one configuration needs; `state` is what the last step gave."""

    def __init__(self, preset: str, size: int, views: int, targets: int, dtype: str, batch: int = 1):
        import jax

        from experiments.training.cases import random_networks, settings, with_model
        from humangs_jax.body.library import load_body

        if dtype == "auto":
            dtype = "float32" if jax.default_backend() == "cpu" else "bfloat16"
        self.config = with_model(settings(preset, size, views, targets, batch), dtype=dtype)
        self.program: Any = None
        self.full_body = load_body()
        self.networks = random_networks(self.config)

    def prepare(self, folder: Path) -> "Case":
        """Makes the person, reads the batch, draws the weights."""
        import jax

        from experiments.training.cases import written_subject
        from humangs_jax.data.loader import Loader
        from humangs_jax.data.views import gaussian_body

        config = self.config
        self.capture = written_subject(folder, config, self.full_body)
        self.loader = Loader(self.source(), config.batch_size, reader="plain")
        self.body = gaussian_body(self.full_body, config.model)
        self.batch = jax.block_until_ready(self.loader.batch_at(0))
        self.fit()
        self.state = fresh_state(config)
        return self

    def source(self) -> Any:
        """Examples of the person; nothing is read yet."""
        from humangs_jax.data.loader import CaptureCache, CaptureSource

        cache = CaptureCache([self.capture], self.full_body)
        return CaptureSource(cache, self.config.views, self.config.model.image_size, self.config.target_size)

    def fit(self) -> None:
        """Room for the foreground tokens of this person, as a run would have."""
        import jax

        from experiments.training.cases import with_model
        from humangs_jax.data.views import prepare_inputs

        if self.config.model.tokens == "foreground":
            from experiments.reconstruction.cases import foreground

            inputs = jax.jit(prepare_inputs, static_argnames="config")(
                self.body, first(self.batch).inputs, self.config.model
            )
            self.config = with_model(
                self.config, token_capacity=foreground(inputs, self.config.model)[0].token_capacity
            )

    def compiled(self, options: dict[str, Any] | None) -> tuple[Any, float]:
        """(the step as a program, CPU seconds that it took to trace and compile)."""
        import jax

        from humangs_jax.training.step import jitted_train_step

        step = jax.jit(
            jitted_train_step().__wrapped__,
            static_argnames=("config", "mesh"),
            donate_argnames="state",
            compiler_options=options,
        )
        start = time.process_time()
        arguments = self.state, self.batch, self.body, self.networks
        program = step.lower(*arguments, config=self.config, mesh=None).compile()
        return program, time.process_time() - start

    def run(self, program: Any) -> None:
        """One step."""
        import jax

        self.state, metrics = program(self.state, self.batch, self.body, self.networks)
        self.metrics = {name: float(value) for name, value in jax.device_get(metrics).items()}


def fresh_state(config: Any) -> Any:
    """A training state of random weights."""
    from experiments.reconstruction.cases import random_variables
    from humangs_jax.training.state import init_state

    return init_state(config, random_variables(config.model))


def first(batch: Any) -> Any:
    """Its first subject."""
    import jax

    return jax.tree.map(lambda x: x[0], batch)


def compiler_options() -> dict[str, Any] | None:
    """Those of a training step here."""
    import jax

    from humangs_jax.rendering.splatting import CPU_COMPILER_OPTIONS

    return CPU_COMPILER_OPTIONS if jax.default_backend() == "cpu" else None
