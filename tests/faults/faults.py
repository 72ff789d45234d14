"""Deliberate faults, each with the test that has to notice it (`pytest -m slow tests/faults`)."""

from __future__ import annotations

from typing import NamedTuple


class Fault(NamedTuple):
    """Correct code, and the wrong code that replaces it."""

    name: str  # what the fault does
    file: str  # inside p2gs_jax
    right: str  # the text, which occurs there once
    wrong: str  # what takes its place
    caught_by: str  # test to run, as pytest names it, below tests/


RASTERIZE = "render/test_rasterize.py"
ORACLE = f"{RASTERIZE}::test_values_and_gradients_match_oracle"

FAULTS = (
    Fault(
        "the covariance loses its slant",
        "render/project.py",
        "s_xy = sum(V[0][axis] * V[1][axis] for axis in range(3))",
        "s_xy = 0.0 * sum(V[0][axis] * V[1][axis] for axis in range(3))",
        "render/test_project.py",
    ),
    Fault(
        "pixel centres lie at integers",
        "render/tiles.py",
        "x = jnp.arange(width) + 0.5",
        "x = jnp.arange(width) + 0.0",
        ORACLE,
    ),
    Fault(
        "the backward pass forgets the light behind",
        "render/rasterize_xla.py",
        "q_grouped - after * (grouped / (1 - grouped))",
        "q_grouped",
        ORACLE,
    ),
    Fault(
        "a segment begins with all the light of its tile",
        "render/rasterize_xla.py",
        "extra_light = light[extra_tiles] - sum(",
        "extra_light = light[extra_tiles] - 0 * sum(",
        ORACLE,
    ),
    Fault(
        "tile lists lose their last entry",
        "render/rasterize_xla.py",
        "entry < end[:, None], ids_list",
        "entry < end[:, None] - 1, ids_list",
        ORACLE,
    ),
    Fault(
        "one function of the harmonics has the other sign",
        "render/harmonics.py",
        "values += [-C1 * y, C1 * z, -C1 * x]",
        "values += [-C1 * y, C1 * z, C1 * x]",
        "render/test_project.py",
    ),
    Fault(
        "the view list leaves out what touches the left edge",
        "render/visible.py",
        "(at + radius < 0)",
        "(at - radius < 0)",
        "render/test_visible.py",
    ),
    Fault(
        "a list that is too long is cut in silence",
        "render/visible.py",
        "return count + lax.dynamic_slice(seen, (i,), (1,))[0].astype(jnp.int32), ids",
        "return at + lax.dynamic_slice(seen, (i,), (1,))[0].astype(jnp.int32), ids",
        "render/test_visible.py",
    ),
    Fault(
        "gamma works the wrong way round",
        "photometry/formation.py",
        "log_linear = log_pivot + (log_x - log_pivot) * (GAMMA_SRGB / gamma)",
        "log_linear = log_pivot + (log_x - log_pivot) * (gamma / GAMMA_SRGB)",
        "properties/test_pir.py::test_the_tone_map_is_inverted_by_its_inverse",
    ),
    Fault(
        "sRGB without its toe",
        "photometry/formation.py",
        "toe = log_linear <= float(np.log(SRGB_LINEAR_END))",
        "toe = log_linear <= -1e9",
        "properties/test_pir.py::test_the_tone_map_is_inverted_by_its_inverse",
    ),
    Fault(
        "recentring moves exposures but not radiance",
        "photometry/parameters.py",
        "log_scale + tint, activation)",
        "0.0 * (log_scale + tint), activation)",
        "photometry/test_formation.py::test_recentring_keeps_photographs_and_removes_the_mean",
    ),
    Fault(
        "saturated pixels count as observations of radiance",
        "photometry/observations.py",
        "(self.colors > black) & (brightest < saturation)",
        "(self.colors > black) & (brightest < 2 + saturation)",
        "photometry/test_adjustment.py::test_saturation_must_be_masked",
    ),
    Fault(
        "a mean counts where one of its pixels is saturated",
        "photometry/observations.py",
        "brightest = self.colors if self.brightest is None else self.brightest",
        "brightest = self.colors",
        "gaussians/test_sampling.py::test_exposures_are_right_where_a_surface_has_highlights",
    ),
    Fault(
        "an exposure ratio is turned over",
        "train/exposure_loss.py",
        "photometry.capture(pairs.views_i), photometry.capture(pairs.views_j)",
        "photometry.capture(pairs.views_j), photometry.capture(pairs.views_i)",
        "properties/test_pir.py::test_the_loss_of_observed_colours_is_0_at_the_true_exposures",
    ),
    Fault(
        "over-bright predictions of saturated pixels are punished",
        "train/terms.py",
        "agrees = (target >= saturation) & (ldr >= saturation)",
        "agrees = (target >= saturation) & (ldr >= saturation + 1e9)",
        "train/test_image_loss.py::test_a_saturated_photograph_is_a_lower_bound",
    ),
    Fault(
        "SSIM's gradient forgets that the variance of the sum moves",
        "evaluation/ssim.py",
        "back[0] + 2 * p.d * back[1] + 2 * p.s * back[2]",
        "back[0] + 2 * p.d * back[1]",
        "train/test_image_loss.py::test_gradient_matches_autodiff_and_finite_differences",
    ),
    Fault(
        "masked pixels pull",
        "train/terms.py",
        "return weight * jnp.sum(absolute * mask[..., None]) / valid",
        "return weight * jnp.sum(jnp.abs(ldr - target)) / valid",
        "properties/test_pir.py::test_masked_pixels_get_no_gradient",
    ),
    Fault(
        "the scale prior of the printed loss has another mean",
        "train/terms.py",
        '"exposure_scale": lambda p: jnp.mean((p.exposures - 1) ** 2)',
        '"exposure_scale": lambda p: jnp.mean((p.exposures - 2) ** 2)',
        "properties/test_pir.py::test_the_scale_of_the_paper_s_regularisers_has_a_closed_form",
    ),
)
