"""Each deliberate fault, planted in a copy of the package, fails the test that has to notice it."""

import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FAILED = 1  # pytest: tests were collected and run, and some failed
ORACLE = "render/test_rasterize.py::test_values_and_gradients_match_oracle"
TONE_MAP = "properties/test_pir.py::test_the_tone_map_is_inverted_by_its_inverse"

# A file in p2gs_jax and the test below tests/ that has to notice the fault, the right code, which
# occurs there once, and the wrong code.
FAULTS = {
    "the covariance loses its slant": (
        *("render/project.py", "render/test_project.py"),
        "s_xy = sum(V[0][axis] * V[1][axis] for axis in range(3))",
        "s_xy = 0.0 * sum(V[0][axis] * V[1][axis] for axis in range(3))",
    ),
    "pixel centres lie at integers": (
        *("render/tiles.py", ORACLE),
        "x = jnp.arange(width) + 0.5",
        "x = jnp.arange(width) + 0.0",
    ),
    "the backward pass forgets the light behind": (
        *("render/rasterize_xla.py", ORACLE),
        "q_grouped - after * (grouped / (1 - grouped))",
        "q_grouped",
    ),
    "a segment begins with all the light of its tile": (
        *("render/rasterize_xla.py", ORACLE),
        "extra_light = light[extra_tiles] - sum(",
        "extra_light = light[extra_tiles] - 0 * sum(",
    ),
    "tile lists lose their last entry": (
        *("render/rasterize_xla.py", ORACLE),
        "entry < end[:, None], ids_list",
        "entry < end[:, None] - 1, ids_list",
    ),
    "one function of the harmonics has the other sign": (
        *("render/harmonics.py", "render/test_project.py"),
        "values += [-C1 * y, C1 * z, -C1 * x]",
        "values += [-C1 * y, C1 * z, C1 * x]",
    ),
    "the view list leaves out what touches the left edge": (
        *("render/visible.py", "render/test_visible.py"),
        "(at + radius < 0)",
        "(at - radius < 0)",
    ),
    "a list that is too long is cut in silence": (
        *("render/visible.py", "render/test_visible.py"),
        "return count + lax.dynamic_slice(seen, (i,), (1,))[0].astype(jnp.int32), ids",
        "return at + lax.dynamic_slice(seen, (i,), (1,))[0].astype(jnp.int32), ids",
    ),
    "gamma works the wrong way round": (
        *("photometry/formation.py", TONE_MAP),
        "log_linear = log_pivot + (log_x - log_pivot) * (GAMMA_SRGB / gamma)",
        "log_linear = log_pivot + (log_x - log_pivot) * (gamma / GAMMA_SRGB)",
    ),
    "sRGB without its toe": (
        *("photometry/formation.py", TONE_MAP),
        "toe = log_linear <= float(np.log(SRGB_LINEAR_END))",
        "toe = log_linear <= -1e9",
    ),
    "recentring moves exposures but not radiance": (
        "photometry/parameters.py",
        "photometry/test_formation.py::test_recentring_keeps_photographs_and_removes_the_mean",
        "log_scale + tint, activation)",
        "0.0 * (log_scale + tint), activation)",
    ),
    "saturated pixels count as observations of radiance": (
        "photometry/observations.py",
        "photometry/test_adjustment.py::test_saturation_must_be_masked",
        "(self.colors > black) & (brightest < saturation)",
        "(self.colors > black) & (brightest < 2 + saturation)",
    ),
    "a mean counts where one of its pixels is saturated": (
        "photometry/observations.py",
        "gaussians/test_sampling.py::test_exposures_are_right_where_a_surface_has_highlights",
        "brightest = self.colors if self.brightest is None else self.brightest",
        "brightest = self.colors",
    ),
    "an exposure ratio is turned over": (
        "train/exposure_loss.py",
        "properties/test_pir.py::test_the_loss_of_observed_colours_is_0_at_the_true_exposures",
        "photometry.capture(pairs.views_i), photometry.capture(pairs.views_j)",
        "photometry.capture(pairs.views_j), photometry.capture(pairs.views_i)",
    ),
    "over-bright predictions of saturated pixels are punished": (
        "train/terms.py",
        "train/test_image_loss.py::test_a_saturated_photograph_is_a_lower_bound",
        "agrees = (target >= saturation) & (ldr >= saturation)",
        "agrees = (target >= saturation) & (ldr >= saturation + 1e9)",
    ),
    "SSIM's gradient forgets that the variance of the sum moves": (
        "evaluation/ssim.py",
        "train/test_image_loss.py::test_gradient_matches_autodiff_and_finite_differences",
        "back[0] + 2 * p.d * back[1] + 2 * p.s * back[2]",
        "back[0] + 2 * p.d * back[1]",
    ),
    "masked pixels pull": (
        *("train/terms.py", "properties/test_pir.py::test_masked_pixels_get_no_gradient"),
        "return weight * jnp.sum(absolute * mask[..., None]) / valid",
        "return weight * jnp.sum(jnp.abs(ldr - target)) / valid",
    ),
    "the scale prior of the printed loss has another mean": (
        "train/terms.py",
        "properties/test_pir.py::test_the_scale_of_the_paper_s_regularisers_has_a_closed_form",
        '"exposure_scale": lambda p: jnp.mean((p.exposures - 1) ** 2)',
        '"exposure_scale": lambda p: jnp.mean((p.exposures - 2) ** 2)',
    ),
}


@pytest.mark.parametrize(("file", "caught_by", "right", "wrong"), FAULTS.values(), ids=FAULTS)
def test_the_fault_fits_the_code(file, caught_by, right, wrong):
    assert (ROOT / "p2gs_jax" / file).read_text(encoding="utf-8").count(right) == 1
    name, _, test = caught_by.partition("::")
    text = (ROOT / "tests" / name).read_text(encoding="utf-8")
    assert not test or f"def {test}(" in text


@pytest.mark.slow
@pytest.mark.parametrize(("file", "caught_by", "right", "wrong"), FAULTS.values(), ids=FAULTS)
def test_the_fault_is_noticed(file, caught_by, right, wrong, tmp_path, python):
    for name in ("p2gs_jax", "tests"):
        shutil.copytree(ROOT / name, tmp_path / name)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    path = tmp_path / "p2gs_jax" / file
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(right, wrong), encoding="utf-8")
    argv = ("-m", "pytest", "-q", "-x", "-n", "0", f"tests/{caught_by}")
    # With any other status pytest itself could not run.
    python(*argv, status=FAILED, cwd=tmp_path, PYTHONPATH=str(tmp_path))
