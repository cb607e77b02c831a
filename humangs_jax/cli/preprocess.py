"""`humangs preprocess`: raw data sets to the scene-list layout of the published network, or to capture folders."""

import dataclasses
import os
import re
from pathlib import Path
from typing import Literal

from tyro.conf import OmitArgPrefixes, Positional

from humangs_jax.cli.options import UsageError, require_at_least, require_folder
from humangs_jax.cli.screen import stage, suggest, wrote


@dataclasses.dataclass(frozen=True)
class ScanViews:
    """Photos that are rendered of scans (thuman)."""

    views: int = 60
    """Photos of each scan, from random azimuths and elevations of -5 to 15 degrees."""
    near: bool = False
    """All cameras at 2.0 bounding radii: the published "near" test set. Short for --factors 2 2."""
    factors: tuple[float, float] = (1.0, 1.75)
    """Camera distance in bounding radii, uniform between the two."""
    supersample: int = 3
    """Samples along each pixel's side."""
    train: int = 2300
    """Scans of the training list, the first of the published shuffle."""
    test: int = 145
    """Scans of the test list, the next of the shuffle."""


@dataclasses.dataclass(frozen=True)
class Preprocess:
    """Turn a data set into photos with cameras and bodies, by the published protocol. Can be interrupted and resumed.

    Layouts of data sets, licences, and lines for SLURM: docs/datasets.md.
    """

    kind: Positional[Literal["thuman", "thuman4", "avatarrex"]]
    """THuman2.0 and 2.1, THuman4.0, or AvatarReX."""
    source: Positional[Path]
    """The data set; of thuman the folder that holds model/ and smplx/, of videos a subject or the folder of several."""
    scans: OmitArgPrefixes[ScanViews]
    out: Path
    """The folder to write: one folder for each scan or subject, lists, and manifest.json."""
    body: Path
    """The model of the fits: SMPLX_NEUTRAL.npz or, for scans of THuman2.0, SMPLX_MALE.npz."""
    size: int = 512
    """Side of the photos in pixels."""
    every: int = 10
    """Frame step of videos: 10 takes frames 0, 10, 20 and so on."""
    layout: Literal["scenes", "capture"] = "scenes"
    """The published scene lists, or capture folders."""
    shard: str = "0/1"
    """I/N: the I-th of N parts, counted from 0, for job arrays."""
    workers: int | None = None
    """Processes, for scans. Default: as many as cores."""

    def run(self) -> None:
        scans = self.scans
        require_at_least(1, size=self.size, every=self.every, views=scans.views, supersample=scans.supersample)
        require_at_least(0, train=scans.train, test=scans.test)
        match = re.fullmatch(r"(\d+)/(\d+)", self.shard)
        if match is None or not int(match[1]) < int(match[2]):
            raise UsageError(f"--shard {self.shard}: expected I/N with I from 0 to N - 1, as in 0/8")
        from humangs_jax.data.preprocess.protocol import NEAR_FACTORS

        factors = NEAR_FACTORS if scans.near else scans.factors
        if not 0 < factors[0] <= factors[1]:
            raise UsageError(f"--factors {factors[0]:g} {factors[1]:g}: expected a range of positive numbers")
        if not self.body.is_file():
            raise UsageError(f"--body {self.body}: no such file")
        require_at_least(1, workers=self.workers)
        require_folder(self.out)
        with stage("starting"):
            from humangs_jax.data.preprocess.run import preprocess
            from humangs_jax.data.preprocess.scenes import Settings

        settings = Settings(
            self.kind,
            self.layout,
            self.size,
            views=scans.views,
            factors=factors,
            supersample=scans.supersample,
            every=self.every,
            train=scans.train,
            test=scans.test,
        )
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        workers = cores if self.workers is None else self.workers
        part = int(match[1]), int(match[2])
        with stage("preprocessing"):
            report = preprocess(self.source, self.out, self.body, settings, part, workers)
        wrote(self.out, str(report))
        suggest("humangs train", self.out, "--body", self.body, "--out RUN")
