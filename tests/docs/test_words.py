"""Plain words: old names must not return, and hard phrases stay rare."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CODE = ("impact_posture", "cli")
READ = (*CODE, "robots", "docs", "README.md", "CHANGELOG.md")
SUFFIXES = {".py", ".md", ".toml", ".c", ".h", ".cpp", ".hpp", ".txt", ".jinja"}
# Old names and the names that replace them.
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
# Hard phrases, the files in which they are counted, and the largest permitted number of lines with them.
RARE = {r"found": (CODE, 100), r"that of|those of|is no \w+": (READ, 60)}
pytestmark = pytest.mark.skipif(not (ROOT / "docs").is_dir(), reason="not in a checkout")


def texts(names: Iterable[str]) -> Iterator[tuple[Path, str]]:
    for name in names:
        place = ROOT / name
        for path in [place] if place.is_file() else sorted(place.rglob("*")):
            parts = path.relative_to(ROOT).parts
            if path.suffix in SUFFIXES and not {"generated", "_build", "__pycache__"} & set(parts):
                yield path, path.read_text(encoding="utf-8")


def lines_with(words: str, names: Iterable[str], flags: int = 0) -> list[str]:
    pattern = re.compile(rf"\b({words})\b", flags)
    return [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path, text in texts(names)
        for number, line in enumerate(text.splitlines(), start=1)
        if pattern.search(line)
    ]


@pytest.mark.parametrize("word", LEFT)
def test_old_names_do_not_come_back(word: str) -> None:
    # The changelog may contain old names, because it lists renamed items.
    lines = lines_with(word, [name for name in READ if name != "CHANGELOG.md"])
    assert not lines, f"say '{LEFT[word]}': " + "\n".join(lines)


@pytest.mark.parametrize("words", RARE)
def test_phrases_that_are_hard_to_read_are_rare(words: str) -> None:
    names, most = RARE[words]
    lines = lines_with(words, names, re.IGNORECASE)
    assert len(lines) <= most, "\n".join([f"{len(lines)} lines with '{words}', at most {most}:", *lines])


def test_the_glossary_is_sorted_and_has_each_word_once() -> None:
    page = ROOT / "docs" / "glossary.md"
    words = re.findall(r"^\| ([^|]+?) \|", page.read_text(encoding="utf-8"), re.MULTILINE)[1:]
    assert words == sorted(set(words), key=str.lower) and len(words) > 30
    assert not [word for word in words for left in LEFT if re.fullmatch(left, word)]
