"""docs/knobs.md agrees with the code."""

import re

from experiments.knobs import PAGE, REPOSITORY, page


def test_the_page_of_knobs_is_up_to_date():
    assert page() == PAGE.read_text(), "run `python -m experiments knobs`"


def test_its_links_lead_somewhere():
    for link in set(re.findall(r"\]\(([^)]+)\)", page())):
        assert (REPOSITORY / "docs" / link).is_file(), link
