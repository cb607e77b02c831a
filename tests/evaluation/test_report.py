"""The page of an evaluation in a browser: sorted by score, sortable, and without network access."""

import numpy as np
import pytest
from evaluation_cases import capture_from, random_views

import humangs_jax as hg
from experiments import chromium
from humangs_jax.evaluation import run
from humangs_jax.evaluation.cases import Case, Predicted

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(chromium.missing() is not None, reason=str(chromium.missing())),
]

TABLE = "[...document.querySelectorAll('#images tbody tr')]"


@pytest.fixture(scope="module")
def found():
    cases = []
    for i, name in enumerate(("ann", "<b>bob</b>")):
        _, truth, masks = random_views(i, 3)
        inputs = capture_from(*random_views(9, 2)[1:])
        cases.append(Case(name, capture_from(truth, masks, frames=[0, 0, 1]), inputs))
    rng = np.random.default_rng(0)

    def method(case, background):
        noise = rng.uniform(0.02, 0.3, (3, 1, 1, 1)) * rng.standard_normal(case.truth.images.shape)
        return Predicted(
            np.clip(case.truth.images + noise, 0, 1).astype(np.float32), None, (0, 1, 2)
        )

    with pytest.MonkeyPatch.context() as patch:  # as without the extra `lpips`
        patch.setattr(run, "installed_lpips", lambda: ())
        return hg.evaluate(cases, method=method, page_images=5)


@pytest.fixture(scope="module")
def browser(found, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    found.write(html=path)
    with chromium.Chromium() as browser:
        browser.open(path)
        yield browser
        assert browser.problems() == []


def column(browser, heading):
    """Returns the texts of a column of the table of images."""
    return browser.run(
        f"""const heads = [...document.querySelectorAll('#images th')]
          .map((head) => head.textContent);
        return {TABLE}.map((row) => row.cells[heads.indexOf(given[0])].textContent);""",
        heading,
    )


def press(browser, heading):
    browser.run(
        "[...document.querySelectorAll('#images th button')].find((b) => b.textContent ==="
        " given[0]).click()",
        heading,
    )


def test_the_worst_comes_first_and_columns_sort(browser, found):
    expected = sorted(row.scores["psnr"] for row in found.rows)
    assert column(browser, "PSNR") == [f"{x:.2f}" for x in expected]
    press(browser, "PSNR")
    assert column(browser, "PSNR") == [f"{x:.2f}" for x in expected[::-1]]
    press(browser, "person")
    assert column(browser, "person") == ["<b>bob</b>"] * 3 + ["ann"] * 3  # as text, not as HTML
    press(browser, "foreground PSNR")
    assert column(browser, "foreground PSNR") == sorted(
        column(browser, "foreground PSNR"), key=float
    )
    assert browser.run("return document.querySelectorAll('#images th[aria-sort]').length") == 1
    press(browser, "PSNR")
    assert column(browser, "PSNR")[0] == f"{expected[0]:.2f}"


def test_images_load_and_grow(browser):
    pictures = browser.run(
        f"""for (const image of document.images) image.loading = "eager";
        await Promise.all([...document.images].map((image) => image.decode()));
        const widths = (row) => [...row.querySelectorAll("img")].map((image) => image.naturalWidth);
        return {TABLE}.map(widths);"""
    )
    assert [len(row) for row in pictures] == [5] * 5 + [0] and min(
        min(row) for row in pictures[:5]
    ) > 60
    assert "the 5 worst of them" in browser.run(
        "return document.getElementById('shown').textContent"
    )
    browser.run(f"{TABLE}[0].querySelectorAll('img')[3].click()")
    large = (
        "return [document.getElementById('large').hidden, document.querySelectorAll('#large"
        " img').length]"
    )
    assert browser.run(large) == [False, 3]
    browser.run("document.dispatchEvent(new KeyboardEvent('keydown', { key: 'Escape' }))")
    assert browser.run(large)[0] is True


def test_one_person_alone_and_means_with_intervals(browser, found):
    browser.run(
        "const s = document.getElementById('person'); s.value = 'ann'; s.dispatchEvent(new"
        " Event('change'))"
    )
    assert column(browser, "person") == ["ann"] * 3
    browser.run(
        "const s = document.getElementById('person'); s.value = ''; s.dispatchEvent(new"
        " Event('change'))"
    )
    assert len(column(browser, "person")) == 6
    means = browser.run("return document.getElementById('means').innerText")
    psnr = found.means["psnr"]
    assert f"{psnr.mean:.2f}" in means and f"{psnr.low:.2f} to {psnr.high:.2f}" in means
    notes = browser.run("return document.getElementById('notes').innerText")
    assert "no weights of LPIPS vgg" in notes and "no alpha channel" in notes
    assert browser.run("return document.querySelectorAll('#people tbody tr').length") == 2


def test_the_page_asks_for_nothing(browser):
    assert (
        browser.run(
            "return performance.getEntriesByType('resource').filter((e) =>"
            " !e.name.startsWith('data:')).length"
        )
        == 0
    )
    with pytest.raises(RuntimeError, match="fetch"):
        browser.run("await fetch('http://127.0.0.1:1/')")
    assert len(browser.problems()) > 0  # the browser's own protest
