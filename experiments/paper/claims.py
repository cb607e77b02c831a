"""The paper's claims beside what docs/results says of them. Measures nothing."""

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
"""In the order of the page."""


class Pair(NamedTuple):
    """Two variants, the better one by the paper first, each with its photos."""

    a: tuple[str, int | str]
    b: tuple[str, int | str]
    task: str = "reconstruction"
    score: str = "psnr"


class Claim(NamedTuple):
    """pairs: what it is about.

    Without them `measured` is what is known, and the verdict is given.
    """

    claim: str
    paper: str
    pairs: tuple[Pair, ...] = ()
    measured: str = ""
    verdict: tuple[str, str] = (NOT_TESTED, "")


@entry
def paper_claims(run: Run) -> None:
    """The paper's claims beside what docs/results says of them. Measures nothing.

    A verdict is one of three. The 95 % intervals of all differences that a claim is about lie on
    the paper's side: "reproduced at toy scale"; one lies on the other side: "contradicted at toy
    scale"; else, or where a variant that it needs is not trained, or has fewer than three seeds:
    "not tested".
    """
    report, cost = results("paper"), results("paper_cost")
    rows = sorted(
        judged(report, [*claims(), *of_cost(cost)]), key=lambda row: VERDICTS.index(row[3])
    )
    lines = [[*row[:3], f"{row[3]}: {row[4]}" if row[4] else row[3]] for row in rows]
    heads = ["claim", "what the paper says", "what we measured", "verdict"]
    texts = [markdown_table(heads, lines, "llll")]
    added = [[name, said(report, x) or lacking(report, [x], 1)] for name, x in additions().items()]
    texts += [
        "Our own additions, each alone added to the paper's network:",
        markdown_table(["", "foreground PSNR"], added, "ll"),
    ]
    run.show("\n\n".join(texts), {"verdicts": {row[0]: row[3] for row in rows}})


def judged(
    report: Mapping[str, Any], listed: Iterable[Claim]
) -> list[tuple[str, str, str, str, str]]:
    """Rows: claim, the paper, ours, verdict, why."""
    return [
        (
            (
                row.claim,
                row.paper,
                "; ".join(filter(None, (said(report, x) for x in row.pairs))) or "-",
                *judge(report, row.pairs),
            )
            if row.pairs
            else (row.claim, row.paper, row.measured or "-", *row.verdict)
        )
        for row in listed
    ]


def said(report: Mapping[str, Any], pair: Pair) -> str:
    """A difference in words; nothing where a run is not trained."""
    names = " - ".join(f"`{name}` {test}" for name, test in pair[:2])
    unit, digits = ("", 4) if pair.score.startswith("lpips") else (" dB", 2)
    return (
        ""
        if lacking(report, [pair], 1)
        else f"{names}: {measured(report, pair).text(digits)}{unit}"
    )


def measured(report: Mapping[str, Any], pair: Pair) -> Difference:
    """In the unit of the score; of LPIPS a gain is a smaller one."""
    found = difference(report["runs"], *pair)
    return found._replace(mean=-found.mean) if pair.score.startswith("lpips") else found


def lacking(report: Mapping[str, Any], pairs: Iterable[Pair], seeds: int) -> str:
    """What is missing for a verdict that needs this many seeds; "": nothing."""
    ready, texts = trained_names(report), []
    for name in dict.fromkeys(name for pair in pairs for name, _ in pair[:2]):
        if name not in ready:
            texts.append(f"`{name}` is {state_of(report, name)}")
        elif (count := len(finished(report["runs"], name))) < seeds:
            texts.append(f"`{name}` has {count} of {seeds} seeds")
    return ", ".join(texts)


def judge(report: Mapping[str, Any], pairs: Iterable[Pair]) -> tuple[str, str]:
    """(verdict, why) of differences that the paper has above 0."""
    if missing := lacking(report, pairs, SEEDS):
        return NOT_TESTED, missing
    found = [(x.mean, x.half or 0.0) for x in (measured(report, pair) for pair in pairs)]
    if any(mean + half < 0 for mean, half in found):
        return CONTRADICTED, ""
    return (
        (REPRODUCED, "")
        if all(mean > half for mean, half in found)
        else (NOT_TESTED, "an interval contains 0")
    )


def additions() -> dict[str, Pair]:
    """What is ours and not the paper's, by name."""
    names = [name for name, variant in variants().items() if variant.about == "ours"]
    return {name: Pair((name, PHOTOS), (REFERENCE, PHOTOS), score="psnr_fg") for name in names}


def claims() -> list[Claim]:
    def ours(count=PHOTOS):
        return (REFERENCE, count)

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
    return f"{a[0]:.2f} against {b[0]:.2f} dB"


def by_photos(a: str, b: str) -> str:
    """Printed PSNR of two systems with 1, 2, 4 and 6 near photos."""
    return ", ".join(f"{x[0]:.2f} - {y[0]:.2f}" for x, y in zip(VIEWS[a], VIEWS[b], strict=True))


def lost() -> str:
    """What systems lose on the other data set."""
    both = {name: DOMAINS[name] for name in (OURS, HUMANRAM, LVSM, GHG)}
    return ", ".join(
        f"{name} {there[0] - here[0]:+.1f}" for name, (here, there) in both.items() if there
    )


def printed(a: str, b: str) -> str:
    """What the tables of reconstruction say of two systems."""
    sets = {"THuman2.1": (DOMAINS, 0), "THuman4.0": (RECONSTRUCTION, 0), "AvatarReX": (DOMAINS, 1)}
    return ", ".join(
        f"{name} {pair_of(table[a][i], table[b][i])}" for name, (table, i) in sets.items()
    )
