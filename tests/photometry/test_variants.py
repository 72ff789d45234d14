"""Formation, its inverse and the loss on pictures: the same numbers jitted and not."""

import chex
import jax
import numpy as np

from p2gs_jax.config import LossConfig, PhotometryConfig
from p2gs_jax.photometry.formation import formation, inverse_formation
from p2gs_jax.train.terms import photometric_loss
from p2gs_jax.types import Capture

CFG = PhotometryConfig()
RNG = np.random.default_rng(0)
LINEAR = np.exp2(RNG.uniform(-6, -1, (24, 16, 3))).astype(np.float32)


class Variants(chex.TestCase):
    @chex.variants(with_jit=True, without_jit=True)
    def test_an_inverse_takes_formation_back(self):
        @self.variant
        def there_and_back(linear, exposure, gamma):
            taken = Capture(exposure, gamma)
            return inverse_formation(formation(linear, taken, CFG), taken, CFG)

        found = there_and_back(LINEAR, np.float32(1.3), np.float32(2.0))
        np.testing.assert_allclose(found, LINEAR, rtol=2e-4)

    @chex.variants(with_jit=True, without_jit=True)
    def test_terms_of_the_loss(self):
        photograph = np.clip(LINEAR * 1.5, 0, 1)
        mask = np.ones(LINEAR.shape[:2], np.float32)

        @self.variant
        def terms(picture):
            return photometric_loss(picture, photograph, mask, LossConfig())

        expected = jax.jit(lambda p: photometric_loss(p, photograph, mask, LossConfig()))(LINEAR)
        found = terms(LINEAR)
        chex.assert_tree_all_finite(found)
        chex.assert_trees_all_close(found, expected, rtol=1e-5)
