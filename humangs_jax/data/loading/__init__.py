"""The loader: which views of whom come when is a pure function of (seed, step); a run that resumes sees the same batches.

A `Source` has examples by number: `CaptureSource` (people on disk: capture folders, written synthetic sets, data sets),
`GeneratedSource` (people made on the fly from keys) and `Mixture` (several of these by weight). `Loader` makes batches of one:
each process the rows of its devices, some batches ahead.
"""

from humangs_jax.data.loading.batches import Loader, Waiting
from humangs_jax.data.loading.captures import CaptureCache, CaptureSource, PeopleCache, find_captures
from humangs_jax.data.loading.examples import (
    Example,
    Mixture,
    Source,
    StoredSubject,
    ViewSampling,
    draw_views,
    nearest_view,
    shrink,
    subject_order,
    subject_views,
)

__all__ = [
    "CaptureCache",
    "CaptureSource",
    "Example",
    "Loader",
    "Mixture",
    "PeopleCache",
    "Source",
    "StoredSubject",
    "ViewSampling",
    "Waiting",
    "draw_views",
    "find_captures",
    "nearest_view",
    "shrink",
    "subject_order",
    "subject_views",
]
