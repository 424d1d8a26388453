"""One word for one thing: words that the project has left behind come back nowhere that a user or developer reads."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
READ = ("impact_posture", "cli", "robots", "docs", "README.md")
SUFFIXES = {".py", ".md", ".toml", ".c", ".h", ".cpp", ".hpp", ".txt", ".rst"}
# What is left behind, and the word for it.
LEFT = {
    r"blows?": "impact",
    r"mends?": "hint",
    r"workshops?": "controller factory",
    r"twins?": "repeated limbs",
    r"in_a_copy|shared_out": "fork_call, fork_map",
    r"OneBlow|BoxOfImpulses|FewModels|InnerMaximum": "ImpactKind, ImpulseBox, ModelSet, WorstCase",
    r"ImpactScenario": "Scenario",
    r"Footing": "ContactStability, StanceGains",
}


def texts() -> Iterator[tuple[Path, str]]:
    for name in READ:
        place = ROOT / name
        for path in [place] if place.is_file() else sorted(place.rglob("*")):
            parts = path.relative_to(ROOT).parts
            if path.suffix in SUFFIXES and not {"generated", "_build", "__pycache__"} & set(parts):
                yield path, path.read_text(encoding="utf-8")


@pytest.mark.skipif(not (ROOT / "docs").is_dir(), reason="not in a checkout")
@pytest.mark.parametrize("word", LEFT)
def test_words_that_are_left_behind(word: str) -> None:
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path, text in texts()
        for number, line in enumerate(text.splitlines(), start=1)
        if re.search(rf"\b({word})\b", line)
    ]
    assert not found, f"say '{LEFT[word]}': " + "\n".join(found)


def test_the_glossary_is_sorted_and_says_each_word_once() -> None:
    page = ROOT / "docs" / "glossary.md"
    words = re.findall(r"^\| ([^|]+?) \|", page.read_text(encoding="utf-8"), re.MULTILINE)[1:]
    assert words == sorted(set(words), key=str.lower) and len(words) > 30
    assert not [word for word in words for left in LEFT if re.fullmatch(left, word)]
