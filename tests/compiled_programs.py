"""Counts the programs that a block of a test compiles."""

import contextlib

import jax

EVENT = "/jax/core/compile/backend_compile_duration"


@contextlib.contextmanager
def compiled_programs():
    """Yields a list to which the name of each program that the block compiles is added.

    A program that an earlier test has compiled for the same kind of arguments is not added.
    """
    names = []

    def note(event, duration_secs, **about):
        if event == EVENT:
            names.append(about.get("fun_name", "?"))

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield names
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
