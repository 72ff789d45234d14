"""NeRF-synthetic lego as 3DGS published it: white background, 7,000 and 30,000 steps.

python experiments/published/lego.py SCENE --out DIR [--methods 3dgs robust] [--steps 7000 30000]

One row at a time; called again, it goes on where it was interrupted. PSNR of the held-out views as
they are, without any exposure fitted, as published. The pictures of this scene are not for this
project: keep --out outside of it.
"""

from __future__ import annotations

from typing import Any

from published_rows import Key, fitted, measure, of_fit, options

BLUR = ("--render.blur", "0.3")
# Of each method its options; `3dgs` and `robust` densify by `mcmc`.
METHODS = {
    "3dgs_published": ("--preset", "3dgs_published"),
    "3dgs": ("--preset", "3dgs"),
    "robust": ("--preset", "robust"),
    "3dgs, blur of 3DGS": ("--preset", "3dgs", *BLUR),
    "robust, blur of 3DGS": ("--preset", "robust", *BLUR),
    "3dgs, adaptive, blur of 3DGS": ("--preset", "3dgs", "--densify.method", "adaptive", *BLUR),
}
STEPS = (7_000, 30_000)


def main() -> None:
    args = options(__doc__, "lego", METHODS, STEPS).parse_args()

    def row(key: Key) -> dict[str, Any]:
        said = (*METHODS[key.method], "--steps", str(key.steps), "--background", "white")
        name = f"{key.method.replace(', ', '_').replace(' ', '_')}_{key.steps}"
        fit = fitted(args.scenes[0], args.out / name, said, args.again)
        test = fit.metrics["test"]["averaged"]
        figures = {k: test[k] for k in ("psnr", "ssim", "lpips") if k in test}
        return {"figures": figures, **of_fit(fit, f"p2gs-jax fit LEGO {' '.join(said)}")}

    measure([Key("lego", "lego", m, s) for s in args.steps for m in args.methods], row, args.again)


if __name__ == "__main__":
    main()
