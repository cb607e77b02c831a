"""Trains `tiny` on made-up captures in a new process, alone or as one of several.

It prints "ready" before the first step.

python training_worker.py OUT CAPTURES --stop-at 4
    [--devices 4] [--coordinator localhost:1234 --processes 2 --process 0]
"""

import argparse
import contextlib
import dataclasses
import logging
from pathlib import Path

import jax


def configuration(checkpoint_every=1, batch_size=4, at_once=1, learning_rate=1e-4):
    """Returns `tiny` without upsampler, with a batch for several devices.

    What stands before a batch norm has only rounding errors as gradient, which Adam makes large.
    """
    from training_cases import without_upsampler

    from humangs_jax.training.config import tiny

    config = tiny()
    return dataclasses.replace(
        config,
        model=without_upsampler(config.model),
        optimizer=dataclasses.replace(config.optimizer, learning_rate=learning_rate),
        batch_size=batch_size,
        microbatch_size=at_once,
        checkpoint_every=checkpoint_every,
        validate_every=2,
        steps=1000,
    )


def main():
    """Trains in this process; prints "ready" before the first step and "done" at the end."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("captures", type=Path)
    parser.add_argument("--stop-at", type=int)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--at-once", type=int, default=1)
    parser.add_argument("--checkpoint-every", type=int, default=1)
    parser.add_argument("--devices", type=int, default=1)
    parser.add_argument("--fsdp", type=int)
    parser.add_argument("--cache", help="folder of compiled programs, to share between processes")
    parser.add_argument("--coordinator")
    parser.add_argument("--processes", type=int)
    parser.add_argument("--process", type=int)
    parser.add_argument("--no-validation", action="store_true")
    arguments = parser.parse_args()
    # before the first import of what uses devices
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_num_cpu_devices", arguments.devices)
    if arguments.cache:
        jax.config.update("jax_compilation_cache_dir", arguments.cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    if arguments.coordinator:
        from humangs_jax.training.sharding import join_processes

        join_processes(arguments.coordinator, arguments.processes, arguments.process)
    from training_cases import tube

    from humangs_jax.data.loading.captures import find_captures
    from humangs_jax.training.loop import TrainingInterrupted, train

    logging.basicConfig(level=logging.WARNING)
    folders = find_captures(arguments.captures)
    print("ready", flush=True)
    with contextlib.suppress(TrainingInterrupted):
        train(
            configuration(arguments.checkpoint_every, arguments.batch, arguments.at_once),
            tube(),
            folders[:2],
            arguments.out,
            validation=() if arguments.no_validation else folders[2:],
            fsdp=arguments.fsdp,
            stop_at=arguments.stop_at,
            progress=False,
        )
    print("done", flush=True)


if __name__ == "__main__":
    main()
