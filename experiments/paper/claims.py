"""The paper's claims beside what docs/results says of them. Measures nothing."""

from collections.abc import Collection
from typing import Any, NamedTuple

from experiments.harness import Run, entry
from experiments.paper.bench import (
    ANIMATION,
    DOMAINS,
    FASTER_MODELLING,
    GHG,
    HUMANRAM,
    NOT_TRAINED,
    OURS,
    PAINTED_TABLE,
    RECONSTRUCTION,
    SHIPPED,
    VIEWS,
    headline,
    results,
    seed_interval,
    untrained,
)
from experiments.results import markdown_table

GIGA_SPLIT = "HumanGS, on GIGA's split"
CONTRADICTED, CONSISTENT, NOT_TESTED = "contradicted at toy scale", "consistent at toy scale", "not tested"
VERDICTS = CONTRADICTED, CONSISTENT, NOT_TESTED
"""In the order of the page."""


class Claim(NamedTuple):
    """A row: what is claimed, what the paper printed, what was measured, the verdict and why."""

    claim: str
    paper: str
    measured: str
    verdict: str
    why: str = ""


@entry
def paper_claims(run: Run) -> None:
    """The paper's claims beside what docs/results says of them. Measures nothing.

    A verdict is one of three. Of the differences that a claim is about, the 95 % intervals by the seeds of training lie all on
    the paper's side: "consistent at toy scale"; one lies on the other side: "contradicted at toy scale"; else, or where a system
    that the claim needs is not trained: "not tested". A contradiction by a system that is not trained is called one, and says
    so.
    """
    numbers = Numbers()
    rows = sorted(claims(numbers), key=lambda row: VERDICTS.index(row.verdict))
    lines = [[row.claim, row.paper, row.measured, row.verdict + (f": {row.why}" if row.why else "")] for row in rows]
    half = f"+-{numbers.interval['psnr_fg']:.2f} dB of foreground PSNR and +-{numbers.interval['psnr']:.2f} dB of PSNR"
    texts = [
        markdown_table(["claim", "what the paper says", "what we measured", "holds?"], lines, "llll"),
        f"Intervals: {half}, at 95 %, by two pairs of seeds, from four photos of the validation people, and taken for all "
        "rows. They do not cover other people. Our own additions:",
        markdown_table(["without it, on the bench", "foreground PSNR"], additions(numbers), "ll"),
    ]
    held = {"interval": numbers.interval, "untrained": numbers.gray, "verdicts": {x.claim: x.verdict for x in rows}}
    run.show("\n\n".join(texts), held)


class Numbers:
    """What docs/results holds of the bench."""

    def __init__(self):
        self.runs = results("paper")["runs"]
        self.rows = results("paper_tables")["rows"]
        self.cost = results("paper_cost")
        intervals = {score: seed_interval(self.runs, score) for score in ("psnr", "psnr_fg")}
        self.interval = {score: half for score, half in intervals.items() if half is not None}
        self.gray = untrained(self.runs, results(PAINTED_TABLE)["validation"])

    def change(self, name: str, against: str, score: str = "psnr", photos: int | None = None) -> float:
        """dB that one variant has more than another on the validation people."""
        a, b = (self.runs[x]["by_views"][str(photos)] if photos else headline(self.runs[x]) for x in (name, against))
        return a[score] - b[score]

    def test(self, name: str, photos: int = 4, people: str = "people8", task: str = "reconstruction") -> float:
        """PSNR of a row of the tables, dB."""
        return self.rows[f"{name}, {people}, {photos}"][task][0]

    def said(self, *changes: float, score: str = "psnr") -> str:
        """Differences with their interval."""
        return f"{', '.join(f'{x:+.2f}' for x in changes)} +-{self.interval[score]:.2f} dB"

    def judge(self, *changes: float, needs: Collection[str] = (), score: str = "psnr") -> tuple[str, str]:
        """(verdict, why) of differences that the paper has above 0, between systems of which some may not be trained."""
        half = self.interval[score]
        gray = [f"`{name}`" for name in needs if name in self.gray]
        missing = f"{' and '.join(gray)} {'is' if len(gray) == 1 else 'are'} {NOT_TRAINED}" if gray else ""
        if min(changes) < -half:
            return CONTRADICTED, missing
        if gray:
            return NOT_TESTED, missing
        return (CONSISTENT, "") if min(changes) > half else (NOT_TESTED, "the interval contains 0")


def claims(n: Numbers) -> list[Claim]:
    """All of them; the page sorts them by verdict."""
    return [*of_systems(n), *of_parts(n), *of_cost(n), *of_people(n)]


def of_systems(n: Numbers) -> list[Claim]:
    """Who is better than whom."""
    ours, near = "humangs", "near8"
    ram = n.test("humanram") - n.test(ours)
    few = [n.test(ours, count) - n.test("ghg", count) for count in (1, 2)]
    few_near = [n.test(ours, count, near) - n.test("ghg", count, near) for count in (1, 2)]
    gst = n.test(ours, 1, near) - n.test("gst", 1, near)
    plain = [n.test("back-projection") - n.test(name) for name in ("giga", "ghg")]
    plain_fg = [n.change("back-projection", name, "psnr_fg") for name in ("giga", "ghg")]
    extended = [n.test(ours) - n.test(name) for name in ("giga", "ghg")]
    moved = n.test(ours, task="animation") - n.test("humanram", task="animation")
    several = n.change("lhm_views", "lhm", "psnr_fg")
    others = [f"`{name}`" for name in ("lhm", "lvsm", "gst") if name in n.gray]
    return [
        Claim(
            "HumanRAM reconstructs better than HumanGS, which needs no network for a frame",
            f"{printed(HUMANRAM, OURS)}; with each number of near photos",
            f"`humanram` against `humangs`: {n.said(ram)}",
            *n.judge(ram, needs=["humanram"]),
        ),
        Claim(
            "better than GHG with one and two photos",
            f"{pair(VIEWS[OURS][0], VIEWS[GHG][0])}, {pair(VIEWS[OURS][1], VIEWS[GHG][1])}, near",
            f"`humangs`, trained with four, against `ghg`: {n.said(*few)}; near {n.said(*few_near)}",
            *n.judge(*few, *few_near),
        ),
        Claim(
            "better than GST",
            f"{pair(DOMAINS[OURS][0], DOMAINS['GST, released weights'][0])} of GST's released weights with one photo",
            f"one photo each: `humangs`, trained with four, near: {n.said(gst)}; `humangs, 1 photo`, foreground: "
            f"{n.said(n.change('humangs, 1 photo', 'gst', 'psnr_fg'), score='psnr_fg')}",
            *n.judge(gst, needs=["gst"]),
        ),
        Claim(
            "better than GIGA and GHG",
            f"{pair(DOMAINS[GIGA_SPLIT][0], DOMAINS['GIGA, on its split'][0])}, {pair(DOMAINS[OURS][0], DOMAINS[GHG][0])}",
            f"the paper's reader (`back-projection`): {n.said(*plain)}; foreground {n.said(*plain_fg, score='psnr_fg')}. "
            f"`humangs`, with our additions: {n.said(*extended)}",
            *n.judge(*plain),
        ),
        Claim(
            "better than one-photo LHM, LVSM and GST",
            f"tables 1 to 3: {pair(ANIMATION[OURS], ANIMATION['LHM (single view)'])} against LHM",
            "scores of networks that show grey bodies",
            NOT_TESTED,
            f"{', '.join(others)} are {NOT_TRAINED}",
        ),
        Claim(
            "animated by skinning alone, better than HumanRAM",
            f"{pair(ANIMATION[OURS], ANIMATION[HUMANRAM])}; Animatable Gaussians {ANIMATION['Animatable Gaussians'][0]}",
            f"novel poses, against `humanram`: {n.said(moved)}",
            *n.judge(moved, needs=["humanram"]),
        ),
        Claim(
            "several photos beat one-photo LHM (cited from LCA)",
            "multi-view beats single-view",
            f"`lhm_views` against `lhm`, foreground: {n.said(several, score='psnr_fg')}",
            *n.judge(several, needs=["lhm", "lhm_views"], score="psnr_fg"),
        ),
    ]


def of_parts(n: Numbers) -> list[Claim]:
    """What a part of the network gains."""
    gaussians = n.change("1 + 4 Gaussians a vertex", "1 Gaussian a vertex")
    gaussians_fg = n.change("1 + 4 Gaussians a vertex", "1 Gaussian a vertex", "psnr_fg")
    token = [n.change("humangs", "no global token", photos=count) for count in (1, 2, 4, 6)]
    token_fg = [n.change("humangs", "no global token", "psnr_fg", count) for count in (1, 2, 4, 6)]
    depths = n.change("features of four depths", "features of the last layer")
    pooled = n.change("humangs", "pooling over all views", "psnr_fg")
    reads = n.change("back-projection", "cross-attention", "psnr_fg")
    return [
        Claim(
            "1 tight + 4 free Gaussians a vertex against 1",
            "+0.15 dB (THuman2.1), +0.04 to +0.11 elsewhere",
            f"{n.said(gaussians)}; foreground {n.said(gaussians_fg, score='psnr_fg')}",
            *n.judge(gaussians),
        ),
        Claim(
            "the global token helps with 1 and 2 photos, not from 4 on",
            "a figure",
            f"1, 2, 4, 6 photos: {n.said(*token)}; foreground {n.said(*token_fg, score='psnr_fg')}",
            *n.judge(*token[:2]),
        ),
        Claim(
            "features of several depths",
            "LPIPS of patches falls (positive skew)",
            f"against the last layer: {n.said(depths)}; squared error of patches: negative skew",
            NOT_TESTED,
            "LPIPS was not measured",
        ),
        Claim(
            "pooling over visible views",
            "described so; the release pools all",
            f"against all views, foreground: {n.said(pooled, score='psnr_fg')}",
            *n.judge(pooled, score="psnr_fg"),
        ),
        Claim(
            "back-projection instead of attention to the photos",
            "no numbers",
            f"`back-projection` against `cross-attention`, foreground: {n.said(reads, score='psnr_fg')}",
            *n.judge(reads, needs=["cross-attention"], score="psnr_fg"),
        ),
    ]


def of_cost(n: Numbers) -> list[Claim]:
    """What it costs."""
    readers = [(row["cross-attention"], row["back-projection"]) for row in n.cost["rows"]]
    times = [dear["cpu_ms"] / cheap["cpu_ms"] for dear, cheap in readers]
    counts = [dear["operations"] / cheap["operations"] for dear, cheap in readers]
    operations = {name: x["operations"] for name, x in n.cost["networks"].items()}
    whole = operations["cross_attention"] / operations["back_projection"] - 1
    lhm = operations["lhm"] / operations["humangs"]
    return [
        Claim(
            "reading by back-projection is cheap",
            "replaces attention from vertices to the photos",
            f"{min(times):.0f} to {max(times):.0f} times less CPU time than attention, "
            f"{min(counts):.0f} to {max(counts):.0f} times fewer operations (one reader 128 wide, forward, each size once)",
            CONSISTENT if min(times) > 1 else CONTRADICTED,
        ),
        Claim(
            f"modelling is {FASTER_MODELLING} x faster than LHM's",
            "0.29 s against 4.59 s on a GPU",
            f"counted operations: LHM's joint attention alone has {lhm:.1f} x those of HumanGS. Attention instead of "
            f"back-projection adds {whole:.0%} to the whole network: reading is not what makes the difference",
            NOT_TESTED,
            "nothing was timed on a GPU, LHM's backbones are not counted",
        ),
    ]


def of_people(n: Numbers) -> list[Claim]:
    """Of which people and photos it holds."""
    steps = [n.test("humangs", b) - n.test("humangs", a) for a, b in ((1, 2), (2, 4), (4, 6))]
    near = [n.test("humangs", b, "near8") - n.test("humangs", a, "near8") for a, b in ((1, 2), (2, 4), (4, 6))]
    lost = {
        kind: [n.test(name, people=kind) - n.test(name) for name in ("humangs", "back-projection", "giga", "ghg")]
        for kind in ("walking8", "fitted8")
    }
    shipped = n.test(SHIPPED, people="fitted8") - n.test(SHIPPED)
    split = n.test("humangs, on the other split") - n.test("giga, on the other split")
    both = {name: DOMAINS[name] for name in (OURS, HUMANRAM, "LVSM", GHG)}
    paper_lost = ", ".join(f"{name} {there[0] - here[0]:+.1f}" for name, (here, there) in both.items() if there)
    return [
        Claim(
            "each further photo helps",
            f"near: {', '.join(f'{x[0]:.2f}' for x in VIEWS[OURS])} dB with 1, 2, 4, 6",
            f"1 to 2, 2 to 4, 4 to 6: {n.said(*steps)}; near {n.said(*near)}",
            *n.judge(*steps, *near),
        ),
        Claim(
            "other kinds of people: HumanGS loses least",
            f"AvatarReX, dB: {paper_lost}",
            f"`humangs`, `back-projection`, `giga`, `ghg`: walking8 {n.said(*lost['walking8'])}; fitted8 "
            f"{n.said(*lost['fitted8'])}; the shipped weights gain {shipped:.1f} dB on fitted8",
            NOT_TESTED,
            "walking8 are the 8 people of the other rows in other poses, fitted8 are of the same generator",
        ),
        Claim(
            "another split: better than GIGA",
            pair(DOMAINS[GIGA_SPLIT][0], DOMAINS["GIGA, on its split"][0]),
            f"`humangs`, with our additions, against `giga`: {n.said(split)}",
            NOT_TESTED,
            "the paper's reader was not trained on it",
        ),
        Claim(
            "people of one source driven by motions of another",
            "images",
            "`paper_figures --only driven`",
            NOT_TESTED,
            "it is skinning, and works with any weights",
        ),
    ]


def additions(n: Numbers) -> list[list[str]]:
    """What is ours and not the paper's: the change without it."""
    pairs = {
        "shells": ("no shells", "humangs"),
        "photo colors (of a network without shells)": ("no photo colors", "no shells"),
        "Gaussians in the normals' frame (of a network without shells)": ("canonical frame", "no shells"),
        "the person's tokens alone (with all of them)": ("all tokens", "humangs"),
    }
    return [[name, n.said(n.change(*variants, score="psnr_fg"), score="psnr_fg")] for name, variants in pairs.items()]


def pair(a: Any, b: Any) -> str:
    """Two printed rows' PSNR."""
    return f"{a[0]:.2f} against {b[0]:.2f} dB"


def printed(a: str, b: str) -> str:
    """What the tables of reconstruction say of two systems."""
    sets = {"THuman2.1": (DOMAINS, 0), "THuman4.0": (RECONSTRUCTION, 0), "AvatarReX": (DOMAINS, 1)}
    return ", ".join(f"{name} {pair(table[a][i], table[b][i])}" for name, (table, i) in sets.items())
