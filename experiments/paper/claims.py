"""Shows the paper's claims beside the results in docs/results. Measures nothing."""

import itertools
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from experiments.harness import Run, entry
from experiments.paper.bench import (
    NEAR,
    PHOTOS,
    REFERENCE,
    SEEDS,
    Difference,
    difference,
    finished,
    results,
    state_of,
    trained_names,
    variants,
)
from experiments.paper.rows import (
    ANIMATION,
    DOMAINS,
    FASTER_MODELLING,
    GAUSSIANS,
    GHG,
    HUMANRAM,
    LVSM,
    OURS,
    RECONSTRUCTION,
    VIEWS,
)
from experiments.results import markdown_table

CONTRADICTED, REPRODUCED, NOT_TESTED = (
    "contradicted at toy scale",
    "reproduced at toy scale",
    "not tested",
)
VERDICTS = CONTRADICTED, REPRODUCED, NOT_TESTED
"""All verdicts in the order of the page."""


class Pair(NamedTuple):
    """Two variants that a claim compares."""

    a: tuple[str, int | str]
    """Name and test of the variant that the paper says is better."""
    b: tuple[str, int | str]
    """Name and test of the other variant."""
    task: str = "reconstruction"
    """One of the tasks of `bench.TASKS`."""
    score: str = "psnr"
    """One of the scores of `bench.SCORES`."""


class Claim(NamedTuple):
    """A claim of the paper. Its verdict comes from `pairs`, or is given where there are none."""

    claim: str
    """What is claimed."""
    paper: str
    """The numbers of the paper, or how it supports the claim."""
    pairs: tuple[Pair, ...] = ()
    """The differences that the claim is about."""
    measured: str = ""
    """What is known, if there are no pairs."""
    verdict: tuple[str, str] = (NOT_TESTED, "")
    """The verdict and its reason, if there are no pairs."""


@entry
def paper_claims(run: Run) -> None:
    """Shows the paper's claims beside the results in docs/results. Measures nothing.

    A verdict is one of three. "reproduced at toy scale": the 95 % intervals of all differences that
    a claim is about lie on the paper's side. "contradicted at toy scale": one interval lies on the
    other side. "not tested": neither, or a variant that the claim needs is not trained or has fewer
    than three seeds.
    """
    report, cost = results("paper"), results("paper_cost")
    rows = judged(report, [*claims(), *of_cost(cost)])
    rows = sorted(rows, key=lambda row: VERDICTS.index(row[3]))
    lines = []
    for claim, paper, ours, verdict, why in rows:
        lines.append([claim, paper, ours, f"{verdict}: {why}" if why else verdict])
    heads = ["claim", "what the paper says", "what we measured", "verdict"]
    texts = [markdown_table(heads, lines, "llll")]
    added = [
        [name, in_words(report, pair) or lacking(report, [pair], 1)]
        for name, pair in additions().items()
    ]
    texts += [
        "Our own additions, each alone added to the paper's network:",
        markdown_table(["", "foreground PSNR"], added, "ll"),
    ]
    run.show("\n\n".join(texts), {"verdicts": {row[0]: row[3] for row in rows}})


def judged(
    report: Mapping[str, Any], listed: Iterable[Claim]
) -> list[tuple[str, str, str, str, str]]:
    """Returns a row for each claim: the claim, the paper's numbers, ours, the verdict, and why."""
    rows = []
    for row in listed:
        ours, verdict = row.measured, row.verdict
        if row.pairs:
            ours = "; ".join(filter(None, (in_words(report, pair) for pair in row.pairs)))
            verdict = judge(report, row.pairs)
        rows.append((row.claim, row.paper, ours or "-", *verdict))
    return rows


def in_words(report: Mapping[str, Any], pair: Pair) -> str:
    """Describes a difference, or returns "" where a run is not trained."""
    if lacking(report, [pair], 1):
        return ""
    names = " - ".join(f"`{name}` {test}" for name, test in pair[:2])
    unit, digits = ("", 4) if pair.score.startswith("lpips") else (" dB", 2)
    return f"{names}: {measured(report, pair).text(digits)}{unit}"


def measured(report: Mapping[str, Any], pair: Pair) -> Difference:
    """Returns a difference in the unit of the score, above 0 where the first variant is better."""
    found = difference(report["runs"], *pair)
    if pair.score.startswith("lpips"):
        return found._replace(mean=-found.mean)
    return found


def lacking(report: Mapping[str, Any], pairs: Iterable[Pair], seeds: int) -> str:
    """Describes what is missing for a verdict that needs this many seeds, "" if nothing is."""
    ready, texts = trained_names(report), []
    for name in dict.fromkeys(name for pair in pairs for name, _ in pair[:2]):
        count = len(finished(report["runs"], name))
        if name not in ready:
            texts.append(f"`{name}` is {state_of(report, name)}")
        elif count < seeds:
            texts.append(f"`{name}` has {count} of {seeds} seeds")
    return ", ".join(texts)


def judge(report: Mapping[str, Any], pairs: Iterable[Pair]) -> tuple[str, str]:
    """Returns the verdict on differences that the paper has above 0, and its reason."""
    missing = lacking(report, pairs, SEEDS)
    if missing:
        return NOT_TESTED, missing
    found = [(x.mean, x.half or 0.0) for x in (measured(report, pair) for pair in pairs)]
    if any(mean + half < 0 for mean, half in found):
        return CONTRADICTED, ""
    if all(mean > half for mean, half in found):
        return REPRODUCED, ""
    return NOT_TESTED, "an interval contains 0"


def additions() -> dict[str, Pair]:
    """Returns {name: comparison with the reference} of the variants with an addition of ours."""
    names = [name for name, variant in variants().items() if variant.about == "ours"]
    return {name: Pair((name, PHOTOS), (REFERENCE, PHOTOS), score="psnr_fg") for name in names}


def claims() -> list[Claim]:
    """Returns the claims about the quality of avatars."""

    def ours(count=PHOTOS):
        return (REFERENCE, count)

    # comparisons of the reference with another variant, in the tests that a claim is about
    def near(name):
        return tuple(Pair((REFERENCE, test), (name, test)) for test in NEAR)

    def part(name, tests=(PHOTOS,), score="psnr"):
        return tuple(Pair(ours(test), (name, test), score=score) for test in tests)

    one, five = GAUSSIANS["THuman2.1"]
    return [
        Claim(
            "HumanRAM reconstructs better than HumanGS, which needs no network for a frame",
            f"{printed(HUMANRAM, OURS)}; with each number of near photos",
            (Pair(("humanram", PHOTOS), ours()),),
        ),
        Claim(
            "animated by skinning alone, better than HumanRAM",
            f"{pair_of(ANIMATION[OURS], ANIMATION[HUMANRAM])}",
            (Pair(ours(), ("humanram", PHOTOS), "animation"),),
        ),
        Claim(
            "better than GHG with 1, 2, 4 and 6 photos",
            f"near: {by_photos(OURS, GHG)}",
            near("ghg"),
        ),
        Claim(
            "better than LVSM with 1, 2, 4 and 6 photos",
            f"near: {by_photos(OURS, LVSM)}",
            near("lvsm"),
        ),
        Claim(
            "better than GST, which takes one photo",
            f"{pair_of(DOMAINS[OURS][0], DOMAINS['GST, released weights'][0])} of released weights",
            (Pair(ours(), ("gst", 1)), Pair(ours(1), ("gst", 1))),
        ),
        Claim(
            "better than GIGA",
            pair_of(DOMAINS["HumanGS, on GIGA's split"][0], DOMAINS["GIGA, on its split"][0]),
            (Pair(ours(), ("giga", PHOTOS)),),
        ),
        Claim(
            "better than one-photo LHM in other poses",
            pair_of(ANIMATION[OURS], ANIMATION["LHM (single view)"]),
            (Pair(ours(), ("lhm", 1), "animation"),),
        ),
        Claim(
            "several photos beat one-photo LHM (cited from LCA)",
            "multi-view beats single-view",
            (Pair(("lhm_views", PHOTOS), ("lhm", 1)),),
        ),
        Claim(
            "1 tight + 4 free Gaussians a vertex against 1",
            pair_of(five, one),
            part("1 Gaussian a vertex", (PHOTOS, NEAR[2])),
        ),
        Claim(
            "the global token helps with 1 and 2 photos, not from 4 on",
            "a figure",
            part("no global token", NEAR[:2]),
        ),
        Claim(
            "features of four depths",
            "LPIPS of patches falls",
            part("one depth", score="lpips_alex"),
        ),
        Claim(
            "pooling over visible views",
            "described so; the release pools all",
            part("pooling over all views"),
        ),
        Claim(
            "back-projection instead of attention to the photos",
            "no numbers",
            (Pair(("back_projection", PHOTOS), ("cross_attention", PHOTOS)),),
        ),
        Claim(
            "each further photo helps",
            f"near: {', '.join(f'{x[0]:.2f}' for x in VIEWS[OURS])} dB with 1, 2, 4, 6",
            tuple(Pair(ours(b), ours(a)) for a, b in itertools.pairwise(NEAR)),
        ),
        Claim(
            "Animatable Gaussians, fitted to one person, is a little better",
            pair_of(ANIMATION["Animatable Gaussians"], ANIMATION[OURS]),
            verdict=(NOT_TESTED, "fits of one person are compared in no common setting"),
        ),
        Claim(
            "other kinds of people: HumanGS loses least",
            f"AvatarReX, dB: {lost()}",
            verdict=(NOT_TESTED, "all people here are of one generator"),
        ),
        Claim(
            "people of one source driven by motions of another",
            "images",
            verdict=(NOT_TESTED, "it is skinning, and works with any weights"),
        ),
    ]


def of_cost(cost: Mapping[str, Any]) -> list[Claim]:
    """Returns the claims about the cost of the network, judged by the numbers of `paper_cost`."""
    readers = [(row["cross-attention"], row["back-projection"]) for row in cost["rows"]]
    times = [dear["cpu_ms"] / cheap["cpu_ms"] for dear, cheap in readers]
    counts = [dear["operations"] / cheap["operations"] for dear, cheap in readers]
    operations = {name: x["operations"] for name, x in cost["networks"].items()}
    lhm = operations["lhm"] / operations["humangs"]
    whole = operations["cross_attention"] / operations["back_projection"] - 1
    return [
        Claim(
            "reading by back-projection is cheap",
            "replaces attention from vertices to the photos",
            measured=(
                f"{min(times):.0f} to {max(times):.0f} times less CPU time than attention,"
                f" {min(counts):.0f} to {max(counts):.0f} times fewer operations (one reader 128"
                " wide, forward, each size once)"
            ),
            verdict=(REPRODUCED if min(times) > 1 else CONTRADICTED, ""),
        ),
        Claim(
            f"modelling is {FASTER_MODELLING} x faster than LHM's",
            "0.29 s against 4.59 s on a GPU",
            measured=(
                f"counted operations: LHM's joint attention alone has {lhm:.1f} x those of HumanGS."
                f" Attention instead of back-projection adds {whole:.0%} to the whole network"
            ),
            verdict=(NOT_TESTED, "nothing was timed on a GPU, LHM's backbones are not counted"),
        ),
    ]


def pair_of(a: Any, b: Any) -> str:
    """Formats the printed PSNRs of two systems, each the first number of a row."""
    return f"{a[0]:.2f} against {b[0]:.2f} dB"


def by_photos(a: str, b: str) -> str:
    """Formats the printed PSNRs of two systems with 1, 2, 4 and 6 near photos."""
    return ", ".join(f"{x[0]:.2f} - {y[0]:.2f}" for x, y in zip(VIEWS[a], VIEWS[b], strict=True))


def lost() -> str:
    """Formats the decibels that systems lose on the other data set."""
    both = {name: DOMAINS[name] for name in (OURS, HUMANRAM, LVSM, GHG)}
    return ", ".join(
        f"{name} {there[0] - here[0]:+.1f}" for name, (here, there) in both.items() if there
    )


def printed(a: str, b: str) -> str:
    """Formats the printed PSNRs of two systems in the tables of reconstruction."""
    sets = {"THuman2.1": (DOMAINS, 0), "THuman4.0": (RECONSTRUCTION, 0), "AvatarReX": (DOMAINS, 1)}
    return ", ".join(
        f"{name} {pair_of(table[a][i], table[b][i])}" for name, (table, i) in sets.items()
    )
