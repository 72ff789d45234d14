"""`left_out.npz`: what every look of a run left out of the steps that followed it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from p2gs_jax.core.atomic import BROKEN_ARRAYS, atomic_write
from p2gs_jax.core.processes import is_first
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.unexplained import Unexplained

Masks = dict[int, Unexplained]


class LeftOutFile:
    """The looks of a run, by the step after which they were.

    Checkpoints hold none of this: a run that is resumed from one reads here what was left out. Of
    several processes the first writes the file.

    Args:
        path: of the file; there is none before the first look.
    """

    def __init__(self, path: Path):
        self._path = path

    def keep_until(self, step: int) -> None:
        """Forget the looks after a step, which a resumed run takes again.

        Raises:
            UserError: the file cannot be read.
        """
        if not is_first() or not self._path.exists():
            return
        if step == 0:
            self._path.unlink()
            return
        looks = self._looks()
        if any(at > step for at in looks):
            self._write({at: look for at, look in looks.items() if at <= step})

    def write(self, step: int, found: Mapping[int, Unexplained], whole: int) -> None:
        """Add a look.

        Args:
            step: after which it was.
            found: by training view.
            whole: views that stay whole because too much of them would be left out.
        """
        if not is_first():
            return
        looks = self._looks() if self._path.exists() else {}
        self._write({**looks, step: (dict(found), whole)})

    def read(self, step: int) -> tuple[Masks, int]:
        """Return a look: what was left out by training view, and how many views stay whole.

        Raises:
            UserError: it cannot be read.
        """
        looks = self._looks()
        if step not in looks:
            raise self._broken(f"it has no look after step {step}")
        return looks[step]

    def _looks(self) -> dict[int, tuple[Masks, int]]:
        try:
            with np.load(self._path, allow_pickle=False) as stored:
                looks: dict[int, tuple[Masks, int]] = {}
                for step in stored["steps"].tolist():
                    shares = stored[f"{step}/shares"].tolist()
                    rows = stored[f"{step}/rows"].tolist()
                    masks = [stored[f"{step}/{row}"] for row in rows]
                    found = zip(rows, masks, shares, strict=True)
                    looks[step] = (
                        {row: Unexplained(mask, share) for row, mask, share in found},
                        int(stored[f"{step}/whole"]),
                    )
                return looks
        except BROKEN_ARRAYS as error:
            raise self._broken(str(error) or type(error).__name__) from error

    def _write(self, looks: Mapping[int, tuple[Mapping[int, Unexplained], int]]) -> None:
        arrays: dict[str, np.ndarray] = {"steps": np.array(sorted(looks), int)}
        for step, (found, whole) in looks.items():
            rows = sorted(found)
            arrays[f"{step}/rows"] = np.array(rows, int)
            arrays[f"{step}/shares"] = np.array([found[row].share for row in rows])
            arrays[f"{step}/whole"] = np.array(whole)
            arrays |= {f"{step}/{row}": found[row].mask for row in rows}
        with atomic_write(self._path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]

    def _broken(self, reason: str) -> UserError:
        return UserError(
            f"{self._path} says what the run leaves out, and cannot be read ({reason}).",
            fix="put the file back, or start again without --resume",
        )
