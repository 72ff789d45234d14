"""`--scene`, which all commands on finished runs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

SceneFolder = Annotated[Path | None, tyro.conf.arg(metavar="DIR")]
