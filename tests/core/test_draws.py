import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from humangs_jax.core.draws import normal_of, uniform_by_name


def test_numbers_have_the_shapes_of_their_names_and_none_occurs_twice():
    numbers = uniform_by_name(jax.random.key(0), {"one": (), "some": (3, 2), "none": (0,)})
    assert {name: x.shape for name, x in numbers.items()} == {
        "one": (),
        "some": (3, 2),
        "none": (0,),
    }
    every = np.concatenate([np.ravel(x) for x in numbers.values()])
    assert len(set(every.tolist())) == 7 and every.min() >= 0 and every.max() < 1


def test_normal_numbers_are_the_quantiles_of_uniform_ones_and_finite_at_zero():
    uniform = jnp.asarray([0.0, 1e-6, 0.1, 0.5, 0.9, 1 - 2**-24], jnp.float32)
    found = np.asarray(normal_of(uniform))
    exact = stats.norm.ppf(np.asarray(uniform, np.float64))
    # 2 u - 1 has steps of 6e-8, which is a share of the tail
    np.testing.assert_allclose(found[1:], exact[1:], rtol=0.02, atol=1e-6)
    assert np.isfinite(found[0]) and found[0] < -5
