"""What every source of examples looks like to the loader."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from humangs_jax.data.loading.examples import Example


@runtime_checkable
class Source(Protocol):
    """Examples by number. Capture folders, written sets, people made on the fly and mixtures of these are such.

    `example` is a pure function of its arguments and of the files behind the source: the same on every host, in every thread,
    whatever was asked for before. Its leaves are numpy arrays, or arrays on a device where they were made there.
    """

    @property
    def input_counts(self) -> tuple[int, ...]:
        """Numbers of input views that a step may draw."""
        ...

    @property
    def broken(self) -> Mapping[str, str]:
        """What is left out so far: name -> what is wrong with it."""
        ...

    def __len__(self) -> int:
        """Examples in one pass (subjects)."""
        ...

    def example(self, seed: int, index: int, input_count: int) -> Example:
        """The index-th example that a run of this seed takes from this source, with so many input views.

        Raises: ValueError if nothing of the source can be used.
        """
        ...
