from hypothesis import given
from hypothesis import strategies as st

from humangs_jax.rendering.splatting import round_up


@given(st.integers(0, 10**9))
def test_capacities_are_few_sufficient_and_not_wasteful(size):
    capacity = round_up(size)
    assert capacity >= max(size, 64) and (size <= 64 or 4 * capacity <= 5 * size + 4)
    while capacity % 2 == 0:
        capacity //= 2
    assert capacity in (1, 3, 5, 7)
    assert round_up(size) <= round_up(size + 1)
