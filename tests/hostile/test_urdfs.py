"""Damaged URDFs load or give a one-line error that names the file, within bounded time and memory.

``--hostile-full`` tries forty times as many files.
"""

from __future__ import annotations

import json
import random
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from impact_posture.output import plot
from tests.hostile.arena import SMALL, attack, strike
from tests.hostile.values import NUMBERS, TEXTS

PUSH = ("--frame", "tip", "--normal", "0", "0", "1")
COUNT = 8


def spoiled(rng: random.Random) -> bytes:
    """Return the URDF of the small robot with one to three random faults."""
    root = ET.fromstring(SMALL)
    for _ in range(rng.choice((1, 1, 2, 3))):
        rng.choice((remove, duplicate, set_attribute, set_number, rename, reconnect, move, add))(root, rng)
    text = ET.tostring(root).decode()
    if rng.random() < 0.15:
        at = rng.randrange(len(text))
        text = rng.choice(
            (text[:at], text[:at] + text[at + 5 :], text[:at] + "<" + text[at:], text[:at] + "\x00&#0;" + text[at:])
        )
    return text.encode(errors="replace")


def parents(root: ET.Element) -> list[tuple[ET.Element, ET.Element]]:
    return [(parent, child) for parent in root.iter() for child in parent]


def remove(root: ET.Element, rng: random.Random) -> None:
    if pairs := parents(root):
        parent, child = rng.choice(pairs)
        parent.remove(child)


def duplicate(root: ET.Element, rng: random.Random) -> None:
    if pairs := parents(root):
        parent, child = rng.choice(pairs)
        parent.append(child)


def with_attributes(root: ET.Element, rng: random.Random) -> ET.Element:
    return rng.choice([element for element in root.iter() if element.attrib] or [root])


def printable(texts: tuple[str, ...]) -> list[str]:
    """Return short random texts that can be part of an XML file."""
    return [
        text for text in texts if len(text) < 1000 and all(c >= " " and not "\ud800" <= c <= "\udfff" for c in text)
    ]


def set_attribute(root: ET.Element, rng: random.Random) -> None:
    element = with_attributes(root, rng)
    key = rng.choice([*element.attrib, "stranger"])
    element.set(key, rng.choice(printable(TEXTS)))


def set_number(root: ET.Element, rng: random.Random) -> None:
    element = with_attributes(root, rng)
    if not element.attrib:
        return
    key = rng.choice(sorted(element.attrib))
    words = element.get(key, "").split()
    k = rng.randrange(max(1, len(words)))
    words[k : k + 1] = [rng.choice(printable(NUMBERS))] * rng.choice((1, 1, 1, 3))
    element.set(key, " ".join(words))


def rename(root: ET.Element, rng: random.Random) -> None:
    tags = ("link", "joint", "inertial", "mass", "stranger", "mimic", "robot")
    rng.choice(list(root.iter())).tag = rng.choice(tags)


def reconnect(root: ET.Element, rng: random.Random) -> None:
    """Make cycles, two roots, a link with two parents, or a link that is its own parent."""
    ends = [end for end in root.iter() if end.tag in ("parent", "child")]
    if ends:
        rng.choice(ends).set("link", rng.choice(("world_link", "upper", "lower", "tip", "nowhere", "universe")))


def move(root: ET.Element, rng: random.Random) -> None:
    pairs = parents(root) or [(root, root)]
    (parent, child), (other, _) = rng.choice(pairs), rng.choice(pairs)
    if child is not root and other not in child.iter():
        parent.remove(child)
        other.append(child)


def add(root: ET.Element, rng: random.Random) -> None:
    text = rng.choice((
        '<link name="island"/>', '<link name="upper"/>', '<joint name="shoulder" type="revolute"/>',
        "<transmission/>",
        '<joint name="loose" type="floating"><parent link="tip"/><child link="extra"/></joint>', '<link name=""/>',
        '<joint name="wheel" type="continuous"><parent link="tip"/><child link="extra"/><axis xyz="0 0 0"/></joint>',
        '<joint name="m" type="revolute"><parent link="tip"/><child link="extra"/><mimic joint="m"/></joint>',
        '<link name="extra"/>', '<xacro/>', '<gazebo reference="tip"><plugin filename="/dev/null"/></gazebo>',
        '<joint name="p" type="planar"><parent link="tip"/><child link="extra"/><axis xyz="1 0 0"/></joint>',
    ))  # fmt: skip
    root.append(ET.fromstring(text))


@pytest.mark.parametrize(
    "argv", [("inspect", "bad.urdf", "--json"), ("evaluate", "bad.urdf", *PUSH)], ids=lambda a: a[0]
)
def test_spoiled_urdfs(argv: tuple[str, ...], arena: Path, hostile_full: bool) -> None:
    rng = random.Random(argv[0])
    outcomes = attack(
        [argv] * (COUNT * (40 if hostile_full else 1)),
        arena,
        lambda k: (arena / "bad.urdf").write_bytes(spoiled(rng) if k else SMALL.encode()),
    )
    assert outcomes[0].code == 0
    refused = [outcome for outcome in outcomes if outcome.code]
    assert len(refused) > COUNT / 4
    # The remaining error lines name a missing frame or joint.
    assert sum("bad.urdf" in outcome.err for outcome in refused) > len(refused) / 2


ENTITIES = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 10))
CHAIN = "".join(
    f'<link name="d{k}"/><joint name="e{k}" type="fixed"><parent link="{f"d{k - 1}" if k else "tip"}"/>'
    f'<child link="d{k}"/></joint>'
    for k in range(10_000)
)
ISLANDS = "".join(f'<link name="l{k}"/>' for k in range(10_000))
LOOP = '<joint name="c" type="fixed"><parent link="lower"/><child link="lower"/></joint>'
BREAKERS = {
    "entities that grow to a billion": (
        f'<!DOCTYPE robot [<!ENTITY e0 "a">{ENTITIES}]>{SMALL.replace("small", "&e9;", 1)}'
    ),
    "file from elsewhere": (
        f'<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]>{SMALL.replace("small", "&x;", 1)}'
    ),
    "nested elements": SMALL.replace('<link name="tip"/>', "<a>" * 20_000 + "</a>" * 20_000 + '<link name="tip"/>'),
    "links without joints": SMALL.replace("</robot>", f"{ISLANDS}</robot>"),
    "long name": SMALL.replace("small", "a" * 1_000_000, 1),
    "wrong encoding": '<?xml version="1.0" encoding="utf-16"?>' + SMALL,
    "only a comment": "<!-- " + "a" * 100_000 + " -->",
    "chain that overflows the stack of the URDF parser": SMALL.replace("</robot>", f"{CHAIN}</robot>"),
    "link below itself": SMALL.replace("</robot>", f"{LOOP}</robot>"),
}  # fmt: skip


@pytest.mark.parametrize("name", BREAKERS)
def test_files_made_to_break_parsers(name: str, arena: Path) -> None:
    (arena / "bad.urdf").write_text(BREAKERS[name])
    outcome = strike(arena, "inspect", "bad.urdf", "--json")
    assert not outcome.complaints, (outcome.complaints, outcome.err[-300:])
    assert len(outcome.err) < 5_000 and "root:" not in outcome.out


def test_shapes_of_which_no_two_can_meet(arena: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only two adjacent links have shapes, and adjacent links are not checked, so the result reports no distance."""
    monkeypatch.setattr(plot, "drawable", lambda *_: [])
    box = '<collision><geometry><box size="0.1 0.1 0.5"/></geometry></collision>'
    (arena / "boxes.urdf").write_text(SMALL.replace("</inertial>", f"</inertial>{box}"))
    push = ("--frame", "tip", "--normal", "1", "0", "0", "--contact-pose", "free")
    outcome = strike(
        arena, "optimize", "boxes.urdf", *push, "--starts", "1", "--no-codegen", "--format", "png", "--out", "out",
        "--quiet",
    )  # fmt: skip
    assert (outcome.code, outcome.complaints) == (0, []), outcome.err
    assert "collision" not in json.loads((arena / "out" / "result.json").read_text())
