"""The terms of a fit that compare a render with its photograph (paper, eq. 8)."""

from p2gs_jax.config import FitConfig
from p2gs_jax.train.terms import Rendered, Target, censor, loss_terms


def photometric_loss(ldr, target, mask, cfg):
    """Return the weighted terms `l1` and `dssim` by name, as `compared` and a fit compute them."""
    judged = censor(ldr, target, cfg.saturation) if cfg.censored else ldr
    views = Rendered(None, None, None, ldr, judged, None), Target(target, mask, None, None)
    terms = loss_terms(FitConfig(loss=cfg))
    return {name: terms[name](*views, None) for name in ("l1", "dssim") if name in terms}
