"""Tables that more than one command prints."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table

from p2gs_jax.core.progress import PlainConsole

# Parts of a fit, as metrics.json has them under "seconds", and what they are called in print.
PARTS = {
    "starting": "starting",
    "reading": "reading",
    "structure_from_motion": "structure from motion",
    "photometry": "photometry",
    "seeds": "seeds",
    "compiling": "waiting for the compiler",
    "steps": "steps",
    "densification": "densification",
    "looking": "looking for what moves",
    "checkpoints": "checkpoints",
    "evaluation": "evaluation",
    "files": "files",
}


def stdout() -> Console:
    """Return where results go; progress and messages go to stderr."""
    return PlainConsole()


def print_metrics(metrics: dict, out: Path) -> None:
    """Print the scores of a run as a table."""
    console = stdout()
    table = Table(title="How well it fits", title_justify="left")
    for name in ("views", "protocol", "PSNR dB", "SSIM", "LPIPS"):
        table.add_column(name, justify="left" if name in ("views", "protocol") else "right")

    def row(views: str, protocol: str, part: dict | None) -> None:
        if part and "psnr" in part:
            lpips = f"{part['lpips']:.4f}" if "lpips" in part else "n/a"
            table.add_row(views, protocol, f"{part['psnr']:.2f}", f"{part['ssim']:.4f}", lpips)

    row("training", "own exposure and gamma", metrics["train"])
    row("training", "mean parameters", metrics["train"]["averaged"])
    row("held out", "mean parameters", metrics["test"]["averaged"])
    row("held out", "exposure fitted to each photograph", metrics["test"]["exposure_fitted"])
    everything = metrics["test"].get("photometry_fitted")
    row("held out", "all that varies per view fitted to each photograph", everything)
    row("held out", "metered, as the camera would", metrics["test"].get("metered"))
    for name, part in metrics.get("reference", {}).items():
        row("all", f"reference photographs, {name.replace('_', ' ')}", part)
        row("held out", f"reference photographs, {name.replace('_', ' ')}", part["test"])
    console.print(table)
    hdr = metrics.get("radiance")
    if hdr:
        mu_law = f"; mu-law PSNR {hdr['mu_law_psnr']:.2f} dB" if "mu_law_psnr" in hdr else ""
        console.print(
            f"Radiance against HDR truth: {hdr['stops_median']:.3f} stops median, "
            f"{hdr['stops_rms']:.3f} RMS; PU21 {hdr['pu21_psnr']:.2f} dB / {hdr['pu21_ssim']:.4f}; "
            f"colour difference {hdr['delta_e_itp']:.1f} Delta E ITP{mu_law}."
        )
    counts = metrics.get("counts", {})
    if counts:
        console.print(
            f"{counts['gaussians']} Gaussians, {counts['steps']} steps, "
            f"{1e3 * metrics['seconds_per_step']:.0f} ms a step."
        )
    seconds = {k: v for k, v in metrics.get("seconds", {}).items() if k in PARTS and v >= 0.5}
    if seconds:
        spent = ", ".join(f"{PARTS[k]} {v:.0f}" for k, v in seconds.items())
        programs = f" ({counts['programs']} programs)" if "programs" in counts else ""
        console.print(f"Seconds: {spent}{programs}.")
    console.print(f"Results: {out} (open {out / 'summary.png'} first)")
