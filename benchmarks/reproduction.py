"""Make docs/reproduction.md and its two charts from the results in benchmarks/results.

python benchmarks/reproduction.py
"""

from __future__ import annotations

from pathlib import Path

from cuspid_thesis.judging import judge
from cuspid_thesis.page import GENERATED, make_page
from cuspid_thesis.page_format import markdown
from cuspid_thesis.pictures import LIKENESS, TRUENESS, draw_likeness, draw_trueness
from cuspid_thesis.runs import read_results

HERE = Path(__file__).parent


def main() -> None:
    """Read the results, write the page and the charts."""
    docs, results = HERE.parent / "docs", read_results(HERE / "results")
    draw_trueness(docs / "images" / TRUENESS, results)
    draw_likeness(docs / "images" / LIKENESS, results)
    pictures = {path.name for path in (docs / "images").iterdir()}
    page = make_page(judge(results), results, pictures=pictures, origin=GENERATED)
    (docs / "reproduction.md").write_text(markdown(page))


if __name__ == "__main__":
    main()
