"""Whom a handpiece of 12 mm (thickness and working distance) fits, with three studies of the mouth opening.

python benchmarks/mouth.py --out benchmarks/results/mouth.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import get_args

from run import conditions

from cuspid.anatomy.mouth import MouthOptions, Study, study_mouths

PEOPLE = 100_000
MOLARS = (6, 7)


def study(name: Study) -> dict[str, object]:
    """Gap and share at the molars."""
    loose, _ = study_mouths(MouthOptions(study=name, people=PEOPLE))
    strict, _ = study_mouths(MouthOptions(study=name, people=PEOPLE, vertical=True))
    return {
        sex: {
            str(position): {
                "gap_mm": {level: round(group.gap_mm[position][level], 2) for level in ("p5", "p50", "p95")},
                "fit_pct": round(group.fit_pct[position], 2),
                "fit_vertical_pct": round(strict.groups[sex].fit_pct[position], 2),
            }
            for position in MOLARS
        }
        for sex, group in loose.groups.items()
    }


def main() -> None:
    """Run the studies and write one JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/mouth.json"))
    options = parser.parse_args()
    needed = MouthOptions().total_mm
    result = {"needed_mm": needed, "people": PEOPLE, "studies": {name: study(name) for name in get_args(Study)}}
    options.out.write_text(json.dumps({**result, **conditions()}, indent=1) + "\n")


if __name__ == "__main__":
    main()
