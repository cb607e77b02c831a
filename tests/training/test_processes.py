"""Several processes: half of what tells them apart is an error. Real ones: test_resume.py."""

import pytest

from humangs_jax.training.processes import join_processes


@pytest.mark.parametrize("given", [("localhost:1234", None, None), ("localhost:1234", 2, None), (None, 2, 0)])
def test_half_of_an_address_is_refused(given):
    with pytest.raises(ValueError, match="give coordinator, number of processes and process index, or none"):
        join_processes(*given)
