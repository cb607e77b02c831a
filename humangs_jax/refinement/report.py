"""What a run of refinement has come to."""

import dataclasses

from humangs_jax.avatar.avatar import Avatar


@dataclasses.dataclass(frozen=True, eq=False)
class Refinement:
    """What `refine_with_report` returns.

    avatar: the best state of the run. iterations, steps: how many of the learned update (0 if they were not kept) and of Adam,
    with those of the trial. seconds: of the run, without compilation (compile_seconds). loss: before and after, over the photos
    that were fitted. psnr: likewise, dB over the crops. kept: whether the avatar has become better; if not, it is unchanged.
    interrupted: whether Ctrl-C ended the run. planned: `RefineConfig(steps=planned, seconds=None)` repeats the run exactly; None:
    it was cut short. left_out: names of photos that contradict the others, and were not fitted.
    """

    avatar: Avatar
    iterations: int
    steps: int
    seconds: float
    compile_seconds: float
    loss: tuple[float, float]
    psnr: tuple[float, float]
    kept: bool
    interrupted: bool = False
    planned: int | None = None
    left_out: tuple[str, ...] = ()

    def summary(self) -> str:
        """One line."""
        gain = f"{self.psnr[0]:.1f} -> {self.psnr[1]:.1f} dB on the photos"
        verdict = gain if self.kept else "no improvement: the avatar is unchanged"
        if self.left_out:
            verdict += f"; without {', '.join(self.left_out)}, which contradicts the others"
        ended = ", interrupted" if self.interrupted else ""
        took = (
            f"{self.iterations} iterations and {self.steps} steps in {self.seconds:.1f} s "
            f"(compiled in {self.compile_seconds:.1f} s)"
        )
        again = f" (the same again: {self.planned}steps)" if self.planned else ""
        return f"refined by {took}{ended}: {verdict}{again}"
