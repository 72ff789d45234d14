"""Where things lie in a run folder; docs/files.md says what they hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from p2gs_jax.config import Appearance


@dataclass(frozen=True)
class RunFolder:
    """The paths of a run folder.

    Attributes:
        root: the folder itself.
    """

    root: Path

    @property
    def config(self) -> Path:
        """The options as they were asked for, and where the scene lies."""
        return self.root / "config.json"

    @property
    def decisions(self) -> Path:
        """What the scene decided, with reasons."""
        return self.root / "decisions.json"

    @property
    def log(self) -> Path:
        """A line for every burst of steps."""
        return self.root / "log.jsonl"

    @property
    def checkpoints(self) -> Path:
        """Folder of the states that a run resumes from."""
        return self.root / "checkpoints"

    @property
    def pixels(self) -> Path:
        """Folder of decoded photographs while a fit runs whose memory does not hold them."""
        return self.root / "cache" / "pixels"

    @property
    def radiance(self) -> Path:
        """The Gaussians, with linear radiance."""
        return self.root / "radiance.ply"

    @property
    def splats(self) -> Path:
        """The Gaussians, with display colours."""
        return self.root / "splats.ply"

    @property
    def objects(self) -> Path:
        """Which Gaussians belong to which moving object."""
        return self.root / "objects.npz"

    @property
    def photometry(self) -> Path:
        """Exposures, gammas, tone curve."""
        return self.root / "photometry.json"

    def appearance(self, kind: Appearance) -> Path:
        """Corrections that a baseline learns.

        Args:
            kind: which; PPISP's and Luminance-GS's parameters are not of views alone.
        """
        names = {"ppisp": "ppisp.json", "luminance": "luminance.json"}
        return self.root / names.get(kind, "appearance.npy")

    @property
    def metering(self) -> Path:
        """How exposures of new pictures are chosen, and what explains those of the photographs."""
        return self.root / "metering.json"

    @property
    def metrics(self) -> Path:
        """Scores, counts, seconds."""
        return self.root / "metrics.json"

    @property
    def against(self) -> Path:
        """Scores of other programs on the held-out views, beside the run's."""
        return self.root / "against.json"

    @property
    def summary(self) -> Path:
        """The picture to open first."""
        return self.root / "summary.png"

    @property
    def renders(self) -> Path:
        """Folder of the held-out views."""
        return self.root / "renders"

    @property
    def unexplained(self) -> Path:
        """Folder of photographs of a drive with what no static scene explains."""
        return self.root / "unexplained"
