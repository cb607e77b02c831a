"""`humangs evaluate`: scores of reconstructions, avatars or any program's images under a protocol."""

import dataclasses
import hashlib
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from tyro.conf import OmitArgPrefixes, Positional

from humangs_jax.cli.options import Place, UsageError
from humangs_jax.cli.screen import stage, suggest, tell, wrote
from humangs_jax.core.configuration import at_least

KEPT_SECONDS = 30 * 24 * 3600.0
"""For which the scores of an interrupted evaluation are kept."""


@dataclasses.dataclass(frozen=True)
class LpipsFiles:
    """Weights of LPIPS, each a file of the backbone and, if that has none, one of the heads (docs: loss_networks)."""

    lpips_vgg: tuple[Path, ...] = ()
    """LPIPS of vgg. Default: of the extra `lpips`, if it is installed."""
    lpips_alex: tuple[Path, ...] = ()
    """LPIPS of alex."""
    lpips_squeeze: tuple[Path, ...] = ()
    """LPIPS of squeeze."""


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Score novel views of people against photos: PSNR, SSIM, LPIPS.

    Of weights (people are reconstructed from some photos and compared on the others), of avatars, or of images that any program
    rendered. The same command goes on after an interruption. Protocols of papers: docs: evaluation.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs evaluate people --weights weights.safetensors --html scores.html",
        "humangs evaluate me --avatar avatar.npz --json scores.json",
    )
    lpips: OmitArgPrefixes[LpipsFiles]
    source: Positional[Path]
    """A capture folder, a folder of them, a scene list, or a data set (docs: datasets)."""
    avatar: Path | None = None
    """File written by `humangs reconstruct`, or a folder with PERSON.npz."""
    weights: Path | None = None
    """Network weights (.safetensors). Default, without --avatar and --predictions: the shipped ones."""
    predictions: Path | None = None
    """Folder with PERSON/VIEW.png, named like the photos; VIEW.png for one capture."""
    protocol: Literal["humangs", "animatable-gaussians", "ghg", "giga", "lhm", "lhm++", "lvsm"] = "humangs"
    """Whose backgrounds, crops, networks and SSIM."""
    body: Path | None = None
    """Model file that the parameters of a data set belong to. Default: the body that comes with the package."""
    inputs: Annotated[int | None, at_least(1)] = None
    """How many photos are inputs, evenly spaced. Default: 4."""
    indices: Path | None = None
    """JSON that says which views are inputs and targets: {"PERSON": {"context": [...], "target": [...]}}."""
    json: Annotated[Path | None, Place((".json",))] = None
    """Write all numbers here."""
    html: Annotated[Path | None, Place((".html",))] = None
    """Write a page with inputs, truth, ours and error, worst first."""
    csv: Annotated[Path | None, Place((".csv",))] = None
    """Write one line an image."""
    markdown: Annotated[Path | None, Place((".md",))] = None
    """Write a table of people."""
    latex: Annotated[Path | None, Place((".tex",))] = None
    """Write the same table for LaTeX (package booktabs)."""
    page_images: Annotated[int, at_least(0)] = 120
    """Images that the page shows."""

    def run(self) -> None:
        files = {name: getattr(self, name) for name in ("json", "html", "csv", "markdown", "latex")}
        with stage("starting"):
            from humangs_jax.evaluation.run import evaluate
            from humangs_jax.losses.loss_networks import load_lpips

        networks = []
        for net in ("vgg", "alex", "squeeze"):
            if found := getattr(self.lpips, f"lpips_{net}"):
                if len(found) > 2:
                    raise UsageError(f"--lpips-{net}: expected a backbone and at most one file of heads, got {len(found)}")
                networks.append(load_lpips(net, *found))
        keep = self._kept()
        if keep is not None and (scored := len(list(keep.glob("person_*.json")))):
            tell(f"going on: {scored} {'person is' if scored == 1 else 'people are'} scored")
        with stage("evaluating"):
            result = evaluate(
                self.source,
                avatar=self.avatar,
                weights=self.weights,
                predictions=self.predictions,
                protocol=self.protocol,
                inputs=self.inputs,
                indices=self.indices,
                lpips=networks,
                body=self.body,
                page_images=self.page_images if self.html is not None else 0,
                keep=keep,
                progress=True,
            )
        tell(result.summary())
        result.write(**files)
        if keep is not None:
            shutil.rmtree(keep, ignore_errors=True)
        for name, path in files.items():
            if path is not None:
                wrote(path, {"json": "all numbers", "html": "the images, worst first"}.get(name, "a table"))
        if self.html is None:
            suggest("humangs evaluate", self.source, *self._given(), "--html scores.html")

    def _kept(self) -> Path | None:
        """A folder in the user's cache, that of the same command on the same files; None where nothing can be written."""
        from humangs_jax import __version__
        from humangs_jax.core.processes import user_cache

        named = [self.source, self.avatar, self.weights, self.predictions, self.indices, self.body]
        named += [file for files in vars(self.lpips).values() for file in files]
        said: list[Any] = [__version__, self.protocol, self.inputs, self.html is not None and self.page_images]
        for path in named:
            files = [] if path is None else [path, *sorted(path.rglob("*"))]
            said += [(str(file.resolve()), (stat := file.stat()).st_size, stat.st_mtime_ns) for file in files if file.exists()]
        try:
            root = user_cache() / "humangs_jax" / "evaluations"
            folder = root / hashlib.sha256(repr(said).encode()).hexdigest()[:16]
            folder.mkdir(parents=True, exist_ok=True)
            for other in root.iterdir():
                if time.time() - other.stat().st_mtime > KEPT_SECONDS:
                    shutil.rmtree(other, ignore_errors=True)
        except (OSError, RuntimeError):  # RuntimeError: no home
            return None
        return folder

    def _given(self) -> Iterator[str | Path]:
        """The options that say what is evaluated and how, as they were given."""
        names = ("avatar", "weights", "predictions", "protocol", "body", "inputs", "indices")
        options = {f"--{name}": getattr(self, name) for name in names if getattr(self, name) is not None}
        options |= {f"--{name.replace('_', '-')}": files for name, files in vars(self.lpips).items()}
        for option, values in options.items():
            for value in values if isinstance(values, tuple) else (values,):
                yield from (option, value if isinstance(value, Path) else str(value))
