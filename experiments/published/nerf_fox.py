"""nerf_fox as it stands: 50 frames of a phone's video, every eighth held out.

python experiments/published/nerf_fox.py SCENE --out DIR [--methods robust 3dgs] [--steps 7000]

No paper prints a figure for it; the rows say where we are. One at a time, resumable.
"""

from __future__ import annotations

from typing import Any

from published_rows import Key, fitted, measure, of_fit, options

METHODS = ("robust", "3dgs")


def main() -> None:
    args = options(__doc__, "fox", METHODS, (7_000,)).parse_args()

    def row(key: Key) -> dict[str, Any]:
        said = ("--preset", key.method, "--steps", str(key.steps))
        run = args.out / f"{key.method}_{key.steps}"
        fit = fitted(args.scenes[0], run, said, args.again)
        test = fit.metrics["test"]
        figures = {
            "psnr": test["averaged"]["psnr"],
            "psnr_exposure_fitted": test["exposure_fitted"]["psnr"],
        }
        if "photometry_fitted" in test:
            figures["psnr_photometry_fitted"] = test["photometry_fitted"]["psnr"]
        return {"figures": figures, **of_fit(fit, f"p2gs-jax fit FOX {' '.join(said)}")}

    wanted = [Key("nerf_fox", "fox", m, s) for s in args.steps for m in args.methods]
    measure(wanted, row, args.again)


if __name__ == "__main__":
    main()
