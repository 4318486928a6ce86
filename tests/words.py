"""Count words that make a text hard to read, in packages, docs and README; part of `make check`.

The numbers in `ALLOWED` are what is there today. They only go down.

    python tests/words.py            # exit code 1 if there are more than allowed
    python tests/words.py --list     # each of them, with file and line
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

ODD = re.compile(
    r"\b(?:whoever|whomever|somebody|nobody|himself|herself|anew|thereby|wherefore|as ever|(?:is|are) told"
    r"|(?<!those )who (?:has|is|are|was|were|does|do|did|may|might|can|could|will|would|must|reads?|writes?|waits?"
    r"|follows?|keeps?|asks?|takes?|holds?|listens?|publish(?:es)?|calls?|wants?|needs?|looks?|says?|gets?|makes?"
    r"|changes?|collects?|hears?|uses?|leaves?|counts?|tries|knows?|stores?))\b",
    re.IGNORECASE,
)

PLACES = {
    "packages": ("reem/**/*.py", "reem_async/**/*.py", "reem_async/**/*.js", "reem_async/**/*.html"),
    "docs": ("docs/**/*.md", "README.md", "CONTRIBUTING.md", "SECURITY.md"),
}
LABORATORY = ROOT / "docs" / "lab"  # notes of past runs: kept as they were written
ALLOWED = {"packages": 16, "docs": 0}


def found(place: str) -> list[str]:
    """Each odd word, as `file:line: word`."""
    hits = []
    for pattern in PLACES[place]:
        for path in sorted(ROOT.glob(pattern)):
            if LABORATORY in path.parents or "generated" in path.parts:
                continue
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                hits += [f"{path.relative_to(ROOT)}:{number}: {match[0]}" for match in ODD.finditer(line)]
    return hits


def main() -> None:
    """Print the counts, and fail if one is higher than it was."""
    hits = {place: found(place) for place in PLACES}
    if "--list" in sys.argv:
        print("\n".join(line for lines in hits.values() for line in lines))
    failed = False
    for place, lines in hits.items():
        print(f"odd words in {place}: {len(lines)}, allowed {ALLOWED[place]}")
        if len(lines) > ALLOWED[place]:
            failed = True
            files = Counter(line.partition(":")[0] for line in lines)
            print("  most in " + ", ".join(f"{file} ({count})" for file, count in files.most_common(5)))
    if failed:
        sys.exit("more odd words than before: rewrite the new ones (python tests/words.py --list shows all)")


if __name__ == "__main__":
    main()
