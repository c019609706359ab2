"""Put the figures of a campaign into docs/evidence.md.

truecell verify --cells 5000 --json | python docs/coverage_table.py

The process fails when a figure misses what docs/evidence.md demands of it.
"""

import json
import sys
from pathlib import Path
from typing import Any, Final

EVIDENCE: Final = Path(__file__).with_name("evidence.md")
START: Final = "<!-- coverage: written by docs/coverage_table.py -->"
END: Final = "<!-- end of coverage -->"
HEADINGS: Final = (
    "Estimate",
    "m",
    "Cells",
    "Refused",
    "Inside the 95 % region",
    "Proven of it (95 %)",
    "Mean NEES / m",
    "Honest (99.9 %)",
    "Accepted",
)


def main() -> None:
    """Read JSON from standard input, write the table between its marks."""
    campaign = json.load(sys.stdin)
    estimates = campaign["estimates"]
    lines = [
        f"Seeds {campaign['seed']} to {campaign['seed'] + estimates[0]['cells'] - 1}:",
        "",
        "| " + " | ".join(HEADINGS) + " |",
        "| --- " * len(HEADINGS) + "|",
        *("| " + " | ".join(_row(each)) + " |" for each in estimates),
    ]
    text = EVIDENCE.read_text()
    before, rest = text.split(START)
    after = rest.split(END)[1]
    EVIDENCE.write_text("\n".join([before + START, *lines, END + after]))
    print("\n".join(lines))
    sys.exit(not all(each["accepted"] for each in estimates))


def _row(each: dict[str, Any]) -> list[str]:
    low, high = each["share_bounds_95"]
    least, most = each["band_999"]
    return [
        each["estimate"],
        str(each["freedoms"]),
        str(each["cells"]),
        str(each["refused"]),
        f"{each['inside']} ({each['share']:.2%})",
        f"{low:.2%} to {high:.2%}",
        f"{each['mean_nees_over_m']:.3f}",
        f"{least:.3f} to {most:.3f}",
        "yes" if each["accepted"] else "no",
    ]


if __name__ == "__main__":
    main()
