"""What files of arrays end in where they are broken."""

from __future__ import annotations

import struct
import zipfile
import zlib

# Whatever numpy, zipfile and zlib run into in .npy and .npz of any bytes.
BROKEN_ARRAYS = (
    *(OSError, ValueError, KeyError, TypeError, IndexError, EOFError, MemoryError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)
