"""Families of trials that the program has to survive, with a dated record.

python experiments/reliability/run.py [--quick] [--only FAMILY...] [--out DIR]

A family is a module `families/NAME.py` with

    NAME    its name, as the module's
    ABOUT   the trials, and when a trial counts as survived, in one or two sentences
    run     run(quick: bool, out: Path, report: Callable[[str], None]) -> Family

`out` is an empty folder of its own; `Family` is in `family.py`. Trials follow from a fixed seed, so
that a second run tries the same. A module whose name begins with `_` holds what families share.

`YYYY-MM-DD.json` beside this file holds one entry a family, with the commit it was measured at. The
program ends with 1 where a trial failed.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import importlib
import json
import shutil
import sys
import tempfile
import time
import traceback
from dataclasses import replace
from pathlib import Path
from types import ModuleType

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from checkout import commit
from reliability.family import COMMAND, Failure, Family

from p2gs_jax.core.atomic import write_json

HERE = Path(__file__).resolve().parent


def families() -> dict[str, ModuleType]:
    """Return the modules of all families by name."""
    names = sorted(p.stem for p in (HERE / "families").glob("[!_]*.py"))
    return {name: importlib.import_module(f"reliability.families.{name}") for name in names}


def main(argv: list[str] | None = None) -> int:
    """Run families; return 1 where a trial failed."""
    known = families()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a part of every family, minutes")
    parser.add_argument("--only", nargs="+", choices=known, metavar="FAMILY", help=", ".join(known))
    parser.add_argument("--out", type=Path, help="keep here what the trials leave behind")
    args = parser.parse_args(argv)
    scratch = args.out or Path(tempfile.mkdtemp(prefix="reliability-"))
    failed = 0
    try:
        for name in args.only or known:
            found = one(known[name], args.quick, scratch / name)
            failed += len(found.failures)
            record(found, args.quick)
            print(f"{name}: {found.survived} of {found.tried} survived, {found.seconds:.0f} s")
            for failure in found.failures:
                print(f"  {failure.name}: {failure.reason}")
    finally:
        if args.out is None:
            shutil.rmtree(scratch, ignore_errors=True)
    return 1 if failed else 0


def one(module: ModuleType, quick: bool, out: Path) -> Family:
    """Run a family; one that breaks down itself is a failure."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    start = time.perf_counter()
    try:
        found = module.run(quick, out, lambda line: print(line, file=sys.stderr))
    except Exception as error:
        traceback.print_exc()
        reason = f"{type(error).__name__}: {error}"
        found = Family(module.NAME, 0, 0, (Failure("the family itself", reason),))
    return replace(
        found,
        command=f"{COMMAND} {module.NAME}",
        seconds=time.perf_counter() - start,
    )


def record(found: Family, quick: bool) -> None:
    """Add the results of a family to the record of today (UTC); a part never replaces the whole."""
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    path = HERE / f"{date}.json"
    entries = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    known = {entry["family"]["name"]: entry for entry in entries}
    if quick and not known.get(found.name, {"quick": True})["quick"]:
        return
    known[found.name] = {
        "family": dataclasses.asdict(found),
        "date": date,
        "commit": commit(),
        "quick": quick,
    }
    write_json(path, [known[name] for name in sorted(known)])


if __name__ == "__main__":
    sys.exit(main())
