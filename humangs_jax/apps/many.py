"""Avatars of many captures, in batches of one program. A capture that cannot be used does not stop the others."""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct, reconstruct_batch
from humangs_jax.core.array_types import PyTree
from humangs_jax.data.capture import Capture
from humangs_jax.network.config import HumanGSConfig

BATCH = 8
"""Beyond it memory grows, and little else."""


class Reconstructed(NamedTuple):
    """A capture by name with its avatar, or with what is wrong with it."""

    name: str
    capture: Capture | None
    avatar: Avatar | None
    error: Exception | None = None


def reconstruct_many(
    variables: PyTree, config: HumanGSConfig, captures: Mapping[str, Callable[[], Capture]], batch: int | None = None
) -> Iterator[Reconstructed]:
    """Yields the avatar of each capture, in their order; `batch` captures at a time are read and reconstructed by one `vmap`.

    Arguments: captures: functions that load one each, by its name; ValueError and OSError that they raise are yielded.
    batch: None for `BATCH`.
    """
    names, batch = list(captures), batch or BATCH
    for start in range(0, len(names), batch):
        done = [_loaded(name, captures[name]) for name in names[start : start + batch]]
        good = [each.capture for each in done if each.capture is not None]
        avatars: list[Avatar | Exception] = []
        if len(good) > 1:
            try:
                avatars = list(reconstruct_batch(variables, config, good))
            except ValueError:  # of one of them: which one is found below
                avatars = []
        avatars = avatars or [_alone(variables, config, capture) for capture in good]
        following = iter(avatars)
        for each in done:
            if each.capture is None:
                yield each
            elif isinstance(result := next(following), Avatar):
                yield each._replace(avatar=result)
            else:
                yield each._replace(error=result)


def _loaded(name: str, load: Callable[[], Capture]) -> Reconstructed:
    try:
        return Reconstructed(name, load(), None)
    except (ValueError, OSError) as error:
        return Reconstructed(name, None, None, error)


def _alone(variables: PyTree, config: HumanGSConfig, capture: Capture) -> Avatar | Exception:
    try:
        return reconstruct(variables, config, capture)
    except ValueError as error:
        return error
