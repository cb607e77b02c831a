"""What a run of refinement has come to."""

import dataclasses

from humangs_jax.avatar.avatar import Avatar


@dataclasses.dataclass(frozen=True, eq=False)
class Refinement:
    """What `refine_with_report` returns.

    avatar: the best state of the run. rounds, steps: how many of the learned update (0 if they were not kept) and of Adam.
    seconds: of the run, without compilation (compile_seconds). loss: before and after, over all photos. psnr: before and after,
    dB over the crops. kept: whether the loss has fallen; if not, the avatar is unchanged. interrupted: whether Ctrl-C ended the
    run.
    """

    avatar: Avatar
    rounds: int
    steps: int
    seconds: float
    compile_seconds: float
    loss: tuple[float, float]
    psnr: tuple[float, float]
    kept: bool
    interrupted: bool = False

    def summary(self) -> str:
        """One line."""
        gain = f"{self.psnr[0]:.1f} -> {self.psnr[1]:.1f} dB on the photos"
        verdict = gain if self.kept else "no improvement on the photos: the avatar is unchanged"
        ended = ", interrupted" if self.interrupted else ""
        took = f"{self.rounds} rounds and {self.steps} steps in {self.seconds:.1f} s (compiled in {self.compile_seconds:.1f} s)"
        return f"refined by {took}{ended}: {verdict}"
